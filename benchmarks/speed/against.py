"""Two checkouts against each other: is the newer one as fast, as small and as soon ready as the older one?

    python -m benchmarks.speed.against OLD NEW [rounds=4] [steps=20] [processes=5] [core=0] [sizes=A,B] [out=FILE]

OLD and NEW are folders. Everything runs in turn, old and new, new and old, on one CPU core, and counts CPU seconds, so
that it may share a machine with others. A ratio is new over old, pair by pair; the table has its median with the 95 %
bootstrap interval. Steps: `rounds` times two new processes, each of which then does `steps` searches and fits in turn,
because two processes of one program differ by a few percent. A checkout against itself says what is noise. Beside that,
`processes` pairs of what a process does from its start: an import, a refused command, a command's first search steps.
"""

import json
import os
import resource
import shlex
import statistics
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

DEFAULT = {"default": {"task": "cartpole"}}  # beside the sizes of workloads.py: what a first command learns with
SIZES = "default,cart-pole,double cart-pole"
OPTIONS = ("rounds", "steps", "processes", "core", "sizes", "out")
COMMAND = ("python", "-m", "benchmarks.speed.against")
STEPS = {"search": 10, "fit": 100}  # in one timed run
Row = dict[str, Any]
Pair = tuple[list[float], list[float]]  # of the old and of the new, one for each pair


# In a process of one checkout


def module(name: str) -> Any:
    """A benchmark's module of the checkout that this process belongs to, which may be older than its folder."""
    for folder in ("benchmarks.speed", "benchmarks"):
        try:
            return import_module(f"{folder}.{name}")
        except ModuleNotFoundError:
            pass
    raise ModuleNotFoundError(f"no {name} in this checkout's benchmarks")


def serve(size: str) -> None:
    """Compile a search and a fit, say how long each took, and run what the lines of standard input name.

    Each is answered with its CPU seconds, `memory` with the peak memory [MB].
    """
    import jax.numpy as jnp

    timing, workloads = module("timing"), module("workloads")
    work = workloads.workload((DEFAULT | workloads.SIZES)[size])
    calls: dict[str, tuple[Any, ...]] = {
        "fit": (partial(work.experiment.fit, steps=STEPS["fit"]), work.state),
        "search": (partial(work.experiment.search, steps=STEPS["search"]), work.state, jnp.int32(1)),
    }
    programs = {name: timing.compiled(*call) for name, call in calls.items()}
    print(json.dumps({name: row["trace_s"] + row["compile_s"] for name, (_, row) in programs.items()}), flush=True)
    for line in sys.stdin:
        name, began = line.strip(), time.process_time()
        if name == "memory":
            print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, flush=True)
        else:
            programs[name][0]()
            print(time.process_time() - began, flush=True)


# In the process that compares


def environment(checkout: Path, **more: Any) -> dict[str, str]:
    """A process's variables that make it one of this checkout."""
    path = os.pathsep.join(str(checkout / folder) for folder in ("src", "envs", "."))
    return {**os.environ, "PYTHONPATH": path, **more}


