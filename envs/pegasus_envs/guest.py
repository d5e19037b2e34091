"""Any Gymnasium environment with continuous controls as a plant: it runs on the host, called from compiled programs."""

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium
import jax
import numpy as np
from jax import Array
from jax.experimental import io_callback

RESETS = 100  # from which the distribution of starts is estimated


class Guest(NamedTuple):
    """What a Gymnasium environment tells of itself. There is one of it, so its functions cannot be vmapped."""

    reset: Callable[[Array], Array]
    """key -> x [D]"""
    step: Callable[[Array, Array], Array]
    """(x [D] of the step before, control [U]) -> x [D]; the environment knows its state itself, and rests when ended"""
    observe: Callable[[Array], Array]
    control_low: np.ndarray
    control_high: np.ndarray
    dt: float
    """control period [s]; 1 when the environment tells neither `dt` nor frames a second"""
    horizon: int
    """control periods of an episode; the environment's own limit, or 100"""
    start_mean: np.ndarray
    start_std: np.ndarray


def guest(name: str) -> Guest:
    """The environment that Gymnasium knows as `name`. Episodes have one length: after an early end, x stays as it is.

    Raises ValueError, in one line, when there is none, or its controls or observations are not vectors of numbers.
    """
    try:
        made = gymnasium.make(name, disable_env_checker=True)
    except (gymnasium.error.Error, ImportError) as error:
        raise ValueError(str(error).splitlines()[0]) from error
    env: Any = made.unwrapped
    controls, seen = env.action_space, env.observation_space
    for space, what in ((controls, "controls"), (seen, "observations")):
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
            raise ValueError(f"its {what} are {space}, not a vector of numbers")
    if not controls.is_bounded():
        raise ValueError(f"its controls have no limits: {controls}")
    shape = jax.ShapeDtypeStruct(seen.shape, np.float32)
    starts = np.stack([env.reset(seed=seed)[0] for seed in range(RESETS)])

    ended = False

    def host_reset(seed: Any) -> np.ndarray:
        nonlocal ended
        ended = False
        return np.asarray(env.reset(seed=int(seed))[0], np.float32)

    def host_step(x: Any, control: Any) -> np.ndarray:
        nonlocal ended
        if ended:  # what a step would do is undefined
            return np.asarray(x)
        seen, _, ended, *_ = env.step(np.asarray(control, controls.dtype))
        return np.asarray(seen, np.float32)

    # Each call takes the result of the one before, which keeps them in order.
    fps = env.metadata.get("render_fps", 1)
    return Guest(
        reset=lambda key: io_callback(host_reset, shape, jax.random.randint(key, (), 0, 2**31 - 1)),
        step=lambda x, control: io_callback(host_step, shape, x, control),
        observe=lambda x: x,
        control_low=np.asarray(controls.low, float),
        control_high=np.asarray(controls.high, float),
        dt=float(getattr(env, "dt", 1.0 / fps)),
        horizon=(made.spec.max_episode_steps if made.spec else None) or 100,
        start_mean=starts.mean(axis=0),
        start_std=starts.std(axis=0),
    )
