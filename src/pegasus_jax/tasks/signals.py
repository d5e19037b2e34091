"""What is asked of a policy from outside: a reference of a file or a function, and goals drawn for each episode."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax.checks import ConfigError, shown
from pegasus_jax.config import Config
from pegasus_jax.task import Signal, Task
from pegasus_jax.tasks import user_code
from pegasus_jax.types import Array, Key

FILES = (".csv", ".npz")  # of references
AHEAD = (0, 1, 3)  # control periods from now, of which the policy sees the reference
DRAWS = 100  # goals that tell how large goals are


def with_signals(task: Task, config: Config) -> Task:
    """The task with the reference and the goals that a config names. Raises ConfigError for what they cannot be."""
    reference, goal = named(config)
    return task._replace(
        reference=None if reference is None else of_times(reference, times(task)),
        goal=None if goal is None else Signal(goal, sizes(draws(goal))),
    )


def named(config: Config) -> tuple[Callable[[Array], Array] | None, Callable[[Key], Array] | None]:
    """A config's reference, t in [s] -> [R], and how it draws goals, key -> [G]; None for what it has not.

    Raises ConfigError, in one line, for what they cannot be.
    """
    reference = None if config.reference is None else reference_of(config.reference)
    if config.goals is None:
        return reference, between(config.goal_low, config.goal_high) if config.goal_low or config.goal_high else None
    if config.goal_low or config.goal_high:
        raise ConfigError("goals= draws the goals; leave out goal_low= and goal_high=")
    return reference, vector("goals", config.goals, jax.random.key(0))


def of_times(value: Callable[[Array], Array], along: np.ndarray) -> Signal:
    """The signal of a reference [R], whose units are the sizes that it has at these times [s]."""
    return Signal(value, sizes(np.asarray(jax.vmap(value)(jnp.asarray(along, float)))))


def times(task: Task) -> np.ndarray:
    """The times [s] at which a reference is looked at in an episode of a task."""
    return task.dt * np.arange(task.horizon + 1 + max(AHEAD))


def draws(goal: Callable[[Key], Array]) -> np.ndarray:
    """A hundred goals [100, G]."""
    return np.asarray(jax.vmap(goal)(jax.random.split(jax.random.key(0), DRAWS)), np.float64)


def sizes(values: np.ndarray) -> tuple[float, ...]:
    """The root mean square of each column of values [N, V], and 1 of one that is 0."""
    return tuple(float(size) or 1.0 for size in np.sqrt(np.mean(np.square(values, dtype=np.float64), 0)))


def between(low: tuple[float, ...], high: tuple[float, ...]) -> Callable[[Key], Array]:
    """Goals [G] that are uniform between limits."""
    if len(low) != len(high):
        raise ConfigError(f"goal_low has {len(low)} entries and goal_high {len(high)}; expected as many")
    for least, greatest in zip(low, high, strict=True):
        if not least < greatest:
            raise ConfigError(f"goal_low={least:g} must be less than goal_high={greatest:g}")
    return lambda key: jax.random.uniform(key, (len(low),), float, jnp.array(low, float), jnp.array(high, float))


def vector(setting: str, name: str | Callable[..., Any], example: Any) -> Callable[[Any], Array]:
    """The user's function of an example's kind as one that returns a vector. Raises ConfigError, in one line."""
    function, what = user_code.load(setting, name), f"{setting}={shown(name)}"

    def value(given: Any) -> Array:
        return jnp.atleast_1d(jnp.asarray(function(given), float))

    with user_code.blamed(what, function):
        found = jax.jit(value)(example)
    place = f" ({place})" if (place := user_code.definition(function)) else ""
    if found.ndim != 1:
        raise ConfigError(f"{what} returns an array of shape {found.shape}; expected one number or a vector{place}")
    if not np.isfinite(found).all():
        raise ConfigError(f"{what} is {found} at first; expected finite numbers{place}")
    return value


def reference_of(setting: str | Callable[..., Any]) -> Callable[[Array], Array]:
    """A reference as a function of time [] [s] -> [R]. Raises ConfigError, in one line, for what is none."""
    if isinstance(setting, str) and setting.endswith(FILES):
        return table(*read(Path(setting), f"reference={setting}"))
    return vector("reference", setting, jnp.zeros(()))


def table(at: np.ndarray, values: np.ndarray) -> Callable[[Array], Array]:
    """The values [N, R] at times [N] [s] as a function of time: on lines between, the outer ones beyond the ends."""
    return lambda t: jnp.stack([jnp.interp(t, jnp.asarray(at, float), jnp.asarray(v, float)) for v in values.T])


def read(file: Path, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Times [N] [s] and values [N, R]: the first and the other columns of a CSV, or `t` and `values` of an NPZ file.

    Raises ConfigError, in one line that begins with `what`, for a file that has none.
    """
    if not file.is_file():
        raise ConfigError(f"{what} is not there; expected a file .csv or .npz, or module:function of a time [s]")
    try:
        found = _npz(file) if file.suffix == ".npz" else _csv(file)
    except Exception as error:  # of a damaged or foreign file NumPy and zipfile raise whatever they come across
        raise ConfigError(f"{what} cannot be read as times and values: {' '.join(str(error).split())}") from error
    if found.shape[1] < 2 or not len(found):
        raise ConfigError(f"{what} has no values beside the times [s], which come first")
    for row, column in np.argwhere(~np.isfinite(found))[:1]:
        raise ConfigError(f"{what} has {found[row, column]} in row {row + 1} of its numbers; expected finite numbers")
    for row in np.flatnonzero(np.diff(found[:, 0]) <= 0)[:1]:
        raise ConfigError(f"{what}: times [s] must increase, and {found[row + 1, 0]:g} follows {found[row, 0]:g}")
    return found[:, 0], found[:, 1:]


def _csv(file: Path) -> np.ndarray:
    """The numbers of a file with commas, under a line of names or none: one number in it, and it is none of names."""
    lines = [line.split(",") for line in file.read_text(encoding="utf-8-sig").splitlines() if line.strip()]
    named = lines and not any(map(_is_number, lines[0]))
    return np.array([[float(word) for word in line] for line in lines[bool(named) :]], ndmin=2)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _npz(file: Path) -> np.ndarray:
    with np.load(file) as found:
        if missing := [name for name in ("t", "values") if name not in found]:
            raise KeyError(f"no array {missing[0]}; expected t and values, and it has {', '.join(found)}")
        return np.column_stack([found["t"], found["values"]]).astype(float)
