"""The constants of a hull with flippers of two links, whose hinges are all parallel to the hull's y axis.

Arrays are [2, C]: hip and tip, flippers.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's bindings and MJX's data classes declare few of their names.)

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from pegasus_envs.physics import Physics
from pegasus_envs.swimmer.drag import Drag, drag


class Rigid(NamedTuple):
    """The hull, or the links [2, C]."""

    mass: Array
    inertia: Array
    """[3, ...] principal, in the axes of the body"""
    turning: Drag
    moving: Drag


class Mechanism(NamedTuple):
    """A hull, seen from its centre of mass, and links that at rest lie along its x axis."""

    hull: Rigid
    links: Rigid
    hip: Array
    """[3, C]"""
    hinge: Array
    """[2, C] x of a link's hinge, from the hip, at rest"""
    centre: Array
    """[2, C] x of a link's centre of mass, from its hinge, at rest"""
    stiffness: Array
    damping: Array
    armature: Array
    """[2, C] of the hinges"""
    gain: Array
    """[C] of the hips' servos [N m/rad]"""


def mechanism(physics: Physics) -> Mechanism:
    """The constants of a model of a hull and its flippers, each body of a hip followed by that of its tip."""
    model, count = physics.device, physics.host.nu
    body, joint, dof = (first + np.arange(2 * count).reshape(count, 2).T for first in (2, 1, 6))

    def rigid(which: np.ndarray | int) -> Rigid:
        mass, inertia = model.body_mass[which], jnp.moveaxis(model.body_inertia[which], -1, 0)
        return Rigid(mass, inertia, *drag(mass, inertia, model.opt.density, model.opt.viscosity))

    return Mechanism(
        hull=rigid(1),
        links=rigid(body),
        hip=model.body_pos[body[0]].T,
        hinge=jnp.stack([jnp.zeros(count), model.body_pos[body[1], 0]]),
        centre=model.body_ipos[body, 0],
        stiffness=model.jnt_stiffness[joint],
        damping=model.dof_damping[dof],
        armature=model.dof_armature[dof],
        gain=model.actuator_gainprm[:, 0],
    )
