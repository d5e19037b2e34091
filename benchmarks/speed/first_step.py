"""How long a user waits: seconds from the command `pegasus-train` to its first search iterations done.

    python -m benchmarks.speed.first_step [repeats=3] [setting=value ...]

With an empty folder for compiled programs and then with the one that the first run filled; each run is a process of its
own, killed when the first chunk of its search is done. Writes benchmarks/results/first_step.json: the total, and what
each part took: `compile` is how long the run waited for compiling, `before` everything up to the first part (imports,
settings, building), `cpu` CPU time of all threads. On a machine that others use too, compare that.
"""

import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from typing import Any

from benchmarks import command, number
from pegasus_jax.checks import ConfigError

STARTED = "PEGASUS_STARTED"  # when the command was given [s since 1970]


def watched() -> None:
    """`pegasus-train` in this process, whose parts are timed; ends it after the first part of a search."""
    began, words = float(os.environ[STARTED]), sys.argv[1:]
    from pegasus_jax.cli import main as cli

    cli._remember_compilations()  # as the command does, before the next line imports JAX
    from pegasus_jax.runs import programs

    run, spent = programs.Program.__call__, {}

    def timed(self: Any, part: str, *arguments: Any, **options: Any) -> Any:
        entered = time.time()
        spent.setdefault("before", entered - began)
        result = run(self, part, *arguments, **options)
        compiling = self.parts[part].seconds if part not in spent else 0.0
        spent[part] = spent.get(part, 0.0) + time.time() - entered - compiling
        spent[f"compile {part}"] = spent.get(f"compile {part}", 0.0) + compiling
        if part == "search":
            print(json.dumps({"total": time.time() - began, "cpu": time.process_time(), **spent}), flush=True)
            os._exit(0)
        return result

    programs.Program.__call__ = timed  # type: ignore[method-assign]
    sys.argv = ["pegasus-train", *words]
    cli.train()


def once(words: list[str], cache: str) -> dict[str, float]:
    """Seconds of one run of the command, with that folder of compiled programs."""
    child = [sys.executable, "-c", "from benchmarks.speed.first_step import watched; watched()"]
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "XDG_CACHE_HOME": cache, STARTED: str(time.time())}
        done = subprocess.run([*child, *words, f"out={folder}/run"], env=environment, capture_output=True, text=True)
    if done.returncode:
        raise ConfigError((done.stderr.splitlines() or ["pegasus-train failed without a message"])[-1])
    return json.loads(done.stdout)


def main(words: list[str]) -> None:
    """The command line of this module."""
    from benchmarks import RESULTS  # here: what this module imports, the measured process waits for
    from pegasus_jax.runs import config_io
    from pegasus_jax.runs.files import write_json
    from pegasus_jax.runs.machine import about, cpus

    options, rest = config_io.split(words, ("repeats",))
    train = [f"{key}={value}" for key, value in ({"task": "cartpole"} | rest).items()]
    rows: dict[str, list[dict[str, float]]] = {"cold": [], "warm": []}
    for _ in range(number(options, "repeats", 3)):
        with tempfile.TemporaryDirectory() as cache:
            for name, runs in rows.items():
                runs.append(once(train, cache))
                print(name, json.dumps({part: round(seconds, 2) for part, seconds in runs[-1].items()}), flush=True)
    result: dict[str, Any] = {name: min(runs, key=lambda run: run["total"]) for name, runs in rows.items()}
    result |= {"runs": rows, "cpus": cpus()}
    result["about"] = about(shlex.join(["python", "-m", "benchmarks.speed.first_step", *words]))
    write_json(RESULTS / "first_step.json", result)


if __name__ == "__main__":
    command(main, __doc__)
