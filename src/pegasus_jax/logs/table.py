"""A log as it was read: a table of numbers. And files of NumPy arrays as tables."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from pegasus_jax import memory
from pegasus_jax.checks import ConfigError
from pegasus_jax.logs.units import said
from pegasus_jax.math import circles
from pegasus_jax.task import Task

# What others call the observations and the controls, where one array has all of them.
OBSERVATIONS = ("observation", "observations", "obs", "x")
CONTROLS = ("u", "control", "controls", "action", "actions")
TIMES = ("t", "time")
EPISODE = "episode"
Texts = Mapping[tuple[int, int], str]


class Table(NamedTuple):
    """One log: N rows of C columns."""

    source: str  # what to call it: a file, or a data set
    names: tuple[str, ...]  # [C]; without a header 0, 1, ...
    rows: np.ndarray  # [N, C] float64; NaN where there is no number
    lines: np.ndarray  # [N] what a person calls its rows
    unit: str = "row"  # of the file that a row is
    texts: Texts = MappingProxyType({})  # (row, column) -> what is there instead of a number
    remembered: Mapping[str, float] = MappingProxyType({})  # name -> what was remembered where it begins, as a goal
    begins: bool = True  # whether an episode begins with its first row

    def where(self, row: Any) -> str:
        """What to call a row."""
        return f"{self.source} {self.unit} {self.lines[row]}"


class Names(NamedTuple):
    """What the columns of a table are to become."""

    observation: tuple[str, ...]  # [O] the user's observation
    control: tuple[str, ...]  # [U]
    turning: tuple[bool, ...]  # [O] whether an entry is an angle
    units: Mapping[str, str] = MappingProxyType({})  # name -> the unit that it is in, as far as it is known


def names_of(task: Task) -> Names:
    """The names of what a controller of the task is given, cosines and sines where the state has their angle."""
    given = memory.measured(task)
    observed = _observed([task.state_names[i] for i in given], task.circles)
    seen, controls = distinct(observed, task.control_names)
    size = len(seen)
    place = dict(zip(circles.entries(size, task.circles), given, strict=True))
    paired = {entry for pair in task.circles for entry in pair}
    turning = tuple(i not in paired and place[i] in task.angles for i in range(size))
    full = zip((*seen, *controls), (*observed, *task.control_names), strict=True)
    units = {name: unit for name, whole in full if (unit := said(whole))}
    angles = {name: "rad" for name, turns in zip(seen, turning, strict=True) if turns}
    return Names(seen, controls, turning, angles | units)


def distinct(states: Sequence[str], controls: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The names of an observation's and a control's columns, all different: without a unit, unless two then are alike.

    A motor may be called as its joint is, and a rate as its angle is, in another unit.
    """
    every = [*states, *controls]
    short = [*map(plain, every)]
    names = [one if short.count(one) == 1 else whole for one, whole in zip(short, every, strict=True)]
    return tuple(names[: len(states)]), _apart(names[: len(states)], names[len(states) :])


def _apart(states: Sequence[str], controls: Sequence[str]) -> tuple[str, ...]:
    """The names of controls, that of one that is called as a state is with a word behind it."""
    return tuple(f"{name} (control)" if name in states else name for name in controls)


def _observed(states: Sequence[str], pairs: circles.Circles) -> list[str]:
    """Names [O] of an observation, of those of its state [D]: of atan2(sine, cosine) the cosine and the sine."""
    size = len(states) + len(pairs)
    found = dict(zip(circles.entries(size, pairs), states, strict=True))
    for pair in pairs:
        sine, _, cosine = found[min(pair)].removeprefix("atan2(").removesuffix(")").partition(", ")
        found |= dict(zip(pair, (cosine, sine), strict=True))
    return [found[i] for i in range(size)]


def plain(name: str) -> str:
    """A name without its unit, as in "rate [rad/s]"."""
    return name.partition(" [")[0]


def loose(name: str) -> str:
    """A name without its unit in small letters, with spaces for _, for those that are written otherwise."""
    return plain(name).casefold().replace("_", " ")


