"""From a newcomer's command to a controller that works: wall-clock time of `pegasus-train` with its defaults.

    python -m benchmarks.speed.newcomer [task=cartpole] [seeds=0-9] [minutes=4] [jobs=1]

Starts `pegasus-train` once a seed, `jobs` at a time and each in an empty folder with an empty compilation cache, and
stops it as soon as a trial's evaluation succeeds in at least 90 % of its episodes, or after `minutes`. Writes
benchmarks/results/newcomer.json, unless a command failed. Times mean something only where nothing else runs; on Linux
the jobs share out the CPUs, each with its own.
"""

import json
import os
import shlex
import subprocess
import tempfile
import time
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from benchmarks import RESULTS, command, each, minutes, number
from pegasus_jax.checks import ConfigError, RunError
from pegasus_jax.cli.sweep import PROGRAM
from pegasus_jax.cli.train import understood
from pegasus_jax.runs import config_io
from pegasus_jax.runs.files import write_json
from pegasus_jax.runs.machine import about
from pegasus_jax.runs.store import trials
from pegasus_jax.runs.study import seed_list

Slots = SimpleQueue[set[int] | None]


def newcomer(seed: int, words: list[str], limit: float, slots: Slots) -> dict[str, Any]:
    """One seed: seconds until success, or None, and what every trial came to [T]. RunError where the command failed."""
    slot = slots.get()
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        env = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(Path(folder) / "cache")}
        began = time.monotonic()
        errors = Path(folder) / "errors"
        with errors.open("w") as file:
            command = [*PROGRAM, *words, f"seed={seed}", f"out={run}"]
            process = subprocess.Popen(command, env=env, stdout=subprocess.DEVNULL, stderr=file)
        if slot is not None:
            os.sched_setaffinity(process.pid, slot)
        solved, rows = None, []
        while solved is None and process.poll() is None and time.monotonic() - began < limit:
            time.sleep(0.2)
            rows = trials(run)
            if rows and rows[-1]["success_rate"] >= 0.9:
                solved = round(time.monotonic() - began, 1)
        failed = process.poll()
        process.kill()
        process.wait()
        slots.put(slot)
        if failed and solved is None:
            said = errors.read_text(errors="replace").splitlines() or ["no message"]
            raise RunError(f"seed {seed} ended with status {failed}: {said[-1]}")
    result = {"seed": seed, "seconds": solved, "success_rate": [row["success_rate"] for row in rows]}
    print(json.dumps(result), flush=True)
    return result


def main(words: list[str]) -> None:
    """The command line of this module."""
    options, rest = config_io.split(words, ("seeds", "minutes", "jobs"))
    jobs, limit = number(options, "jobs", 1), 60 * minutes(options, 4)
    train = [f"{key}={value}" for key, value in ({"task": "cartpole"} | rest).items()]
    slots: Slots = SimpleQueue()
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    for job in range(jobs):
        slots.put({*cores[job::jobs]} or None)
    if not understood(train)[0].config.eval_episodes:
        raise ConfigError("eval_episodes=0 says nothing of success; the nearest is 1")
    seeds = seed_list(options.get("seeds", "0-9"))
    found = each(jobs, [partial(newcomer, seed, train, limit, slots) for seed in seeds])
    results = sorted(found, key=lambda result: result["seed"])
    solved = [result["seconds"] for result in results if result["seconds"] is not None]
    print(f"{len(solved)} of {len(results)} solved within {limit:.0f} s, the slowest in {max(solved, default=0)} s")
    command = shlex.join(["python", "-m", "benchmarks.speed.newcomer", *words])
    write_json(RESULTS / "newcomer.json", {"runs": results, "about": about(command)})


if __name__ == "__main__":
    command(main, __doc__)
