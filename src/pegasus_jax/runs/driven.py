"""The episodes that pegasus-run drove: RUN/driven/NNNN.npz, logs that are never data."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pegasus_jax.checks import RunError
from pegasus_jax.runs import store
from pegasus_jax.runs.files import held

if TYPE_CHECKING:
    from pegasus_jax.episode import Episode
    from pegasus_jax.task import Task

FOLDER = "driven"  # in a run's folder
LOG = (*store.EPISODE, "time", "overruns")  # what every log has


class Driven(NamedTuple):
    """An episode that was driven, as its log tells it."""

    number: int
    policy: int  # the trial that learned the policy which drove
    episode: Episode
    task: Task  # the run's, with the horizon of this episode
    overruns: int  # controls that were sent late


@contextmanager
def locked(run: Path) -> Iterator[None]:
    """With the right to drive by a run. Raises RunError when another process has it."""
    (run / FOLDER).mkdir(exist_ok=True)
    guard = held(run / FOLDER / ".lock", f"another pegasus-run drives by {run}; begin when it has ended")
    try:
        yield
    finally:
        guard.release()


def path_of(run: Path, number: int) -> Path:
    """Where a log lies."""
    return run / FOLDER / f"{number:04d}.npz"


def load(run: Path, number: int) -> Driven:
    """Read a log. Raises RunError for a file that cannot be read, or is no episode of this run's task."""
    from pegasus_jax.episode import Episode
    from pegasus_jax.types import Trajectory

    path = path_of(run, number)
    found = store.arrays(path, *LOG)
    if found["horizon"].ndim or found["horizon"].dtype.kind not in "iu" or found["overruns"].ndim:
        raise RunError(f"{path} says nothing usable of its horizon and overruns")
    task = store.task_of(run)._replace(horizon=int(found["horizon"]))
    any_policy = {"policy": np.zeros_like(found["policy"])}  # logs are counted by themselves, not by trials
    if what := store.wrong(found | any_policy, number, task):
        raise RunError(f"{path} {what}")
    rows = (found[name] for name in ("x", "u", "cost"))
    ran = Episode(Trajectory(*rows), str(found["ended"]))  # type: ignore[arg-type]
    return Driven(number, int(found["policy"]), ran, task, int(found["overruns"]))