def of_npz(path: Path, names: Names) -> Table:
    """The table of a file of NumPy arrays: the episodes that we write, or a column an array; 2-D ones are name.0, ...

    One array may have the whole observation, and one all controls: see `OBSERVATIONS` and `CONTROLS`. Controls, and
    times of controls, may be one fewer than observations. The names that our episodes have are their columns'.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except Exception as error:  # of a damaged or foreign file NumPy and zipfile raise whatever they come across
        raise ConfigError(f"{path} cannot be read: {reason(error)}") from error
    return of_arrays(str(path), arrays, names)


def of_arrays(source: str, arrays: Mapping[str, Any], names: Names) -> Table:
    """The table of arrays by name; those that are no columns of numbers are left out."""
    found = {name: np.asarray(array) for name, array in arrays.items()}
    found = {name: array for name, array in found.items() if array.ndim in (1, 2) and array.dtype.kind in "fiub"}
    size = max(map(len, found.values()), default=0)
    if not size:
        raise ConfigError(f"{source} has no array of rows; expected observations [N, O] and controls [N, U]")
    whole = {}
    for aliases, wanted in ((OBSERVATIONS, names.observation), (CONTROLS, names.control)):
        if (name := next((alias for alias in aliases if alias in found), None)) is not None:
            whole[name] = wanted if _width(found[name]) == len(wanted) else None
    whole |= _own_names(arrays, found, names)
    columns: dict[str, np.ndarray] = {}
    for name, array in found.items():
        if size - len(array) in (0, 1):
            parts = array[:, None] if array.ndim == 1 else array
            own = [name] if array.ndim == 1 else [f"{name}.{i}" for i in range(parts.shape[1])]
            for column, numbers in zip(whole.get(name) or own, parts.T, strict=True):
                columns.setdefault(column, np.append(numbers.astype(float), [np.nan] * (size - len(array))))
    dt = float(np.ravel(arrays["dt"])[0]) if "dt" in arrays else None  # as in the episodes that we write
    for name in TIMES:  # of controls: the last observation comes a period after the last of them
        if name in columns and size > 1 and np.isnan(columns[name][-1]):
            period = columns[name][-2] - columns[name][-3] if size > 2 else dt or np.nan
            columns[name][-1] = columns[name][-2] + period
    if dt is not None and not {*TIMES} & {*columns}:
        columns["t"] = np.arange(size) * dt
    first = np.ravel(arrays.get("memory", ()))
    kept = dict(zip(map(str, np.ravel(arrays.get("memory_names", ()))), first, strict=False))
    rows = np.column_stack([*columns.values()])
    begins = bool(np.all(arrays.get("begins", True)))
    return Table(source, tuple(columns), rows, np.arange(size), remembered=kept, begins=begins)


def _own_names(arrays: Mapping[str, Any], found: Mapping[str, np.ndarray], names: Names) -> dict[str, list[str]]:
    """Array -> the names of its columns, as the episodes that we write tell them.

    Those of which the environment has none are left out: they are of other times, and the order is what is left.
    """
    states, controls = ([*map(str, np.ravel(arrays.get(name, ())))] for name in ("state_names", "control_names"))
    said = {"x": (states, names.observation), "u": ([*_apart(states, controls)], names.control)}
    pairs = np.asarray(arrays.get("circles", ()))
    if pairs.ndim == 2 and "observation" in found and _width(found["observation"]) == len(states) + len(pairs):
        said["observation"] = (_observed(states, tuple(map(tuple, pairs.tolist()))), names.observation)
    return {
        name: own
        for name, (own, wanted) in said.items()
        if name in found and _width(found[name]) == len(own) == len({*own})
        if {*map(loose, own)} & {*map(loose, wanted)}
    }


def _width(array: np.ndarray) -> int:
    return math.prod(array.shape[1:])


def reason(error: Exception) -> str:
    """Why something could not be read, in one line."""
    known = error.strerror if isinstance(error, OSError) else None
    return known or " ".join(str(error).split())
