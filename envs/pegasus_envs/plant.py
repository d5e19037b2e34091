"""A plant: the physical system to be controlled, as a tuple of pure functions and of static facts about it."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

State = Any
"""A small pytree: positions, velocities and whatever else the next step needs."""


FRAME = 0.05
"""from one picture of a film to the next [s]; a whole number of them in every control period"""


class Plant(NamedTuple):
    """One task's physics, sensors, goal and limits. D states, U controls, E entries of the goal error."""

    reset: Callable[[Array], State]
    """key -> physical state, drawn from N(start_mean, diag(start_std^2))"""
    step: Callable[[State, Array], State]
    """(state, control [U]) -> state one control period later; the control is held, and clipped to its limits"""
    substates: Callable[[State, Array], State]
    """(state, control [U]) -> the states [n, ...] on the way, one each `FRAME` seconds, for films"""
    observe: Callable[[State], Array]
    """state -> x [D], free of noise"""
    state_from_observation: Callable[[Array], State]
    """x [D] -> a physical state that observes as x; what x does not tell is at rest"""
    error: Callable[[Array], Array]
    """x [D] -> e [E], zero at the goal; affine in (x without its angles, sin and cos of its angles)"""
    width: float
    """of the saturating cost 1 - exp(-|e|^2 / (2 width^2))"""
    control_low: np.ndarray
    control_high: np.ndarray
    dt: float
    """control period [s]"""
    horizon: int
    """control periods of one trial"""
    start_mean: np.ndarray
    start_std: np.ndarray
    sensor_std: np.ndarray
    angles: tuple[int, ...]
    """the entries of x that are angles [rad]"""
    state_names: tuple[str, ...]
    control_names: tuple[str, ...]
    model: Any
    """mujoco.MjModel on the host, to render and to compare; has the default constants where those given are traced"""
    qpos: Callable[[State], Array]
    """state -> MuJoCo's generalized positions [nq]"""
    rates: tuple[int, ...] = ()
    """the entries of x that are rates of its other entries, in the order of those; (): x is not made of such pairs"""


def saturating(plant: Plant, x: Array) -> Array:
    """The task's cost of x [D], in [0, 1): 0 at the goal, near 1 far from it."""
    error = plant.error(x)
    return -jnp.expm1(-0.5 * (error @ error) / plant.width**2)


def substates_of(move: Callable[[State, Array], State], dt: float) -> Callable[[State, Array], State]:
    """A plant's `substates`: `move` goes on by `FRAME` seconds, the control period is `dt`."""

    def substates(state: State, control: Array) -> State:
        def advance(state: State, _: None) -> tuple[State, State]:
            following = move(state, control)
            return following, following

        return jax.lax.scan(advance, state, None, length=round(dt / FRAME))[1]

    return substates


def draw_start(key: Array, mean: np.ndarray, std: np.ndarray) -> Array:
    """One start x [D] from N(mean, diag(std^2))."""
    return jnp.asarray(mean) + jnp.asarray(std) * jax.random.normal(key, mean.shape)


def filled(setting: str, given: Sequence[float], size: int, default: np.ndarray, each: bool = False) -> np.ndarray:
    """The numbers [size] given for a setting, or the default. Raises ValueError for another count of them.

    One number is for all, unless there must be one for `each`.
    """
    if len(given) not in (0, size) and (each or len(given) != 1):
        raise ValueError(f"{setting} has {len(given)} entries; expected {size}{'' if each else ', or one for all'}")
    return np.broadcast_to(np.asarray(given, float), (size,)).copy() if len(given) else np.asarray(default, float)


def simulate(plant: Plant, state: State, controls: Array) -> Array:
    """Drive the plant with given controls [H, U] from a state -> x [H + 1, D]."""

    def advance(state: State, control: Array) -> tuple[State, Array]:
        following = plant.step(state, control)
        return following, plant.observe(following)

    _, xs = jax.lax.scan(advance, state, controls)
    return jnp.concatenate([plant.observe(state)[None], xs])
