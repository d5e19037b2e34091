"""A Furuta pendulum learned from ten logs of a hand-written controller, without a random episode.

    python -m benchmarks.robot.logs furuta=FOLDER [seeds=100-109] [jobs=2] [out=FILE] [minutes=9] [trials=10]
        [random=true] [setting=value ...]

FOLDER holds `robot.py`, which registers FurutaSafe-v0 and has its `cost`, and `logs/*.csv`, ten episodes of 2 s. Trial
1 is the logs; its policy is evaluated before the robot has run one episode of its own. `random=true` learns the same
without logs, from one random episode. `jobs` runs at a time have a core each. One JSON is written after each run, and
the same command goes on with runs that were stopped after `minutes`. Tuning seeds are 100 to 119.
"""

import json
import os
import shlex
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from benchmarks.plants_suite.__main__ import ONE_CORE, on_core
from pegasus_jax.checks import ConfigError
from pegasus_jax.cli.sweep import PROGRAM
from pegasus_jax.runs import config_io
from pegasus_jax.runs.files import write_json
from pegasus_jax.runs.machine import about
from pegasus_jax.runs.study import SOLVED, first_solved, seed_list

TASK = (
    *("task=gym", "env=robot:FurutaSafe-v0", "cost=robot:cost", "angles=[1]", "horizon=100", "eval_episodes=10"),
    *("start_mean=[0,0,0,0,0]", "start_std=[0.02,0.02,0.01,0.01,0.01]"),
)
KEPT = ("trial", "plant_seconds", "log_seconds", "policy", "episode_cost", "mean_cost", "success_rate", "seconds")


def one(run: Path, words: Sequence[str], seed: int, trials: int, until: float, cores: Any) -> dict[str, Any]:
    """One run, begun or gone on with until a time, and its trials; `error` is the last line of a failure."""
    core = cores.get()
    try:
        if (left := until - time.monotonic()) < 10:
            return {"seed": seed, "error": "not begun", "trials": rows(run)}
        begun = (run / "config.yaml").exists()
        task = [f"resume={run}", f"trials={trials}"] if begun else [*words, f"seed={seed}", f"trials={trials}"]
        error = on_core([*PROGRAM, *task, *([] if begun else [f"out={run}"])], core, left)[1]
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
    """A line a seed: the first trial of 90 %, and success trial by trial; trial 1 has no own episode before it."""
    lines = []
    for run in sorted(runs, key=lambda run: run["seed"]):
        success = [row["success_rate"] for row in run["trials"]]
        first = first_solved(success)
        seconds = f"{run['trials'][first - 1]['plant_seconds']:g} s" if first else "-"
        rates = " ".join(f"{rate:4.0%}" for rate in success)
        lines.append(
            f"seed {run['seed']}  first >= {SOLVED:.0%}: trial {first or '-'}, after {seconds} of robot   {rates}"
        )
    last = [run["trials"][-1]["success_rate"] >= SOLVED for run in runs if run["trials"]]
    ever = [any(row["success_rate"] >= SOLVED for row in run["trials"]) for run in runs]
    lines.append(f"{sum(ever)} of {len(runs)} seeds reached {SOLVED:.0%}, {sum(last)} are there after their last trial")
    return "\n".join(lines)


def main(given: list[str]) -> None:
    """The command line of this module. Raises ConfigError for what it cannot use."""
    names = ("furuta", "seeds", "jobs", "out", "minutes", "trials", "random")
    options, rest = config_io.split(given, names)
    folder = Path(options.get("furuta", ".")).absolute()
    if not (folder / "robot.py").is_file():
        raise ConfigError(f"furuta={folder} has no robot.py")
    ONE_CORE["PYTHONPATH"] += os.pathsep + str(folder)
    began, random = time.monotonic(), options.get("random") == "true"
    until = began + 60 * float(options.get("minutes", "9"))
    out, trials = Path(options.get("out", "runs/logs.json")).absolute(), int(options.get("trials", "10"))
    logs = ["explore.trials=1"] if random else [f"data={folder}/logs/*.csv", "explore.trials=0"]
    words = [*TASK, *logs, *(f"{key}={value}" for key, value in rest.items())]
    own = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    jobs, cores = int(options.get("jobs", "2")), SimpleQueue[int | None]()
    for job in range(jobs):
        cores.put(own[job % len(own)] if own else None)
    (home := out.with_suffix("")).mkdir(parents=True, exist_ok=True)
    told, runs = about(shlex.join(["python", "-m", "benchmarks.robot.logs", *given])), list[dict[str, Any]]()
    with ThreadPoolExecutor(jobs) as pool:
        seeds = seed_list(options.get("seeds", "100-109"))
        waiting = [pool.submit(one, home / f"seed{s}", words, s, trials, until, cores) for s in seeds]
        for job in as_completed(waiting):
            runs.append(job.result())
            write_json(out, {"runs": runs, "words": words, "about": told})
    print(table(runs))


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except ConfigError as error:
        sys.exit(f"logs: {error}")
