"""Passive forces: springs and dampers of the joints, and MuJoCo's drag on the inertia box of each body.

The same as `mjx.passive`, which takes a Jacobian of every body to bring the drag to the joints: half of an evaluation's
time for the swimmer. Here the drag of each body is summed over the bodies that a joint moves, as one small product.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's bindings and MJX's data classes declare few of their names.)

from functools import cache
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array


def passive_force(physics: Any, data: Any) -> Array:
    """Generalised passive force [nv]; `data` needs positions and velocities of the bodies (`mjx.com_vel`)."""
    model, host = physics.device, physics.host
    force = -model.dof_damping * data.qvel
    plain, dofs = _springs(host)
    if len(plain):
        force = force.at[dofs].add(
            -model.jnt_stiffness[plain] * (data.qpos - model.qpos_spring)[host.jnt_qposadr[plain]]
        )
    if host.opt.density > 0.0 or host.opt.viscosity > 0.0:
        moved = jnp.asarray(_moved(host.body_parentid.tobytes(), host.dof_bodyid.tobytes()), force.dtype)
        power = data.cdof * (moved @ _drag(model, data))
        # Six additions along the batch: a sum over an axis of six is several times slower.
        force = force + sum(power[:, i] for i in range(6))
    return force


def _springs(host: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Hinges and slides, and their degrees of freedom; free joints have no springs here."""
    (plain,) = np.nonzero(host.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE))
    (sprung,) = np.nonzero(host.jnt_stiffness)
    joints = np.intersect1d(plain, sprung)
    return joints, host.jnt_dofadr[joints]


@cache
def _moved(parents: bytes, dof_bodies: bytes) -> np.ndarray:
    """[nv, nbody] 1 where the degree of freedom moves the body."""
    parent, dof_body = np.frombuffer(parents, np.int32), np.frombuffer(dof_bodies, np.int32)
    above = np.eye(len(parent))
    for body in range(1, len(parent)):
        above[:, body] += above[:, parent[body]]
    return above[dof_body]


def _drag(model: Any, data: Any) -> Array:
    """Torque about the tree's centre of mass and force of the fluid on each body, in the world's frame [nbody, 6]."""
    density, viscosity = model.opt.density, model.opt.viscosity
    mass = jnp.maximum(model.body_mass, 1e-12)[:, None]
    inertia = model.body_inertia
    # A box with this mass and inertia has these edges.
    squares = 6.0 * jnp.maximum(jnp.sum(inertia, axis=1, keepdims=True) - 2.0 * inertia, 1e-12) / mass
    box = jnp.sqrt(squares) * (model.body_mass > 0.0)[:, None]
    around, along = jnp.roll(box, -1, axis=1), jnp.roll(box, -2, axis=1)
    fourth = around**4 + along**4
    diameter = jnp.mean(box, axis=1, keepdims=True)

    arm = data.xipos - data.subtree_com[np.asarray(model.body_rootid)]
    rate, speed = data.cvel[:, :3], data.cvel[:, 3:] - jnp.cross(arm, data.cvel[:, :3])
    rate = jnp.einsum("bij,bi->bj", data.ximat, rate)
    speed = jnp.einsum("bij,bi->bj", data.ximat, speed)
    torque = -rate * (jnp.pi * diameter**3 * viscosity + density / 64.0 * box * fourth * jnp.abs(rate))
    force = -speed * (3.0 * jnp.pi * diameter * viscosity + 0.5 * density * around * along * jnp.abs(speed))
    torque = jnp.einsum("bij,bj->bi", data.ximat, torque)
    force = jnp.einsum("bij,bj->bi", data.ximat, force)
    return jnp.concatenate([torque + jnp.cross(arm, force), force], axis=1)
