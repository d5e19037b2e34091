"""Where runs are, as far as their folders tell it: who learns is another process."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pegasus_jax.checks import ConfigError, RunError
from pegasus_jax.runs import config_io, groups, store
from pegasus_jax.runs.display import LATEST, duration


def state(paths: Sequence[Path]) -> str:
    """One line: of a run the trial that is being done and the time left, of several how many are done."""
    try:
        runs = groups.found(paths)
        done = [_counted(run) for run in runs]
        if len(runs) > 1:
            return f"{sum(rows >= trials for rows, trials in done)} of {len(runs)} runs are done"
        return _of_one(runs[0], *done[0])
    except (ConfigError, RunError, OSError) as error:
        return str(error)


def _counted(run: Path) -> tuple[int, int]:
    """(finished trials, trials of the config)."""
    return len(store.readable_trials(run)[0]), config_io.load(run / "config.yaml").trials


def _of_one(run: Path, done: int, trials: int) -> str:
    if done >= trials:
        return f"done: {done} of {trials} trials"
    ran = store.episode_path(run, done + 1).exists()
    phase = "its episode has run, it is being learned from" if ran else "waiting for its episode"
    left = _left(run, done, trials)
    return f"trial {done + 1} of {trials}: {phase}" + ("" if left is None else f"; about {duration(left)} left")


def _left(run: Path, done: int, trials: int) -> float | None:
    """Seconds until the last trial is done, from those before; None as long as none has shown it."""
    rows = store.readable_trials(run)[0][1:][-LATEST:]
    took = [sum(v for k, v in store.phases(row).items() if k != "compile") for row in rows]
    if not took:
        return None
    since = time.time() - (run / "trials.jsonl").stat().st_mtime
    one = float(np.mean(took))
    return one * (trials - done - 1) + max(0.0, one - since)
