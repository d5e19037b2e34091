"""A Gymnasium environment with continuous controls as a plant, used as it was made: its wrappers are its owner's.

It may be a robot, so it is opened once a process, never reset without need, and closed when it is no longer needed.
"""

import atexit
import json
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.envs.registration import load_env_creator
from gymnasium.spaces.utils import flatdim

from pegasus_envs.plant import filled

LARGEST = 1e15  # of a reading: squares of larger ones overflow single precision in a fit
PYTHONS = {"True": "true", "False": "false", "None": "null"}  # for JSON: an environment is written in Python
MOST = 1000  # numbers of an observation that may be flattened: an image has more, and nothing here is for those
RESETS = 100  # from which the distribution of starts is estimated where it is not given


class EnvSpec(NamedTuple):
    """What has to be known of an environment before its first episode."""

    control_low: np.ndarray
    control_high: np.ndarray
    dt: float
    """control period [s]; 1 when the environment tells neither `dt` nor frames a second"""
    horizon: int
    """control periods of an episode; the environment's own limit, or 100"""
    start_mean: np.ndarray
    start_std: np.ndarray
    starts: np.ndarray
    """observations [N, D] where episodes start, equally likely; none where start_mean and start_std say it"""
    state_names: tuple[str, ...] = ()
    """of the observation's entries, as "angle [rad]"; none where they have no names"""
    control_names: tuple[str, ...] = ()


class EnvPlant(NamedTuple):
    """An environment as a plant outside of JAX.

    There is one of it, and only the main thread calls it, but for the `close` of a watchdog.
    """

    reset: Callable[[int], np.ndarray]
    """seed -> x [D]"""
    step: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, str]]
    """control [U] -> (x [D], the control as it was sent [U], "terminated", "truncated" or "")"""
    close: Callable[[], None]
    rest: Callable[[], None] = lambda: None
    """after an episode that ended without an error: no control comes until the next reset, maybe minutes later"""


_opened: dict[tuple[str, tuple[str, ...]], gymnasium.Env] = {}


def make_env(name: str, arguments: tuple[str, ...] = (), **more: Any) -> gymnasium.Env:
    """The environment that Gymnasium knows as `name`, opened once.

    `arguments` are its constructor's, as `port=/dev/ttyACM0`: JSON on the right, True, False or None, or else text;
    `more` are others, if it is not open yet. Raises what Gymnasium or the constructor raises.
    """
    if (name, arguments) not in _opened:
        pairs = (argument.partition("=") for argument in arguments)
        given: Any = {key: _value(text) for key, _, text in pairs}
        _opened[name, arguments] = gymnasium.make(name, disable_env_checker=True, **(given | more))
    return _opened[name, arguments]


def render_modes(name: str) -> Sequence[str] | None:
    """How the environment says that it renders, without opening it; None where only an open one can tell."""
    entry = gymnasium.spec(name.rpartition(":")[2]).entry_point
    creator: Any = load_env_creator(entry) if isinstance(entry, str) else entry
    return getattr(creator, "metadata", {}).get("render_modes")


def picture(env: gymnasium.Env) -> np.ndarray:
    """What an environment renders now [height, width, 3], 8-bit colors. Raises ValueError where that is no picture."""
    drawn: Any = env.render()
    if not isinstance(drawn, np.ndarray) or drawn.shape[2:] != (3,) or drawn.dtype != np.uint8:
        what = f"an array of {drawn.dtype} {drawn.shape}" if isinstance(drawn, np.ndarray) else type(drawn).__name__
        raise ValueError(f"its render returned {what}; expected uint8 [height, width, 3]")
    return drawn


def close_env(name: str, arguments: tuple[str, ...] = ()) -> None:
    """Close the environment if it is open; the next use opens it again."""
    env = _opened.pop((name, arguments), None)
    if env is not None:
        resets_of.cache_clear()
        env.close()


@atexit.register
def close_environments() -> None:
    """Close every environment that is open."""
    for name, arguments in tuple(_opened):
        close_env(name, arguments)


@cache
def resets_of(name: str, arguments: tuple[str, ...] = (), resets: int = RESETS) -> np.ndarray:
    """Where as many resets take an environment [resets, D]."""
    env = make_env(name, arguments)
    space: Any = env.observation_space
    return np.stack([observed(first(env.reset(seed=seed)), space.shape[0]) for seed in range(resets)])


