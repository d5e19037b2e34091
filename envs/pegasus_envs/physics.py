"""Smooth rigid-body physics: one evaluation of the acceleration, MJX's, and a Runge-Kutta step around any.

`mjx.step` with RK4 evaluates `mjx.forward` four times in the compiled program, each with every feature of MuJoCo; for
a small mechanism the compiler then works far longer than the simulation. Here the four stages are a loop around one
evaluation, which calls only the passes that a mechanism without contacts, constraints, tendons, springs, fluid or
activation states needs. The physics is MJX's own, and tests hold it to `mjx.step` and to C MuJoCo. The swimmer
takes the same steps with equations of motion of its own (`flippers`).
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's bindings and MJX's data classes declare few of their names.)

import copy
from collections.abc import Callable, Iterable
from functools import cache, partial
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from pegasus_envs.inertia import solve

ASSETS = Path(__file__).parent / "assets"

# The classical Runge-Kutta method of order four: where to evaluate a stage, and the weight of the slope found there.
_OFFSETS = np.array([0.0, 0.5, 0.5, 1.0])
_WEIGHTS = np.array([1.0, 2.0, 2.0, 1.0]) / 6.0


class Motion(NamedTuple):
    """Generalised positions [nq] and velocities [nv]."""

    qpos: Array
    qvel: Array


Scalar = float | Array
"""A physical constant, traced or not."""

Change = tuple[str, Any, Any]
"""a field of MuJoCo's model, an index into it, the value to put there"""

Accelerate = Callable[[Array, Array, Array], Array]
"""(positions [nq, ...], velocities [nv, ...], actuator commands [nu, ...]) -> generalized acceleration [nv, ...]"""

_Stage = tuple[Array, Array, Array, Array]
"""velocity and acceleration of the last stage, their weighted means so far: each [nv]"""


class Physics(NamedTuple):
    """A mechanism. What MJX needs of it is made when a program is traced, which a second run does not do."""

    name: str
    """of its file in `assets`"""
    fields: dict[str, Any]
    """of MuJoCo's model, where they are others than the file's; they may be traced"""
    host: mujoco.MjModel

    @property
    def device(self) -> Any:
        """mjx.Model"""
        model, _ = _on_device(self.name, bool(jax.config.jax_enable_x64))
        return model.tree_replace({field: jnp.asarray(value, float) for field, value in self.fields.items()})

    @property
    def blank(self) -> Any:
        """mjx.Data that no evaluation changes: each works on its own copy"""
        return _on_device(self.name, bool(jax.config.jax_enable_x64))[1]


@cache
def _compiled(name: str) -> mujoco.MjModel:
    model = mujoco.MjModel.from_xml_path(str(ASSETS / name))
    if model.neq or model.ntendon or model.na or not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONSTRAINT:
        raise ValueError(f"{name}: only mechanisms without constraints, tendons and activation states")
    return model


@cache
def _on_device(name: str, x64: bool) -> tuple[Any, Any]:
    from pegasus_envs.quiet import mjx

    del x64  # part of the cache's key only: the arrays have that precision
    here = jax.local_devices()[0]  # MJX would choose the first of all, which may be another process's
    with jax.ensure_compile_time_eval():  # so that a plant may be built inside jit, and still be cached
        compiled = _compiled(name)
        return mjx.put_model(compiled, here, impl="jax"), mjx.make_data(compiled, here, impl="jax")


def load(name: str, changes: Iterable[Change] = ()) -> Physics:
    """Read `assets/name`, then overwrite entries of the model's fields by values, which may be traced.

    The host's copy changes too, unless a value is traced: then it keeps the file's constants.
    """
    host = copy.copy(_compiled(name))
    fields = {}
    for field, index, value in changes:
        fields[field] = _put(fields.get(field, attrgetter(field)(_compiled(name))), index, value)
    if not any(isinstance(value, jax.Array) for value in fields.values()):
        for field, value in fields.items():
            _write(host, field, value)
    return Physics(name, fields, host)


def _write(host: mujoco.MjModel, field: str, value: np.ndarray) -> None:
    *path, name = field.split(".")
    owner = attrgetter(".".join(path))(host) if path else host
    setattr(owner, name, value if value.ndim else value.item())


def default(name: str) -> mujoco.MjModel:
    """The model that `assets/name` describes; shared, so not to be written to."""
    return _compiled(name)


def uniform_rod(model: mujoco.MjModel, name: str, length: Scalar, mass: Scalar, up: float) -> list[Change]:
    """What length [m] and mass [kg] of a thin rod determine, for a body and its geom of that name; up is 1 or -1."""
    body, geom = model.body(name).id, model.geom(name).id
    return [
        ("body_mass", body, mass),
        ("body_ipos", (body, 2), up * 0.5 * length),
        ("body_inertia", (body, slice(0, 2)), mass * length**2 / 12.0),
        ("geom_pos", (geom, 2), up * 0.5 * length),
        ("geom_size", (geom, 1), 0.5 * length),
    ]