class Living:
    """A process of a checkout that does one thing at a time when it is asked to."""

    def __init__(self, checkout: Path, size: str) -> None:
        command = [sys.executable, "-P", __file__, "serve", size]
        pipes: dict[str, Any] = dict(stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.process = subprocess.Popen(command, cwd=checkout, env=environment(checkout), **pipes)
        self.compiled: dict[str, float] = json.loads(self.answer())  # [s]

    def answer(self) -> str:
        line = self.process.stdout.readline().strip()  # pyright: ignore[reportOptionalMemberAccess]
        if not line:
            raise RuntimeError(f"a process ended with status {self.process.wait()}")
        return line

    def __call__(self, name: str) -> float:
        print(name, file=self.process.stdin, flush=True)
        return float(self.answer())


def ended(checkout: Path, program: str, *words: str, fails: bool = False, **more: Any) -> tuple[float, float]:
    """CPU seconds and peak memory [MB] of a Python program from its start to its end. RuntimeError unless as told."""
    command = [sys.executable, "-c", program, *words]
    quiet: dict[str, Any] = dict(stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    process = subprocess.Popen(command, cwd=checkout, env=environment(checkout, **more), **quiet)
    _, status, used = os.wait4(process.pid, 0)
    if (os.waitstatus_to_exitcode(status) != 0) != fails:
        raise RuntimeError(f"{checkout}: {shlex.join(command)} ended with status {os.waitstatus_to_exitcode(status)}")
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def entry(checkout: Path) -> str:
    """A program that is the checkout's pegasus-train."""
    scripts = tomllib.loads((checkout / "pyproject.toml").read_text())["project"]["scripts"]
    where, _, function = scripts["pegasus-train"].partition(":")
    return f"from {where} import {function}; {function}()"


def first_steps(checkout: Path, cache: str) -> tuple[float, float]:
    """CPU seconds and peak memory [MB] of pegasus-train task=cartpole until its first search steps are done."""
    name = next(name for name in ("benchmarks.speed.first_step", "benchmarks.first_step") if there(checkout, name))
    with tempfile.TemporaryDirectory() as folder:
        more: dict[str, Any] = {"XDG_CACHE_HOME": cache, "PEGASUS_STARTED": str(time.time())}
        return ended(checkout, f"from {name} import watched; watched()", "task=cartpole", f"out={folder}/run", **more)


def there(checkout: Path, name: str) -> bool:
    return checkout.joinpath(*name.split(".")).with_suffix(".py").exists()


def in_turn(old: Callable[[], Any], new: Callable[[], Any], pairs: int) -> tuple[list[Any], list[Any]]:
    """What both say, `pairs` times each: old and new, then new and old."""
    said: tuple[list[Any], list[Any]] = ([], [])
    for pair in range(pairs):
        for which in ((0, 1), (1, 0))[pair % 2]:
            said[which].append((old, new)[which]())
    return said


def living(checkouts: tuple[Path, Path], size: str, rounds: int, pairs: int) -> dict[str, Pair]:
    """Milliseconds of a search step and of a fit step of this size, seconds to compile them, peak memory [MB]."""
    rows: dict[str, Pair] = {}
    for number in range(rounds):
        first, second = checkouts if number % 2 == 0 else checkouts[::-1]
        started = [Living(first, size), Living(second, size)]
        old, new = started if number % 2 == 0 else started[::-1]
        for name, found in one_round(old, new, pairs).items():
            for every, some in zip(rows.setdefault(f"{name}, {size}", ([], [])), found, strict=True):
                every.extend(some)
        for one in started:
            one.process.communicate()
    return rows


def one_round(old: Living, new: Living, pairs: int) -> dict[str, Pair]:
    """What two processes say; the first run of each program is not counted."""
    found: dict[str, Pair] = {}
    for name, steps in STEPS.items():
        before, after = in_turn(partial(old, name), partial(new, name), pairs + 1)
        found[f"a {name} step [ms]"] = [1e3 * s / steps for s in before[1:]], [1e3 * s / steps for s in after[1:]]
        found[f"compiling a {name} [s]"] = [old.compiled[name]], [new.compiled[name]]
    return found | {"peak memory of both [MB]": ([old("memory")], [new("memory")])}


def processes(checkouts: tuple[Path, Path], pairs: int) -> dict[str, Pair]:
    """CPU seconds, and the memory [MB], of what a process does from its start."""
    rows: dict[str, Pair] = {}
    starts = {
        "import pegasus_jax": lambda checkout: ended(checkout, "import pegasus_jax"),
        "import what builds an experiment": lambda checkout: ended(checkout, "import pegasus_jax; pegasus_jax.build"),
        "a refused command": lambda checkout: ended(checkout, entry(checkout), "serach.steps=5", fails=True),
    }
    for name, start in starts.items():
        found = in_turn(partial(start, checkouts[0]), partial(start, checkouts[1]), 2 * pairs)
        rows[f"{name} [s]"] = part(found, 0)
    found = in_turn(partial(cold_and_warm, checkouts[0]), partial(cold_and_warm, checkouts[1]), pairs)
    for index, kind in enumerate(("nothing compiled before", "all compiled before")):
        used = part(found, index)
        rows[f"to the first search steps, {kind} [s]"] = part(used, 0)
        rows[f"peak memory of that, {kind} [MB]"] = part(used, 1)
    return rows


def cold_and_warm(checkout: Path) -> list[tuple[float, float]]:
    """A command's first search steps with an empty folder for compiled programs, and with what that left there."""
    with tempfile.TemporaryDirectory() as cache:
        return [first_steps(checkout, cache) for _ in range(2)]


def part(found: tuple[list[Any], list[Any]], index: int) -> tuple[list[Any], list[Any]]:
    """One of the numbers that both said."""
    return [said[index] for said in found[0]], [said[index] for said in found[1]]


def judged(old: list[float], new: list[float]) -> Row:
    """Medians, and the median of the ratios with its 95 % bootstrap interval."""
    ratios = np.asarray(new) / np.asarray(old)
    samples = np.random.default_rng(0).choice(ratios, (2000, len(ratios)))
    low, high = np.percentile(np.median(samples, 1), (2.5, 97.5))
    row = {"old": statistics.median(old), "new": statistics.median(new), "ratio": float(np.median(ratios))}
    return {**row, "low": float(low), "high": float(high), "pairs": len(ratios)}


def table(rows: dict[str, Row]) -> str:
    """The rows as Markdown."""
    lines = ["| CPU time, or memory | old | new | new / old | pairs |", "|---|---|---|---|---|"]
    for name, row in rows.items():
        ratio = f"{row['ratio']:.3f} [{row['low']:.3f}, {row['high']:.3f}]"
        lines.append(f"| {name} | {row['old']:.3g} | {row['new']:.3g} | {ratio} | {row['pairs']} |")
    return "\n".join(lines)


def main(words: list[str]) -> None:
    """The command line of this module."""
    from benchmarks import number, only, writable  # here: serving, this file belongs to another checkout
    from benchmarks.speed.workloads import SIZES as KNOWN
    from pegasus_jax.checks import ConfigError, choice
    from pegasus_jax.runs.files import write_json
    from pegasus_jax.runs.machine import about

    folders = [Path(word).resolve() for word in words if "=" not in word]
    if len(folders) != 2:
        raise ConfigError(f"name two checkouts, OLD and NEW, not {len(folders)}")
    for folder in folders:
        if not (folder / "src" / "pegasus_jax").is_dir():
            raise ConfigError(f"{folder} is not a checkout: it has no src/pegasus_jax")
    checkouts = folders[0], folders[1]
    given = only([word for word in words if "=" in word], OPTIONS)
    rounds, steps = number(given, "rounds", 4), number(given, "steps", 20)
    pairs, core = number(given, "processes", 5, 0), number(given, "core", 0, 0)
    sizes = [size for size in given.get("sizes", SIZES).split(",") if size]
    for size in sizes:
        choice("sizes", size, DEFAULT | KNOWN)
    choice("core", core, sorted(os.sched_getaffinity(0)))
    os.sched_setaffinity(0, {core})  # and of every process that it starts
    out = writable(given["out"]) if given.get("out") else None
    rows: dict[str, Row] = {}

    def keep(found: dict[str, Pair]) -> None:
        new = {name: judged(*pair) for name, pair in found.items()}
        rows.update(new)
        print(table(new), flush=True)
        if out is not None:
            told = about(shlex.join([*COMMAND, "OLD", "NEW", *map("=".join, given.items())]))
            write_json(out, {"rows": rows, "about": told})

    if pairs:
        keep(processes(checkouts, pairs))
    for size in sizes:
        keep(living(checkouts, size, rounds, steps))


if __name__ == "__main__":
    if sys.argv[1:2] == ["serve"]:
        serve(sys.argv[2])
    else:
        from benchmarks import command  # here: serving, this file belongs to another checkout

        command(main, __doc__)
