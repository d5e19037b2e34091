"""Learning studies: every seed of a configuration in one vmapped program, every curve kept raw."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pegasus_jax import sharding
from pegasus_jax.checks import SIZES, ConfigError, different
from pegasus_jax.config import Config
from pegasus_jax.runs import begin, config_io, logged, writers
from pegasus_jax.runs.files import write_whole
from pegasus_jax.runs.job import first_states, opened
from pegasus_jax.runs.store import SOLVED
from pegasus_jax.runs.train import learn
from pegasus_jax.runs.writers import Row, Writer
from pegasus_jax.task import Task
from pegasus_jax.types import RunState

# The curves [S, T] of a study that are rounded, by the names that they have in a row of trials.jsonl too.
ROUNDED = ("mean_cost", "episode_cost", "objective_last", "objective_fresh", "saturated", "calibration")


def study(config: Config, seeds: list[int], path: Path | None = None) -> dict[str, Any]:
    """Curves [S, T] of a configuration over seeds; written to `path` after every trial, so that nothing is lost.

    The seeds learn what `pegasus-train` would learn with them (runs/train.py); `curves` says what is kept. Raises
    ConfigError for a plant that cannot be vmapped.
    """
    if config.env is not None:
        one = "its environment is one object; use pegasus-train"
        raise ConfigError(f"task={config.task} cannot be studied as one program: {one}")
    if not config.eval_episodes:
        raise ConfigError("eval_episodes=0 leaves a study nothing to compare; the nearest is 1")
    result: dict[str, Any] = {}

    def keep(latest: dict[str, Any]) -> None:
        result.update(latest)
        if path is not None:
            write(path, result)

    logs = logged.of_config(config)
    with opened(config, seeds, sharding.evenly(len(seeds)), logs) as job:
        job = job._replace(writer=one_json(config, seeds, job.experiment.task, keep))
        learn(job, begin.begun(first_states(job), config))
    return result


def one_json(config: Config, seeds: list[int], task: Task, keep: Callable[[dict[str, Any]], None]) -> Writer:
    """A writer that hands the curves of all seeds so far to `keep` after each trial, with how long they took.

    A seed whose model or policy diverges has null in its curves from then on; the study goes on.
    """
    trials: list[list[Row]] = []
    began = time.monotonic()

    def trial(number: int, states: RunState, rows: list[Row]) -> None:
        trials.append(rows)
        compiling = sum(rows[0]["seconds"]["compile"] for rows in trials)
        running = time.monotonic() - began - compiling
        clock = {"compile_seconds": round(compiling, 1), "run_seconds": round(running, 1)}
        keep(curves(config, seeds, trials, task) | clock)

    return writers.nothing(len(seeds))._replace(trial=trial)


def curves(config: Config, seeds: list[int], trials: list[list[Row]], task: Task) -> dict[str, Any]:
    """What is kept of the trials so far, each a row a seed (docs/understanding.md explains the curves)."""

    def of(name: str) -> list[list[Any]]:
        return [[rows[index][name] for rows in trials] for index in range(len(seeds))]

    return {
        "seeds": seeds,
        # On average: episodes that end early are not all as long.
        "plant_seconds": np.round(np.mean(of("plant_seconds"), 0), 6).tolist(),
        **{name: rounded(of(name)) for name in ROUNDED},
        "success_rate": of("success_rate"),
        "skipped_updates": of("skipped_updates"),
        "config": config_io.plain(config_io.numbered(config, len(task.state_names))),
    }


def rounded(values: Any) -> list[list[float | None]]:
    """Numbers [S, T] to four decimals; None for one that is not known, because JSON has no NaN."""
    return [[None if np.isnan(v) else round(float(v), 4) for v in row] for row in np.asarray(values, float)]


def write(path: Path, result: dict[str, Any]) -> None:
    """Write a study's JSON; it appears whole or not at all."""
    write_whole(path, lambda file: file.write(json.dumps(result).encode() + b"\n"))


def first_solved(success_rate: list[float]) -> int | None:
    """The first trial (from 1) of a seed that is solved."""
    return next((t for t, rate in enumerate(success_rate, 1) if rate >= SOLVED), None)


def table(result: dict[str, Any]) -> str:
    """One line a seed: first trial solved, then success and cost trial by trial."""
    lines, every = [], np.asarray(result["mean_cost"], float)
    for seed, success, cost in zip(result["seeds"], result["success_rate"], every, strict=True):
        rates, costs = " ".join(f"{s:4.0%}" for s in success), " ".join(f"{c:.2f}" for c in cost)
        lines.append(f"seed {seed:>3}  first >= {SOLVED:.0%}: {first_solved(success) or '-':>2}  {rates}  | {costs}")
    mean = np.mean(every, 0)
    solved = np.mean(np.asarray(result["success_rate"]) >= SOLVED, 0)
    lines.append(
        "mean cost  " + " ".join(f"{c:.2f}" for c in mean) + "  | solved " + " ".join(f"{s:.2f}" for s in solved)
    )
    return "\n".join(lines)


def seed_list(text: str) -> list[int]:
    """Seeds of '0-9' or '0,3,7'. Raises ConfigError for anything else."""
    first, dash, last = text.partition("-")
    try:
        seeds = (
            list(range(int(first), min(int(last), int(first) + SIZES["trials"]) + 1))
            if dash
            else [int(part) for part in text.split(",")]
        )
    except ValueError:
        seeds = []
    if not seeds or min(seeds) < 0 or len(seeds) > SIZES["trials"]:
        raise ConfigError(
            f"seeds={text} names no seeds, or more than {SIZES['trials']:,}; for example seeds=0-9 or seeds=0,3,7"
        )
    different("seeds", tuple(seeds))
    return seeds
