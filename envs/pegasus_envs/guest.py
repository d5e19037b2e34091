"""Any Gymnasium environment with continuous controls as a plant: it runs on the host, called from compiled programs.

It may be a robot, so it is opened once a process, never reset without need, and closed when the process ends.
"""

import atexit
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from traceback import extract_tb
from typing import Any, NamedTuple

import gymnasium
import jax
import numpy as np
from jax import Array
from jax.experimental import io_callback

from pegasus_envs.plant import filled

RESETS = 100  # from which the distribution of starts is estimated where it is not given


class Facts(NamedTuple):
    """What has to be known of an environment before its first episode."""

    control_low: np.ndarray
    control_high: np.ndarray
    dt: float
    """control period [s]; 1 when the environment tells neither `dt` nor frames a second"""
    horizon: int
    """control periods of an episode; the environment's own limit, or 100"""
    start_mean: np.ndarray
    start_std: np.ndarray


class Guest(NamedTuple):
    """A Gymnasium environment as a plant. There is one of it, so its functions cannot be vmapped."""

    reset: Callable[[Array], Array]
    """key -> x [D]"""
    step: Callable[[Array, Array], Array]
    """(x [D] of the step before, control [U]) -> x [D]; the environment knows its state itself, and rests when ended"""
    observe: Callable[[Array], Array]
    trouble: list[BaseException]
    """what `reset` and `step` have raised, with a note of where; JAX reports an error of its own"""


@cache
def opened(name: str) -> gymnasium.Env:
    """The environment that Gymnasium knows as `name`. Raises ValueError, in one line, when there is none."""
    try:
        made = gymnasium.make(name, disable_env_checker=True)
    except (gymnasium.error.Error, ImportError) as error:
        raise ValueError(str(error).splitlines()[0]) from error
    atexit.register(made.close)  # a robot is to stop, whatever ended the run
    return made


@cache
def starts(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation [D] of where resets take an environment."""
    places = np.stack([opened(name).unwrapped.reset(seed=seed)[0] for seed in range(RESETS)])
    return places.mean(axis=0), places.std(axis=0)


def facts(
    name: str,
    *,
    control_low: Sequence[float] = (),
    control_high: Sequence[float] = (),
    dt: float | None = None,
    horizon: int | None = None,
    start_mean: Sequence[float] = (),
    start_std: Sequence[float] = (),
) -> Facts:
    """What is given of an environment, and the rest from itself; without a `start_mean` it is reset 100 times.

    Raises ValueError, in one line, when its controls or observations are not vectors of numbers, or cannot be as given.
    """
    made = opened(name)
    env: Any = made.unwrapped
    controls, seen = env.action_space, env.observation_space
    for space, what in ((controls, "controls"), (seen, "observations")):
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
            raise ValueError(f"its {what} are {space}, not a vector of numbers")
    low = filled("control_low", control_low, controls.shape[0], controls.low)
    high = filled("control_high", control_high, controls.shape[0], controls.high)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ValueError(f"its controls have no limits: {controls}; give control_low= and control_high=")
    for least, greatest, bottom, top in zip(low, high, controls.low, controls.high, strict=True):
        if not bottom <= least < greatest <= top:
            raise ValueError(
                f"controls from {least:g} to {greatest:g} are not among its own, from {bottom:g} to {top:g}"
            )
    size, rest = seen.shape[0], np.zeros(seen.shape)
    given = filled("start_mean", start_mean, size, rest, each=True), filled("start_std", start_std, size, rest)
    own_limit = made.spec.max_episode_steps if made.spec else None
    own_period = float(getattr(env, "dt", 1.0 / env.metadata.get("render_fps", 1)))
    mean, std = given if len(start_mean) else starts(name)
    return Facts(low, high, dt or own_period, horizon or own_limit or 100, mean, std)


def guest(name: str, states: int) -> Guest:
    """The environment `name` of so many observations, opened when its first episode begins.

    Episodes have one length: after an early end, x stays as it is. An observation that is not finite, or not of that
    length, is refused at once: no control follows from it, and no data.
    """
    shape = jax.ShapeDtypeStruct((states,), np.float32)
    trouble: list[BaseException] = []
    ended = False

    def observed(x: Any) -> np.ndarray:
        x = np.asarray(x, np.float32)
        if x.shape != shape.shape:
            raise ValueError(f"it observed an array of shape {x.shape}; expected {shape.shape}")
        for entry in np.flatnonzero(~np.isfinite(x)):
            raise ValueError(f"entry {entry} of its observation is {x[entry]}")
        return x

    def reset(seed: Any) -> np.ndarray:
        nonlocal ended
        ended = False
        return observed(opened(name).unwrapped.reset(seed=int(seed))[0])

    def step(x: Any, control: Any) -> np.ndarray:
        nonlocal ended
        if ended:  # what a step would do is undefined
            return np.asarray(x)
        env: Any = opened(name).unwrapped
        seen, _, ended, *_ = env.step(np.asarray(control, env.action_space.dtype))
        return observed(seen)

    def told(function: Callable[..., np.ndarray], *arguments: Any) -> np.ndarray:
        try:
            return function(*arguments)
        except BaseException as error:
            theirs = [frame for frame in extract_tb(error.__traceback__) if frame.filename != __file__]
            for frame in theirs[-1:]:
                error.add_note(f"{Path(frame.filename).name}:{frame.lineno}")
            trouble.append(error)
            raise

    # Each call takes the result of the one before, which keeps them in order.
    return Guest(
        reset=lambda key: io_callback(partial(told, reset), shape, jax.random.randint(key, (), 0, 2**31 - 1)),
        step=lambda x, control: io_callback(partial(told, step), shape, x, control),
        observe=lambda x: x,
        trouble=trouble,
    )
