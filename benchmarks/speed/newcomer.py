"""From a newcomer's command to a controller that works: wall-clock time of `pegasus-train` with its defaults.

    python -m benchmarks.speed.newcomer [task=cartpole] [seeds=0-9] [minutes=4] [jobs=1]

Starts `pegasus-train` once a seed, `jobs` at a time and each in an empty folder with an empty compilation cache, and
stops it as soon as a trial's evaluation succeeds in at least 90 % of its episodes, or after `minutes`. Writes
benchmarks/results/newcomer.json. Times mean something only where nothing else runs; on Linux the jobs share out the
CPUs, each with its own.
"""

import json
import os
import shlex
import subprocess
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from benchmarks import RESULTS, command
from pegasus_jax.cli.sweep import PROGRAM
from pegasus_jax.runs import config_io
from pegasus_jax.runs.machine import about
from pegasus_jax.runs.store import trials
from pegasus_jax.runs.study import seed_list

Slots = SimpleQueue[set[int] | None]


def newcomer(seed: int, words: list[str], limit: float, slots: Slots) -> dict[str, Any]:
    """One seed: seconds until success, or None, and what every trial came to [T]."""
    slot = slots.get()
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        env = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(Path(folder) / "cache")}
        began = time.monotonic()
        process = subprocess.Popen(
            [*PROGRAM, *words, f"seed={seed}", f"out={run}"],
            env=env,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        if slot is not None:
            os.sched_setaffinity(process.pid, slot)
        solved, rows = None, []
        while solved is None and process.poll() is None and time.monotonic() - began < limit:
            time.sleep(0.2)
            rows = trials(run)
            if rows and rows[-1]["success_rate"] >= 0.9:
                solved = round(time.monotonic() - began, 1)
        process.kill()
        process.wait()
    slots.put(slot)
    result = {"seed": seed, "seconds": solved, "success_rate": [row["success_rate"] for row in rows]}
    print(json.dumps(result), flush=True)
    return result


def main(words: list[str]) -> None:
    """The command line of this module."""
    options, rest = config_io.split(words, ("seeds", "minutes", "jobs"))
    jobs, limit = int(options.get("jobs", "1")), 60 * float(options.get("minutes", "4"))
    train = [f"{key}={value}" for key, value in ({"task": "cartpole"} | rest).items()]
    slots: Slots = SimpleQueue()
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    for job in range(jobs):
        slots.put({*cores[job::jobs]} or None)
    with ThreadPoolExecutor(jobs) as pool:
        seeds = seed_list(options.get("seeds", "0-9"))
        results = list(pool.map(lambda seed: newcomer(seed, train, limit, slots), seeds))
    solved = [result["seconds"] for result in results if result["seconds"] is not None]
    print(f"{len(solved)} of {len(results)} solved within {limit:.0f} s, the slowest in {max(solved, default=0)} s")
    command = shlex.join(["python", "-m", "benchmarks.speed.newcomer", *words])
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "newcomer.json").write_text(json.dumps({"runs": results, "about": about(command)}) + "\n")


if __name__ == "__main__":
    command(main, __doc__)
