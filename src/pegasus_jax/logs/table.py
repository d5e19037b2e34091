"""A log as it was read: a table of numbers. And the files that need no library of their own, CSV and NPZ."""

import csv
import math
from collections.abc import Mapping
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
    size, names = len(given) + len(task.circles), [plain(name) for name in task.state_names]
    place = dict(zip(circles.entries(size, task.circles), given, strict=True))
    observed = {entry: names[place[entry]] for entry in place}
    for pair in task.circles:  # of atan2(sine, cosine)
        sine, _, cosine = observed[min(pair)].removeprefix("atan2(").removesuffix(")").partition(", ")
        observed |= dict(zip(pair, (cosine, sine), strict=True))
    paired = {entry for pair in task.circles for entry in pair}
    turning = tuple(i not in paired and place[i] in task.angles for i in range(size))
    units = {plain(name): unit for name in (*task.state_names, *task.control_names) if (unit := said(name))}
    angles = {observed[i]: "rad" for i in range(size) if turning[i]}
    return Names(
        tuple(observed[i] for i in range(size)), tuple(map(plain, task.control_names)), turning, angles | units
    )


def plain(name: str) -> str:
    """A name without its unit, as in "rate [rad/s]"."""
    return name.partition(" [")[0]


def of_csv(path: Path) -> Table:
    """The table of a text file, cells apart by commas, semicolons or tabs; a first line that is no numbers is a header.

    Empty lines, and those that begin with #, are left out. Raises ConfigError, with the line, for a row of another
    length.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read: {reason(error)}") from error
    kept = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip() and line[0] != "#"]
    if not kept:
        raise ConfigError(f"{path} is empty; expected a header and rows of numbers")
    comma = next((mark for mark in ",;\t" if mark in kept[0][1]), ",")
    cells = [[cell.strip() for cell in row] for row in csv.reader((line for _, line in kept), delimiter=comma)]
    header = any(_number(cell) is None for cell in cells[0])
    names = tuple(cells[0]) if header else tuple(map(str, range(len(cells[0]))))
    body, lines = cells[header:], np.array([number for number, _ in kept][header:], int)
    if twice := [name for name in names if names.count(name) > 1]:
        raise ConfigError(f"{path} has two columns called {twice[0]!r}; expected names that differ")
    if wrong := [(line, row) for line, row in zip(lines, body, strict=True) if len(row) != len(names)]:
        line, row = wrong[0]
        raise ConfigError(f"{path} line {line} has {len(row)} columns; expected {len(names)}, as in its first row")
    numbers = [[_number(cell) for cell in row] for row in body]
    texts = {
        (i, j): body[i][j]
        for i, row in enumerate(numbers)
        for j, value in enumerate(row)
        if value is None and body[i][j]
    }
    rows = np.array([[math.nan if v is None else v for v in row] for row in numbers]).reshape(-1, len(names))
    return Table(str(path), names, rows, lines, "line", texts)


def of_npz(path: Path, names: Names) -> Table:
    """The table of a file of NumPy arrays: the episodes that we write, or a column an array; 2-D ones are name.0, ...

    One array may have the whole observation, and one all controls: see `OBSERVATIONS` and `CONTROLS`. Controls, and
    times of controls, may be one fewer than observations.
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
            width = 1 if found[name].ndim == 1 else found[name].shape[1]
            whole[name] = wanted if width == len(wanted) else None
    columns: dict[str, np.ndarray] = {}
    for name, array in found.items():
        if size - len(array) in (0, 1):
            parts = array[:, None] if array.ndim == 1 else array
            own = [name] if array.ndim == 1 else [f"{name}.{i}" for i in range(parts.shape[1])]
            for column, numbers in zip(whole.get(name) or own, parts.T, strict=True):
                columns.setdefault(column, np.append(numbers.astype(float), [np.nan] * (size - len(array))))
    for name in TIMES:  # of controls: the last observation comes a period after the last of them
        if name in columns and size > 2 and np.isnan(columns[name][-1]):
            columns[name][-1] = 2 * columns[name][-2] - columns[name][-3]
    if "dt" in arrays and not {*TIMES} & {*columns}:  # as in the episodes that we write
        columns["t"] = np.arange(size) * float(np.ravel(arrays["dt"])[0])
    return Table(source, tuple(columns), np.column_stack([*columns.values()]), np.arange(size))


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None


def reason(error: Exception) -> str:
    """Why something could not be read, in one line."""
    known = error.strerror if isinstance(error, OSError) else None
    return known or " ".join(str(error).split())
