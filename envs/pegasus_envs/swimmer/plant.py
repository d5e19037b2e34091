"""A six-legged swimmer, driven by periodic leg commands through its flippers: four maneuvers, two or six legs."""

import copy
from collections.abc import Callable
from functools import cache, partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from pegasus_envs import physics
from pegasus_envs.batching import batch_last
from pegasus_envs.physics import Motion, Scalar
from pegasus_envs.plant import FRAME, Plant, draw_start, substates_of
from pegasus_envs.swimmer import dynamics
from pegasus_envs.swimmer.goals import START_DEPTH, Cost, Task, goal
from pegasus_envs.swimmer.layout import Mechanism, mechanism
from pegasus_envs.swimmer.rotations import angles_of, quaternion_of

XML = "swimmer.xml"
LEGS = ("FL", "ML", "RL", "FR", "MR", "RR")
"""front, middle, rear of the left side, then of the right: the order of every six-vector here"""
REAR = (2, 5)
HIPS = slice(7, 19, 2)
"""in the positions"""
AMPLITUDE, OFFSET, PHASE = np.pi / 4, np.pi / 3, np.pi
LAG = 0.1
"""time constant of the filter on the commands [s]"""
_PERIODS = {2: 1.0, 6: 0.5}
"""control period for that many legs [s]"""


class Swimming(NamedTuple):
    """State of the swimmer. Commands change through a filter, and the stroke goes on where it is: no leg ever jumps."""

    qpos: Array
    """[19] position [m], attitude [w x y z], then hip and tip angle of each leg [rad]"""
    qvel: Array
    """[18] world velocity [m/s], rates in the body's frame, hip and tip rates [rad/s]"""
    command: Array
    """[3, 6] filtered amplitude, offset and phase of each leg [rad]"""
    stroke: Array
    """[] the part of the current stroke that is over, in [0, 1)"""
    rate: Array
    """[3] rates in the body's frame, averaged over the last stroke [rad/s]"""


def swimmer(
    task: Task,
    legs: Literal[2, 6] = 2,
    *,
    roll_rate: Scalar = -2.0 * np.pi / 3.0,
    cost: Cost = "shaped",
    hull_mass: Scalar = 15.0,
    hull_length: Scalar = 0.6,
    density: Scalar = 1000.0,
    stiffness: Scalar = 2.0,
    stroke_rate: float = 4.0,
) -> Plant:
    """One maneuver; x = [roll, pitch, yaw, depth, three body rates, (the hip angles when all six legs swim)].

    Args:
        task: `knife_edge` (roll 90 degrees), `belly_up` (180), `corkscrew` (roll steadily), `depth_change` (1 m down),
            each while swimming straight ahead
        legs: with 2, the control is [A_L, A_R, O_L, O_R] of the rear legs, each second; with 6, [A x6, O x6, phase x6],
            twice a second
        roll_rate: of the corkscrew, by default -120 degrees/s [rad/s]; negative is anti-clockwise seen from behind
        cost: `shaped`, wide enough to be felt at the start, or the narrower one in the `authors`' files
        hull_mass: [kg], with the inertia in proportion
        hull_length: [m], which changes inertia and drag
        density: of the water, and so all drag [kg/m^3]
        stiffness: of the passive joint in each flipper [N m/rad]
        stroke_rate: strokes of a leg per second; best a whole number of them in a control period

    A leg follows angle(t) = O + A sin(2 pi stroke_rate t + phase). The physical constants may be traced.
    """
    aim = goal(task, legs, cost, roll_rate)
    body = _body(legs, float(stroke_rate), hull_mass, hull_length, density, stiffness)
    model = copy.copy(body.model)
    model.geom_pos[model.geom("goal").id, 2] = -aim.depth
    low, high = _limits(legs)
    dimensions = 7 if legs == 2 else 13
    start_mean = np.zeros(dimensions)
    start_mean[3] = START_DEPTH
    start_std = np.where(np.arange(dimensions) < 7, 0.1, 0.0)
    return Plant(
        reset=lambda key: body.state_from_observation(draw_start(key, start_mean, start_std)),
        step=body.step,
        substates=body.substates,
        observe=body.observe,
        state_from_observation=body.state_from_observation,
        error=aim.error,
        width=aim.width,
        control_low=low,
        control_high=high,
        dt=_PERIODS[legs],
        horizon=round(20.0 / _PERIODS[legs]),
        start_mean=start_mean,
        start_std=start_std,
        sensor_std=np.full(dimensions, 0.01),
        angles=(0, 1, 2),
        state_names=_state_names(dimensions),
        control_names=_control_names(legs),
        model=model,
        qpos=lambda state: state.qpos,
    )


class _Body(NamedTuple):
    """What the maneuvers share."""

    state_from_observation: Callable[[Array], Swimming]
    step: Callable[[Swimming, Array], Swimming]
    substates: Callable[[Swimming, Array], Swimming]
    observe: Callable[[Swimming], Array]
    model: Any


def _body(legs: int, stroke_rate: float, *constants: Scalar) -> _Body:
    """The same functions for the same constants: all maneuvers then run one compiled program."""
    if any(isinstance(constant, jax.Array) for constant in constants):
        return _new_body(legs, stroke_rate, *constants)
    return _known_body(legs, stroke_rate, bool(jax.config.jax_enable_x64), *constants)  # pyright: ignore