def _put(array: Any, index: Any, value: Any) -> Any:
    """A copy of `array` with `value` at `index`; a JAX array only if one of the two is."""
    if isinstance(value, jax.Array) or isinstance(array, jax.Array):
        return jnp.asarray(array, float).at[index].set(value)
    array = np.array(array)
    array[index] = value
    return array


def acceleration(physics: Physics, qpos: Array, qvel: Array, control: Array) -> Array:
    """Generalised acceleration [nv] under actuator commands [nu]; of a mechanism without springs, in no fluid."""
    from pegasus_envs.quiet import mjx

    model, host = physics.device, physics.host
    if host.jnt_stiffness.any() or host.opt.density > 0.0 or host.opt.viscosity > 0.0:
        raise ValueError("the only passive forces that are computed here are those of dampers")
    data = physics.blank.replace(qpos=qpos, qvel=qvel, ctrl=control)
    for compute in (mjx.kinematics, mjx.com_pos, mjx.crb, mjx.transmission, mjx.com_vel, mjx.rne):
        data = compute(model, data)
    moment = data._impl.actuator_moment
    data = mjx.fwd_actuation(model, data.tree_replace({"_impl.actuator_velocity": moment @ qvel}))
    force = data.qfrc_actuator - data.qfrc_bias - model.dof_damping * qvel
    return solve(mjx.full_m(model, data), force[:, None])[:, 0]


def displace(qpos: Array, velocity: Array, time: Array | float) -> Array:
    """Positions [nq, ...] after moving with a constant generalized velocity [nv, ...] for a time [s].

    The free joint, where there is one, comes first: a position, then a quaternion that turns in the body's frame.
    """
    if len(qpos) == len(velocity):
        return qpos + time * velocity
    turned = rotate(qpos[3:7], time * velocity[3:6])
    return jnp.concatenate([qpos[:3] + time * velocity[:3], turned, qpos[7:] + time * velocity[6:]])


def rotate(quaternion: Array, turn: Array) -> Array:
    """Turn an attitude [w x y z], [4, ...], by a rotation vector [3, ...] [rad] given in the body's frame."""
    half = 0.5 * jnp.sqrt((turn * turn).sum(axis=0) + 1e-30)  # the small number keeps the derivative at rest finite
    w, (x, y, z) = jnp.cos(half), 0.5 * turn * jnp.sinc(half / jnp.pi)
    a, b, c, d = quaternion
    product = [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ]
    turned = jnp.stack(product)
    return turned / jnp.sqrt((turned * turned).sum(axis=0))


def runge_kutta(accelerate: Accelerate, motion: Motion, control: Array, step: float) -> tuple[Array, Array]:
    """Mean velocity and acceleration [nv, ...] over a time step [s], with the actuator commands [nu, ...] held."""

    def stage(carry: _Stage, tableau: Array) -> tuple[_Stage, None]:
        velocity, slope, mean_velocity, mean_slope = carry
        offset, weight = tableau[0] * step, tableau[1]
        qpos = displace(motion.qpos, velocity, offset)
        velocity = motion.qvel + offset * slope
        slope = accelerate(qpos, velocity, control)
        return (velocity, slope, mean_velocity + weight * velocity, mean_slope + weight * slope), None

    zero = jnp.zeros_like(motion.qvel)
    tableau = jnp.asarray(np.stack([_OFFSETS, _WEIGHTS], axis=1), motion.qvel.dtype)
    (_, _, velocity, slope), _ = jax.lax.scan(stage, (zero, zero, zero, zero), tableau)
    return velocity, slope


def advance(accelerate: Accelerate, motion: Motion, control: Array, step: float) -> Motion:
    """The motion a time step [s] later."""
    velocity, slope = runge_kutta(accelerate, motion, control, step)
    return Motion(displace(motion.qpos, velocity, step), motion.qvel + step * slope)


def hold(physics: Physics, motion: Motion, control: Array, dt: float) -> Motion:
    """The motion one control period [s] later, under held actuator commands [nu]; for mechanisms of plain joints.

    The sums over the many short steps are compensated: in single precision their rounding, amplified by a chaotic
    mechanism, would else be the largest error by an order of magnitude.
    """
    step = physics.host.opt.timestep

    def substep(carry: tuple[Motion, Motion], _: None) -> tuple[tuple[Motion, Motion], None]:
        motion, lost = carry
        velocity, slope = runge_kutta(partial(acceleration, physics), motion, control, step)
        qpos, lost_qpos = _add(motion.qpos, lost.qpos, step * velocity)
        qvel, lost_qvel = _add(motion.qvel, lost.qvel, step * slope)
        return (Motion(qpos, qvel), Motion(lost_qpos, lost_qvel)), None

    start = (motion, jax.tree.map(jnp.zeros_like, motion))
    (motion, _), _ = jax.lax.scan(substep, start, None, length=substeps(physics, dt))
    return motion


def _add(total: Array, lost: Array, increment: Array) -> tuple[Array, Array]:
    """Kahan's sum: the new total, and what its rounding left out."""
    increment = increment + lost
    result = total + increment
    return result, increment - (result - total)


def substeps(physics: Physics, dt: float) -> int:
    """How many time steps of the model make up a control period [s]."""
    return round(dt / physics.host.opt.timestep)
