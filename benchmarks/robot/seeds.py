"""A command of pegasus-train for several seeds, a process each with a core of its own, on a robot of a folder.

The runs are in OUT without .json: the same command goes on with those that were stopped, by hand or after `minutes`.
"""

import json
import os
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks import Run, beside_runs, each, minutes, number, once
from benchmarks.plants_suite.__main__ import ONE_CORE, core_queue, on_core
from pegasus_jax.checks import ConfigError
from pegasus_jax.cli.sweep import PROGRAM
from pegasus_jax.runs.files import write_json
from pegasus_jax.runs.machine import about
from pegasus_jax.runs.study import SOLVED, first_solved, seed_list

OPTIONS = ("furuta", "seeds", "jobs", "out", "minutes", "trials")
KEPT = (
    *("trial", "plant_seconds", "log_seconds", "policy", "episode_cost", "mean_cost", "success_rate", "calibration"),
    "seconds",
)


def robot(options: dict[str, str]) -> Path:
    """The folder of robot.py, from which every run imports. Raises ConfigError where there is none."""
    if "furuta" not in options:
        raise ConfigError("furuta= is missing: the folder of robot.py; for example furuta=robots/furuta")
    folder = Path(options["furuta"]).absolute()
    if not (folder / "robot.py").is_file():
        raise ConfigError(f"furuta={folder} has no robot.py")
    ONE_CORE["PYTHONPATH"] += os.pathsep + str(folder)
    return folder


def learned(options: dict[str, str], words: Sequence[str], command: str) -> list[dict[str, Any]]:
    """The runs of all seeds with what is kept of their trials, written to `out` after each of them."""
    until = time.monotonic() + 60 * minutes(options, 9)
    seeds, jobs = seed_list(options.get("seeds", "100-109")), number(options, "jobs", 2)
    trials = f"trials={number(options, 'trials', 10)}"
    settings = [word for word in once(*words) if not word.startswith("trials=")]  # a run may go on for more trials
    (out, home, runs), told = beside_runs(options["out"], settings), about(command)
    words, cores = [*settings, trials], core_queue(jobs)
    for run in each(jobs, [partial(one, home / f"seed{s}", words, s, until, cores) for s in seeds]):
        runs = with_run(runs, run)
        write_json(out, {"runs": runs, "words": words, "about": told})
    return runs


def with_run(runs: Sequence[Run], run: Run) -> list[Run]:
    """The runs by their seeds, with a new one, which replaces that of its seed."""
    return sorted([*(old for old in runs if old["seed"] != run["seed"]), run], key=lambda run: run["seed"])


def one(run: Path, words: Sequence[str], seed: int, until: float, cores: Any) -> dict[str, Any]:
    """One run, begun or gone on with until a time, and its trials; `error` is the last line of a failure."""
    core = cores.get()
    try:
        if (left := until - time.monotonic()) < 10:
            return {"seed": seed, "error": "not begun", "trials": rows(run)}
        task = (
            [f"resume={run}", words[-1]] if (run / "config.yaml").exists() else [*words, f"seed={seed}", f"out={run}"]
        )
        error = on_core([*PROGRAM, *task], core, left)[1]
    finally:
        cores.put(core)
    print(f"seed {seed}: success {[row['success_rate'] for row in rows(run)]} {error or ''}", flush=True)
    return {"seed": seed, "error": error, "trials": rows(run)}


def rows(run: Path) -> list[dict[str, Any]]:
    """What is kept of the trials of a run."""
    path = run / "trials.jsonl"
    found = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    return [{name: row[name] for name in KEPT if name in row} for row in found]


def table(runs: Sequence[dict[str, Any]]) -> str:
    """A line a seed: the first trial of 90 % and the robot's time by then, then success trial by trial."""
    lines, rates = [], [[row["success_rate"] for row in run["trials"]] for run in runs]
    for run, success in zip(runs, rates, strict=True):
        first = first_solved(success)
        seconds = f"{run['trials'][first - 1]['plant_seconds']:g} s" if first else "-"
        shown = " ".join(f"{rate:4.0%}" for rate in success)
        lines.append(
            f"seed {run['seed']}  first >= {SOLVED:.0%}: trial {first or '-'}, after {seconds} of robot   {shown}"
        )
    ever = sum(first_solved(success) is not None for success in rates)
    last = sum(bool(success) and success[-1] >= SOLVED for success in rates)
    return "\n".join(
        [*lines, f"{ever} of {len(runs)} seeds reached {SOLVED:.0%}, {last} are there after their last trial"]
    )
