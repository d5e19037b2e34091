"""MuJoCo's drag on the inertia box of a body: the box that has the body's mass and inertia."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

Vector = tuple[Array, Array, Array]
"""(x, y, z), each [...]"""


class Drag(NamedTuple):
    """What resists a motion along, or about, each axis of the box: -(viscous + inertial |v|) v."""

    viscous: Array
    """[3, ...]"""
    inertial: Array
    """[3, ...]"""


def drag(mass: Array, inertia: Array, density: Array, viscosity: Array) -> tuple[Drag, Drag]:
    """The drag against turning and against moving, of bodies of mass [...] and principal inertia [3, ...]."""
    box = jnp.sqrt(6.0 * jnp.maximum(inertia.sum(axis=0) - 2.0 * inertia, 1e-12) / mass)  # its edges
    around, along = jnp.roll(box, -1, axis=0), jnp.roll(box, -2, axis=0)
    diameter = jnp.broadcast_to(box.mean(axis=0), box.shape)
    turning = Drag(jnp.pi * diameter**3 * viscosity, density / 64.0 * box * (around**4 + along**4))
    moving = Drag(3.0 * jnp.pi * diameter * viscosity, 0.5 * density * around * along)
    return turning, moving


def resistance(drag: Drag, velocity: Vector) -> Vector:
    """Force, or torque, of the fluid against a velocity, or rate, in the axes of the box."""
    x, y, z = (-v * (a + b * jnp.abs(v)) for v, a, b in zip(velocity, drag.viscous, drag.inertial, strict=True))
    return x, y, z