def env_spec(
    name: str,
    arguments: tuple[str, ...] = (),
    *,
    control_low: Sequence[float] = (),
    control_high: Sequence[float] = (),
    dt: float | None = None,
    horizon: int | None = None,
    start_mean: Sequence[float] = (),
    start_std: Sequence[float] = (),
    starts: Sequence[Sequence[float]] = (),
    state_names: Sequence[str] = (),
    control_names: Sequence[str] = (),
) -> EnvSpec:
    """What is given of an environment, and the rest from itself; without `starts` or their mean it is reset 100 times.

    Its attributes `dt`, `state_names` and `control_names` are asked for, those of its outermost wrapper that has them.
    Raises ValueError, in one line, when its controls or observations are not vectors of numbers, or cannot be as given.
    """
    env = make_env(name, arguments)
    controls, seen = (getattr(env, space, None) for space in ("action_space", "observation_space"))
    for space, what in ((controls, "action_space"), (seen, "observation_space")):
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
            raise ValueError(f"its {what} is {space}, not a Box of one dimension{_way_out(what, space)}")
    assert isinstance(controls, gymnasium.spaces.Box)
    assert isinstance(seen, gymnasium.spaces.Box)
    low = filled("control_low", control_low, controls.shape[0], controls.low)
    high = filled("control_high", control_high, controls.shape[0], controls.high)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ValueError(f"its controls have no limits: {controls}; give control_low= and control_high=")
    # A box may have limits in single precision, and a number that is typed has not.
    kind = controls.dtype.type if np.issubdtype(controls.dtype, np.floating) else float  # type: ignore[union-attr]
    for least, greatest, bottom, top in zip(low, high, controls.low, controls.high, strict=True):
        if not least < greatest:
            raise ValueError(f"controls from {least:g} to {greatest:g}: expected control_low below control_high")
        if not (bottom <= kind(least) and kind(greatest) <= top):
            raise ValueError(
                f"controls from {least:g} to {greatest:g} are beyond its limits, from {bottom:g} to {top:g}"
            )
    size, rest = seen.shape[0], np.zeros(seen.shape)
    states = named(env, "state_names", state_names, size)
    actions = named(env, "control_names", control_names, controls.shape[0])
    mean, std = filled("start_mean", start_mean, size, rest, each=True), filled("start_std", start_std, size, rest)
    if not len(start_mean) and not len(starts):
        starts = [row.tolist() for row in resets_of(name, arguments)]
    if wrong := [len(row) for row in starts if len(row) != size]:
        raise ValueError(f"a row of starts has {wrong[0]} entries; expected {size}")
    places = np.reshape(np.array(starts, float), (-1, size))
    if len(places):
        mean, std = places.mean(0), places.std(0)
    return EnvSpec(low, high, dt or period(env), horizon or own_limit(env) or 100, mean, std, places, states, actions)


def _way_out(what: str, space: Any) -> str:
    """The end of a line that refuses a space: what makes a vector of numbers of it."""
    if what == "action_space":
        return "; controls must be numbers in a range, as Box(-1, 1, (2,))"
    if not getattr(space, "is_np_flattenable", False):
        return "; an observation must be numbers, as Box(-inf, inf, (4,))"
    if (size := flatdim(space)) > MOST:
        return f"; its {size:,} numbers are too many for this program, as an image's are"
    return "; register an environment that returns gymnasium.wrappers.FlattenObservation(env), which makes one"


def named(env: Any, what: str, given: Sequence[str], size: int) -> tuple[str, ...]:
    """The names given, or the environment's own; none where it has none. Raises ValueError for those that cannot be."""
    try:
        names = given or env.get_wrapper_attr(what)
    except AttributeError:
        return ()
    if isinstance(names, str) or not all(
        isinstance(name, str) and name.strip() and name.isprintable() for name in names
    ):
        raise ValueError(f"its {what} are {names!r}, not a tuple of texts such as 'angle [rad]'; or give {what}=")
    if len(names) != size:
        raise ValueError(f"{what} has {len(names)} entries, {', '.join(names)}; expected {size}")
    if twice := [name for i, name in enumerate(names) if name in names[:i]]:
        raise ValueError(f"{what} has {twice[0]} twice; each entry needs a name of its own")
    return tuple(names)


