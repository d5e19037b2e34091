"""Episodes of logs in a run's folder: made durable before its first trial, and what that trial learns from.

They are trial 1: they take the place of a first episode of random controls.
"""

import glob
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from pegasus_jax.assembly.experiments import build, set_precision
from pegasus_jax.checks import RunError
from pegasus_jax.config import Config, begins_with
from pegasus_jax.episode import padded
from pegasus_jax.experiment import Experiment
from pegasus_jax.logs import compare
from pegasus_jax.logs.read import Logged, read
from pegasus_jax.runs import store
from pegasus_jax.runs.files import write_whole
from pegasus_jax.runs.programs import gather
from pegasus_jax.task import Task
from pegasus_jax.types import RunState, Trajectory

FOLDER = "logged"  # in a run's folder


class Logs(NamedTuple):
    """The logs that a job learns from first."""

    rows: int  # of data
    episodes: Callable[[], list[Logged]]


NONE = Logs(0, lambda: [])


def named(init: str) -> tuple[Path, str]:
    """The folder and the trial of init=RUN@TRIAL; "" of init=RUN."""
    name, at, trial = init.rpartition("@")
    return Path(name if at else init), trial


def files_of(config: Config) -> list[str]:
    """Where a config's first data are: in the logs that it names, and in the episodes of another run that it takes."""
    if config.init is None or not begins_with(config, "data"):
        return [*config.data]
    run, _ = named(config.init)
    kept = [_path(run, number) for number in store.numbered(run / FOLDER, ".npz")]
    kept += [store.episode_path(run, trial) for trial in store.numbered(run / "episodes", ".npz")]
    return [*config.data, *(glob.escape(str(path)) for path in kept)]


def has(config: Config) -> bool:
    """Whether a run begins with logs."""
    return bool(config.data) or begins_with(config, "data")


def rows(logged: Sequence[Logged]) -> int:
    """How many rows of data these episodes are."""
    return sum(len(one.trajectory.u) for one in logged)


def save(run: Path, logged: Sequence[Logged], task: Task) -> None:
    """Make the episodes durable, each as those of the run, with what it came from and how many there are."""
    for number in store.numbered(run / FOLDER, ".npz")[len(logged) :]:  # of a command that was killed before it began
        _path(run, number).unlink()
    for number, one in enumerate(logged, start=1):
        ended = "horizon" if len(one.trajectory.u) == task.horizon else "truncated"
        arrays = store.arrays_of(task.name, 1, one.trajectory, task, policy=0, ended=ended)
        arrays |= {"source": one.source, "number": number, "of": len(logged), "begins": one.begins}
        write_whole(_path(run, number), lambda file, arrays=arrays: np.savez(file, **arrays))  # type: ignore[misc]


def load(run: Path) -> list[Logged]:
    """The episodes. Raises RunError, naming the file, where one is missing, damaged or of another run."""
    found, task = [], store.task_of(run)
    for number in range(1, _count(run) + 1):
        known = store.arrays(_path(run, number), *store.EPISODE, "source")
        if wrong := store.wrong(known, 1, task):
            raise RunError(f"{_path(run, number)} {wrong}")
        rows = (known[name] for name in ("x", "u", "cost"))
        begins = bool(known.get("begins", True))  # a run of an earlier version does not say it
        episode: Any = Trajectory(*rows, memory=known.get("memory"))  # type: ignore[arg-type]
        found.append(Logged(episode, str(known["source"]), begins=begins))
    return found


def of_run(config: Config, run: Path) -> Logs:
    """The logs of a run's folder, where its config says that it has some. Raises RunError as `load` does."""
    if not has(config):
        return NONE
    lengths = [len(store.arrays(_path(run, number), "u")["u"]) for number in range(1, _count(run) + 1)]
    return Logs(sum(lengths), lambda: load(run))


def of_config(config: Config, logs: Sequence[Logged] | None = None) -> Logs:
    """The logs that a config names, `logs` where they were read already. Raises ConfigError for what cannot be."""
    if not has(config):
        return NONE
    known = read_config(config, build(config).task)[0] if logs is None else logs
    return Logs(rows(known), lambda: list(known))


def read_config(config: Config, task: Task) -> tuple[list[Logged], list[str]]:
    """(the episodes that a config names, notes on them: one line each). Raises ConfigError for what cannot be."""
    if not has(config):
        return [], []
    set_precision(config)
    found, notes = read(files_of(config), task, config.data_columns, config.data_control)
    files = len({one.source for one in found})
    return found, [
        f"logs of {rows(found) * task.dt:g} s from {files} file{'s' * (files > 1)} are the first data",
        compare.ranges(found, task),
        *notes,
        *compare.far(found, task),
    ]


def _path(run: Path, number: int) -> Path:
    return run / FOLDER / f"{number:04d}.npz"


def _count(run: Path) -> int:
    """How many there are to be. Raises RunError where there are fewer."""
    there = store.numbered(run / FOLDER, ".npz")
    count = int(store.arrays(_path(run, there[0]), "of")["of"]) if there else 0
    if there != [*range(1, count + 1)] or not count:
        raise RunError(
            f"{run / FOLDER} does not hold all logs that the run began with: {len(there)} of {count or 'some'}"
        )
    return count


def added(states: RunState, logged: Sequence[Logged], experiment: Experiment) -> RunState:
    """The states [S, ...] with the episodes in their data, all as one trial; whether they succeeded is no policy's."""
    add = jax.jit(jax.vmap(experiment.add_episode, (0, None)))
    found = gather(states)  # of several processes, each has all
    for one in logged:
        found = add(found, padded(one.trajectory, experiment.task.horizon))
    return found._replace(trial=gather(states.trial) + 1, succeeded=gather(states.succeeded))


def told(logged: Sequence[Logged], task: Task) -> dict[str, Any]:
    """What a row of trials.jsonl says of the logs: `log_seconds`, which are none of the run's plant time."""
    costs = np.concatenate([one.trajectory.cost for one in logged])
    return {
        "logs": len(logged),
        "log_seconds": round(len(costs) * task.dt, 6),
        "episode_cost": float(np.mean(costs, dtype=np.float64)),
        "episode_success": False,  # no policy of the run's
        "steps": len(costs),
        "ended": "horizon",
    }
