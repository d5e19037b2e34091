"""How many seeds learn plants that nobody here wrote, with the preset that the documents name, after how much time.

    python -m benchmarks.plants_suite [plants=[Pendulum-v1,...]] [seeds=100-109] [jobs=2] [out=FILE] [minutes=60]
        [episodes=50] [setting=value ...]

Runs `pegasus-train` once for each plant and seed, `jobs` at a time with one core each, then judges the policy after
every trial by the environment's own reward over at most `episodes` (native.py). Writes one JSON, again after each run,
and prints one table. The runs are in OUT without .json: the same command goes on with those that were stopped, by hand
or after `minutes`; other settings need another OUT. Tuning seeds are 100 to 119; 200 and above are for a final judgment
only. Other settings are for all plants alike. The pendubot and the acrobot need a checkout of their simulator
(of_ai_olympics.py).
"""

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from benchmarks import beside_runs, command, each, minutes, number, once
from benchmarks.plants_suite.native import MOST
from benchmarks.plants_suite.plants import PLANTS
from pegasus_jax.checks import ConfigError, did_you_mean
from pegasus_jax.cli.sweep import PROGRAM
from pegasus_jax.runs import config_io
from pegasus_jax.runs.files import write_json
from pegasus_jax.runs.machine import about
from pegasus_jax.runs.study import seed_list

ROOT = Path(__file__).parents[2]
ONE_CORE = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
    "JAX_PLATFORMS": "cpu",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "PYTHONPATH": os.pathsep.join(
        [*(str(ROOT / name) for name in ("src", "envs", "")), os.environ.get("PYTHONPATH", "")]
    ),
}
JAX_NOTE = "For simplicity, JAX has removed"  # below the line that says what happened
SHARES = (0.25, 0.5, 0.75, 1.0)  # of the time by which a plant is to be learned, at which the table looks


def one(
    name: str, seed: int, home: Path, words: Sequence[str], minutes: float, episodes: int, cores: Any
) -> dict[str, Any]:
    """One run, learned or gone on with, and what its policies are worth; `error` is the last line of a failure."""
    plant, run, core, began = PLANTS[name], (home / f"{name}-{seed}").absolute(), cores.get(), time.monotonic()
    new = [f"env={plant.env}", *plant.words, f"seed={seed}", f"trials={plant.trials}", "eval_episodes=0", f"out={run}"]
    task = [f"resume={run}"] if (run / "config.yaml").exists() else once("task=gym", *new, *words)
    judge = [sys.executable, "-m", "benchmarks.plants_suite.native", str(run), plant.env, str(episodes)]
    try:
        learned, judged = on_core([*PROGRAM, *task], core, 60 * minutes), on_core(judge, core, None)
    finally:
        cores.put(core)
    rows = json.loads(judged[0].splitlines()[-1]) if judged[1] is None else []
    seconds, error = round(time.monotonic() - began, 1), learned[1] or judged[1]
    print(f"{name} seed {seed}, {seconds:.0f} s: {[row['native'] for row in rows]} {error or ''}", flush=True)
    return {"plant": name, "seed": seed, "seconds": seconds, "error": error, "trials": rows}


def core_queue(jobs: int) -> SimpleQueue[int | None]:
    """A core for each of so many jobs at a time, to be taken and put back; None where a process cannot be pinned."""
    own = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    cores: SimpleQueue[int | None] = SimpleQueue()
    for job in range(jobs):
        cores.put(own[job % len(own)] if own else None)
    return cores


def on_core(command: list[str], core: int | None, limit: float | None) -> tuple[str, str | None]:
    """What a command printed, and the last line of its error or None; it is interrupted after `limit` seconds."""
    pin = ["taskset", "-c", str(core)] if core is not None and shutil.which("taskset") else []
    pipes: dict[str, Any] = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    with subprocess.Popen([*pin, *command], cwd=ROOT, env=os.environ | ONE_CORE, **pipes) as process:
        try:
            said, failed = process.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            process.terminate()
            said, failed = process.communicate()
    lines = [line for line in failed.splitlines() if line.strip("- ") and not line.startswith(JAX_NOTE)]
    if process.returncode in (130, -signal.SIGINT):  # Ctrl-C went to it, too
        raise KeyboardInterrupt
    return said, None if process.returncode == 0 else (lines or ["no message"])[-1]


def share(runs: Sequence[dict[str, Any]], bar: float, until: float) -> float:
    """The share of runs whose newest policy within so many seconds of plant time has a native return at the bar."""
    newest = [[row["native"] for row in run["trials"] if row["plant_seconds"] <= until + 1e-6] for run in runs]
    return sum(bool(values) and values[-1] >= bar for values in newest) / max(1, len(runs))


def table(runs: Sequence[dict[str, Any]]) -> str:
    """A row for each plant: the share of its seeds at the bar, after parts of the time for it and at the end."""
    lines = [
        f"{'plant':28}{'bar':>8}{'by [s]':>8}{'seeds':>7}" + "".join(f"{f'{s:.0%}':>7}" for s in SHARES) + "    end"
    ]
    for name, plant in PLANTS.items():
        if own := [run for run in runs if run["plant"] == name]:
            at = [*(part * plant.by for part in SHARES), float("inf")]
            shares = "".join(f"{share(own, plant.bar, until):7.0%}" for until in at)
            lines.append(f"{name:28}{plant.bar:8g}{plant.by:8g}{len(own):7}{shares}")
    return "\n".join(lines)


def main(given: list[str]) -> None:
    """The command line of this module. Raises ConfigError for plants and seeds that are not for this."""
    options, rest = config_io.split(given, ("plants", "seeds", "jobs", "out", "minutes", "episodes"))
    names = options["plants"].strip("[]").split(",") if "plants" in options else [*PLANTS]
    seeds = seed_list(options.get("seeds", "100-109").strip("[]"))
    if wrong := [name for name in names if name not in PLANTS]:
        raise ConfigError(f"plants={wrong[0]} is unknown; {did_you_mean(wrong[0], PLANTS)}")
    jobs, limit, episodes = number(options, "jobs", 2), minutes(options, 60), number(options, "episodes", MOST)
    words = [f"{key}={value}" for key, value in rest.items()]
    out, home, there = beside_runs(options.get("out", "runs/plants_suite.json"), words)
    told = about(shlex.join(["python", "-m", "benchmarks.plants_suite", *given]))
    same, runs = (home, words, limit, episodes, core_queue(jobs)), {(run["plant"], run["seed"]): run for run in there}
    for run in each(jobs, [partial(one, name, seed, *same) for seed in seeds for name in names]):
        runs[run["plant"], run["seed"]] = run
        write_json(out, {"runs": [*runs.values()], "about": told})
    print(table([*runs.values()]))


if __name__ == "__main__":
    command(main, __doc__)