@cache
def _known_body(legs: int, stroke_rate: float, x64: bool, *constants: Scalar) -> _Body:
    del x64  # part of the cache's key only
    with jax.ensure_compile_time_eval():  # the first to ask may be inside jit
        return _new_body(legs, stroke_rate, *constants)


def _new_body(legs: int, stroke_rate: float, *constants: Scalar) -> _Body:
    system = physics.load(XML, _changes(*constants))
    tick, dimensions = system.host.opt.timestep, 7 if legs == 2 else 13
    low, high = _limits(legs)
    dt, window = _PERIODS[legs], round(1.0 / stroke_rate / tick)
    keep = np.exp(-tick / LAG)

    def state_from_observation(x: Array) -> Swimming:
        hips = x[7:] if legs == 6 else jnp.zeros(6, x.dtype)
        joints = jnp.stack([hips, jnp.zeros_like(hips)], axis=1).reshape(-1)
        position = jnp.zeros(3, x.dtype).at[2].set(-x[3])
        qvel = jnp.zeros(18, x.dtype).at[3:6].set(x[4:7])
        qpos = jnp.concatenate([position, quaternion_of(x[:3]), joints])
        return Swimming(qpos, qvel, jnp.zeros((3, 6), x.dtype), jnp.zeros((), x.dtype), x[4:7])

    def swim(state: Swimming, target: Array, body: Mechanism, *, steps: int) -> Swimming:
        accelerate = partial(dynamics.acceleration, body)

        def substep(carry: tuple[Motion, Array, Array], _: None) -> tuple[tuple[Motion, Array, Array], Array]:
            motion, command, stroke = carry
            command = target + keep * (command - target)
            motion = physics.advance(accelerate, motion, hip_angles(command, stroke), tick)
            stroke = stroke + stroke_rate * tick
            return (motion, command, stroke - jnp.floor(stroke)), motion.qvel[3:6]

        carry = Motion(state.qpos, state.qvel), state.command, state.stroke
        (motion, command, stroke), rates = jax.lax.scan(substep, carry, None, length=steps)
        return Swimming(*motion, command, stroke, rates[-window:].mean(axis=0))

    def stepping(duration: float) -> Callable[[Swimming, Array], Swimming]:
        along = batch_last(partial(swim, steps=physics.substeps(system, duration)))
        return lambda state, control: along(state, _leg_commands(jnp.clip(control, low, high), legs), mechanism(system))

    def observe(state: Swimming) -> Array:
        depth, hips = -state.qpos[2:3], state.qpos[HIPS]
        return jnp.concatenate([angles_of(state.qpos[3:7]), depth, state.rate, hips])[:dimensions]

    return _Body(state_from_observation, stepping(dt), substates_of(stepping(FRAME), dt), observe, system.host)


def hip_angles(command: Array, stroke: Array) -> Array:
    """The periodic leg command: angles [6] asked of the hips, from amplitude, offset, phase [3, 6] and stroke []."""
    amplitude, offset, phase = command
    return offset + amplitude * jnp.sin(2.0 * jnp.pi * stroke + phase)


def _leg_commands(control: Array, legs: int) -> Array:
    """Amplitude, offset and phase [3, 6] of all legs; those that a two-legged swimmer lacks point back at rest."""
    if legs == 6:
        return control.reshape(3, 6)
    return jnp.zeros((3, 6), control.dtype).at[:2, REAR].set(control.reshape(2, 2))


def _limits(legs: int) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest controls [4] or [18] [rad]."""
    low, high = [0.0, -OFFSET, -PHASE], [AMPLITUDE, OFFSET, PHASE]
    return (np.repeat(low[:2], 2), np.repeat(high[:2], 2)) if legs == 2 else (np.repeat(low, 6), np.repeat(high, 6))


def _state_names(dimensions: int) -> tuple[str, ...]:
    names = ["roll [rad]", "pitch [rad]", "yaw [rad]", "depth [m]"]
    names += [f"{axis} rate [rad/s]" for axis in ("roll", "pitch", "yaw")] + [f"{leg} hip [rad]" for leg in LEGS]
    return tuple(names[:dimensions])


def _control_names(legs: int) -> tuple[str, ...]:
    kinds, which = (("amplitude", "offset"), ("RL", "RR")) if legs == 2 else (("amplitude", "offset", "phase"), LEGS)
    return tuple(f"{leg} {kind} [rad]" for kind in kinds for leg in which)


def _changes(mass: Scalar, length: Scalar, density: Scalar, stiffness: Scalar) -> list[physics.Change]:
    """What the constants determine in the model; geoms are for the eye only."""
    model = physics.default(XML)
    hull = model.geom("hull").id
    _, half_width, half_height = model.geom_size[hull]
    squares = (0.5 * length) ** 2, half_width**2, half_height**2
    inertia = [mass * (squares[1] + squares[2]), mass * (squares[0] + squares[2]), mass * (squares[0] + squares[1])]
    body = model.body("hull").id
    return [
        ("body_mass", body, mass),
        *[("body_inertia", (body, axis), value / 3.0) for axis, value in enumerate(inertia)],
        ("geom_size", (hull, 0), 0.5 * length),
        ("geom_pos", (model.geom("nose").id, 0), 0.5 * length - 0.005),
        ("opt.density", (), density),
        *[("jnt_stiffness", model.joint(f"flex_{leg}").id, stiffness) for leg in LEGS],
    ]
