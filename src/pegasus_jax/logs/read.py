"""Logs as episodes of a task: from files, by name or pattern, to trajectories."""

import glob
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax import episode
from pegasus_jax import memory as recall
from pegasus_jax.checks import ConfigError, choice
from pegasus_jax.config import DATA_CONTROLS
from pegasus_jax.logs import bags, minari_sets
from pegasus_jax.logs.columns import layout
from pegasus_jax.logs.csv_files import of_csv
from pegasus_jax.logs.episodes import Segment, periods, segments, with_rates
from pegasus_jax.logs.table import Names, Table, names_of, of_npz
from pegasus_jax.task import Task
from pegasus_jax.tasks.terms import goal_names
from pegasus_jax.types import Array, Trajectory


class Logged(NamedTuple):
    """An episode of a log, or a part of a horizon's length of one, and where it came from."""

    trajectory: Trajectory  # of L <= H control periods, without a length
    source: str
    columns: tuple[str, ...] = ()  # [O+U] of the file, of which its observation and its controls are
    begins: bool = True  # whether its first row is that of an episode


def load_logs(
    files: str | Sequence[str], task: Task, *, columns: Sequence[str] = (), control: str = "sent"
) -> list[Trajectory]:
    """The episodes of logs as `add_episode` takes them, in arrays of H periods with their lengths.

    files: names or patterns of .csv, .npz, .mcap, .db3, .bag files and rosbag2 folders, or minari:NAME
    task: of an experiment, `build(config).task`; its angles are in radians
    columns: which column is what, as the setting `data_columns`; (): by names, else by order
    control: "sent", a row's controls are those sent at its time, or "before", those sent before it

    Raises ConfigError, in one line with file and row, for what cannot be an episode of the task; warns of what was
    left out, cut or resampled.
    """
    choice("control", control, DATA_CONTROLS)
    found, notes = read([files] if isinstance(files, str) else files, task, columns, control)
    for note in notes:
        warnings.warn(note, stacklevel=2)
    return [episode.padded(one.trajectory, task.horizon) for one in found]


def read(
    files: Sequence[str], task: Task, columns: Sequence[str] = (), control: str = "sent"
) -> tuple[list[Logged], list[str]]:
    """(the episodes of logs, in parts of at most a horizon; notes on what was decided, one line each)."""
    notes: dict[str, list[str]] = {}  # text -> the files of which it is true
    found: list[tuple[Segment, str, tuple[str, ...], dict[str, float]]] = []
    names, goals = names_of(task), goal_names(task)
    for table in tables(files, names, columns, control):

        def note(text: str, source: str = table.source) -> None:
            notes.setdefault(text, []).append(source)

        where, decided = layout(table, names, columns, task.dt)
        if decided:
            note(decided)
        pieces = list(segments(table, where, task, control, note))
        if not pieces:
            note("no two rows follow each other; left out")
        used = tuple(map(str, (*where.observation, *where.control)))
        told = {name: value for name, value in table.remembered.items() if name in task.memory.names}
        goal = {name: told[name] for name in goals if name in told}
        if len(goal) < len(goals):
            note("it does not tell the goals of its episodes; one that is drawn stands for all")
        for piece in pieces:
            if (one := periods(piece, task, note)) is not None:
                # What else was remembered is of that row, and counted in periods.
                found.append((one, table.source, used, told if one.first else goal))
    if not found:
        raise ConfigError(
            f"data={','.join(files)} has no episode: no rows follow each other for a period, {task.dt:g} s"
        )
    lines = [
        f"{own[0]}{f' and {len({*own}) - 1} more' if len({*own}) > 1 else ''}: {text}" for text, own in notes.items()
    ]
    return _trajectories(found, task), lines


def tables(files: Sequence[str], names: Names, columns: Sequence[str], control: str) -> list[Table]:
    """The tables of files, patterns and data sets. Raises ConfigError for what is not there, or of no known kind."""
    found: dict[str, Table] = {}  # of a file that two patterns name there is one
    for name in files:
        if name.startswith(minari_sets.PREFIX):
            found[name] = minari_sets.of_set(name.removeprefix(minari_sets.PREFIX), names)
            continue
        paths = [Path(path) for path in sorted(glob.glob(name, recursive=True))]
        if not paths:
            raise ConfigError(f"data={name}: there is no such file in {Path.cwd()}")
        for path in paths:
            key = str(bags.whole(path).resolve())
            if key not in found:
                found[key] = _table(path, names, columns, control)
    return [*found.values()]


def _table(path: Path, names: Names, columns: Sequence[str], control: str) -> Table:
    suffix = path.suffix.lower()
    if path.is_dir() and (inside := sorted(one.suffix for one in path.iterdir() if one.suffix in (".csv", ".npz"))):
        raise ConfigError(f"data={path} is a folder; data='{path}/*{inside[0]}' names its files")
    if suffix in bags.SUFFIXES or path.is_dir():
        return bags.of_bag(path, names, columns, control)
    if suffix == ".npz":
        return of_npz(path, names)
    if suffix in (".csv", ".txt", ".tsv"):
        return of_csv(path)
    raise ConfigError(f"data={path} is no log that we read; expected .csv, .npz, {', '.join(bags.SUFFIXES)}")


def _trajectories(found: Sequence[tuple[Segment, str, tuple[str, ...], dict[str, float]]], task: Task) -> list[Logged]:
    """Parts of at most H periods, each with its costs and what is remembered at its start, as far as it is known.

    Raises ConfigError where a cost is not a finite number.
    """
    size, kind = task.horizon, np.float32 if task.environment is not None else jnp.zeros(()).dtype
    parts: list[Logged] = []

    @jax.jit
    def known(whole: Trajectory) -> tuple[Array, Array | None]:
        return episode.costs(task, whole), recall.replay(task.memory, whole)

    for one, source, columns, told in found:
        x, u, m = with_rates(one.x, task).astype(kind), one.u.astype(kind), None
        if told:
            m = np.array(recall.begin(task.memory, jax.random.key(0), jnp.asarray(x[0])))
            m[[task.memory.names.index(name) for name in told]] = [*told.values()]
        for i in range(0, len(u), size):
            rows = u[i : i + size]
            part = Trajectory(x[i : i + size + 1], rows, np.zeros(len(rows), kind), memory=m)  # type: ignore[arg-type]
            costs, remembered = jax.tree.map(np.asarray, known(episode.padded(part, size)))
            for (row,) in np.argwhere(~np.isfinite(costs[: len(rows)]))[:1]:
                raise ConfigError(f"{source}: the cost of the observation {part.x[row + 1].tolist()} is {costs[row]}")
            start, m = (None, None) if remembered is None else (remembered[0], remembered[len(rows)])
            whole = part._replace(cost=costs[: len(rows)].astype(kind), memory=start)
            parts.append(Logged(whole, source, columns, one.begins and i == 0))
    return parts