def period(env: Any) -> float:
    """The environment's control period [s]; 1 where it tells none. Raises ValueError for a `dt` that is none."""
    return told_period(env) or 1.0


def told_period(env: Any) -> float | None:
    """The environment's `dt` [s], else its frames a second; None where it has neither. Raises ValueError as above."""
    frames = (env.metadata or {}).get("render_fps")
    return own_period(env) or (1.0 / frames if frames else None)


def own_period(env: Any) -> float | None:
    """The environment's `dt` [s], or None. Raises ValueError for one that is no number of seconds."""
    try:
        dt = env.get_wrapper_attr("dt")
    except AttributeError:
        return None
    if isinstance(dt, bool) or not isinstance(dt, int | float | np.number) or not 0 < dt < np.inf:
        raise ValueError(f"its dt is {dt!r}, not a number of seconds; give dt=")
    return float(dt)


def own_limit(env: Any) -> int | None:
    """The control periods after which the environment ends each episode, or None."""
    return env.spec.max_episode_steps if env.spec else None


def env_plant(
    name: str, arguments: tuple[str, ...], states: int, controls: int, names: tuple[str, ...] = ()
) -> EnvPlant:
    """The environment of so many observations, maybe with names, and controls, opened when its first episode begins.

    An observation that is not finite, or not of that length, is refused at once: no control follows from it, and no
    data. Controls are the environment's own copy, of its action space's dtype and limits; whole numbers are rounded.
    """

    def reset(seed: int) -> np.ndarray:
        env = make_env(name, arguments)
        if (shape := env.action_space.shape) != (controls,):  # as of another version: one control would go to all
            raise ValueError(f"its action_space has shape {shape}; expected ({controls},)")
        return observed(first(env.reset(seed=seed)), states, names)

    def step(control: np.ndarray) -> tuple[np.ndarray, np.ndarray, str]:
        env = make_env(name, arguments)
        space: Any = env.action_space
        whole = np.issubdtype(space.dtype, np.integer)
        sent = np.clip(np.rint(control) if whole else control, space.low, space.high).astype(space.dtype)
        answer = env.step(sent.copy())
        if not isinstance(answer, tuple) or len(answer) != 5:
            raise ValueError(
                f"its step returned {_shape(answer)}; expected (observation, reward, terminated, truncated, info)"
            )
        seen, _, terminated, truncated, _ = answer
        if not all(np.size(flag) == 1 for flag in (terminated, truncated)):
            raise ValueError(
                f"its step returned terminated={terminated}, truncated={truncated}; expected True or False"
            )
        return observed(seen, states, names), sent, "terminated" if terminated else "truncated" if truncated else ""

    def rest() -> None:
        env = _opened.get((name, arguments))  # one that a watchdog has closed is not opened for this
        if env is None:
            return
        try:
            stop = env.get_wrapper_attr("rest")
        except AttributeError:
            return
        if callable(stop):
            stop()

    return EnvPlant(reset, step, lambda: close_env(name, arguments), rest)


def first(answer: Any) -> Any:
    """The observation of a reset's answer. Raises ValueError for that of an old Gym environment."""
    if not isinstance(answer, tuple) or len(answer) != 2:
        raise ValueError(f"its reset returned {_shape(answer)}; expected (observation, info)")
    return answer[0]


def observed(x: Any, states: int, names: Sequence[str] = ()) -> np.ndarray:
    """A copy of an observation [D], in single precision. Raises ValueError where it is none, or not below LARGEST."""
    try:
        x = np.array(x, np.float32)
    except (TypeError, ValueError) as error:
        raise ValueError(f"it observed {type(x).__name__}; expected {states} numbers") from error
    if x.shape != (states,):
        raise ValueError(f"it observed an array of shape {x.shape}; expected ({states},)")
    for entry in np.flatnonzero(~(np.abs(x) < LARGEST)):
        called = f", {names[int(entry)]}," if names else ""
        raise ValueError(f"entry {entry} of its observation{called} is {x[entry]}")
    return x


def _value(text: str) -> Any:
    try:
        return json.loads(PYTHONS.get(text, text))
    except ValueError:
        return text


def _shape(answer: Any) -> str:
    return f"{len(answer)} values" if isinstance(answer, tuple) else type(answer).__name__
