"""Kills at random file operations: python -m tests.campaigns.kills cases=1000

A run is killed several times, resumed each time, and must end as the run that nobody killed. The kill is at the nth
operation that changes the run's folder (before it, after it, or with half of its bytes written), or at any moment.
In other runs the disk is full from the nth operation on, and then has room again. Needs a C compiler and Linux.
"""

from __future__ import annotations

import ctypes
import json
import os
import random
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from tests.campaigns import common
from tests.campaigns.common import RUN, TRIALS, Outcome

MODES = ("before", "after", "half", "full")  # in the order of interpose.c
STARTING = 20  # operations before a first trial, at least
A_RUN = 10  # kills of one run, at most
SOURCE = Path(__file__).with_name("interpose.c")
LOADED = "PEGASUS_INTERPOSE"  # where the library is, in the process that has it


def library(folder: Path) -> Path:
    """interpose.c, compiled."""
    made = folder / "interpose.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", "-o", str(made), str(SOURCE), "-ldl"], check=True)
    return made


def counted(run: Path, *words: str, at: int = 0, mode: str = "before", **limits: float) -> tuple[Outcome, list[str]]:
    """pegasus-train, its operations on `run` counted; its end, and the operations."""
    log, train = run.parent / f"{run.name}.log", common.entry("pegasus-train")
    log.unlink(missing_ok=True)

    def work() -> None:
        os.chdir(run.parent)
        sys.argv = ["pegasus-train", *words]
        arm = ctypes.CDLL(os.environ[LOADED]).interpose_arm
        arm.argtypes = [ctypes.c_char_p, ctypes.c_long, ctypes.c_int, ctypes.c_char_p]
        arm(os.fsencode(run), at, MODES.index(mode), os.fsencode(log))
        train()  # type: ignore[misc]

    ended = common.forked(work, limits.pop("limit", 120.0), **limits)
    return ended, log.read_text(errors="replace").splitlines() if log.exists() else []


def go_on(run: Path) -> list[str]:
    """The words that go on with a run, or begin it when it was killed before it was one."""
    return [f"resume={run}"] if (run / "config.yaml").exists() else [*RUN, f"out={run}"]


def episodes(run: Path) -> dict[str, tuple[bytes, int]]:
    """Content and time of every episode's file."""
    return {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in (run / "episodes").glob("*.npz")}


def rows_of(run: Path) -> list[dict[str, Any]]:
    """trials.jsonl without the clock."""
    rows = [json.loads(line) for line in (run / "trials.jsonl").read_text().splitlines()]
    return [{name: value for name, value in row.items() if name != "seconds"} for row in rows]


def leftovers(run: Path) -> list[str]:
    """Temporary files, by name."""
    hidden = [path for path in run.rglob(".*") if path.name != ".lock"]
    return sorted(str(path.relative_to(run)) for path in [*hidden, *run.rglob("*.orbax-checkpoint-tmp*")])


def fingerprint(run: Path) -> str:
    """What pegasus-eval says of the end of a run, or how it failed."""
    ended = common.command("pegasus-eval", run, "trial=last", "episodes=1", "json=true", cwd=run.parent)
    try:
        return json.loads(ended.out.splitlines()[-1])["fingerprint"]
    except (IndexError, ValueError, KeyError):
        return common.last_line(ended.err)


def compared(run: Path, whole: Path) -> dict[str, int]:
    """How the end of a run that was killed differs from that of the run that was not."""
    same = {name: bytes_ for name, (bytes_, _) in episodes(run).items()}
    right = {name: bytes_ for name, (bytes_, _) in episodes(whole).items()}
    return {
        "episodes that differ": sum(same.get(name) != content for name, content in right.items()),
        "fingerprints that differ": int(fingerprint(run) != (whole / "fingerprint").read_text()),
        "trials.jsonl that differ": int(rows_of(run) != rows_of(whole)),
        "temporary files left": len(leftovers(run)),
    }


def one_run(case: dict[str, Any], folder: Path, operations: int) -> dict[str, Any]:
    """Kill a run up to `A_RUN` times, let it end, compare. A full disk counts as one way to stop it."""
    draw, run = random.Random(case["seed"]), folder / f"run{case['seed']}"
    found, delivered, problems = Counter(), Counter(), []
    for _ in range(case["kills"]):
        before = episodes(run)
        mode = draw.choice([*MODES[:3], *MODES[:3], "time", "full"] if case["disks"] else [*MODES[:3] * 2, "time"])
        done = len(list((run / "checkpoints").glob("[0-9]*.json")))
        # Most of them in the trial that comes next; a kill behind the last operation would be none.
        at = draw.randint(1, STARTING + (operations - STARTING) // TRIALS * min(TRIALS - done, draw.choice([1, 1, 2])))
        if mode == "time":
            ended, log = counted(run, *go_on(run), kill_after=draw.uniform(0.2, 3.0))
        else:
            ended, log = counted(run, *go_on(run), at=at, mode=mode)
        told = f"run {case['seed']}, {mode} of operation {log[-1] if log else 'none'}"
        delivered[mode] += ended.status != 0 if mode == "full" else ended.status == -9
        kept = episodes(run)
        found["episodes lost or rewritten"] += sum(kept.get(name) != content for name, content in before.items())
        if ended.traceback or not (ended.status in (0, -9) or (mode == "full" and ended.refusal)):
            found["tracebacks or refusals"] += 1
            problems.append(f"{told}: status {ended.status}, {common.last_line(ended.err)}")
        if ended.status == 0:
            break
    ended, log = counted(run, *go_on(run))
    if ended.status or ended.traceback:
        found["tracebacks or refusals"] += 1
        problems.append(f"{told}: then status {ended.status}, {common.last_line(ended.err)}")
    else:
        found.update(compared(run, folder / "whole"))
    problems += [f"{told}: {count} {what}" for what, count in found.items() if count and what not in str(problems)]
    if not problems:
        shutil.rmtree(run)
    return {"delivered": delivered, "found": found, "problems": problems}


WRONG = (
    "episodes lost or rewritten",
    "episodes that differ",
    "fingerprints that differ",
    "trials.jsonl that differ",
    "tracebacks or refusals",
    "temporary files left",
)


def run(folder: Path, cases: int, seed: int, jobs: int, disks: int) -> dict[str, Any]:
    """Runs until `cases` kills have been delivered."""
    common.load()
    whole = folder / "whole"
    if not (whole / "fingerprint").exists():
        shutil.rmtree(whole, ignore_errors=True)
        counted(whole, *RUN, f"out={whole}", limit=300)  # fills the cache
        shutil.rmtree(whole)
        ended, log = counted(whole, *RUN, f"out={whole}")
        assert not ended.status, ended.err
        unseen = [path.name for path in whole.rglob("*") if not any(path.name in line for line in log)]
        (whole / "operations").write_text(str(len(log)))
        (whole / "fingerprint").write_text(fingerprint(whole))
        assert log, "no operation was counted: is the library loaded?"
        print(f"{len(log)} operations; files that no counted name speaks of: {unseen}", file=sys.stderr)
    operations, rows, kills = int((whole / "operations").read_text()), [], 0
    while kills < cases:
        wanted = max(1, (cases - kills + A_RUN - 1) // A_RUN)
        runs = [
            dict(seed=seed + len(rows) + i, kills=min(A_RUN, cases - kills), disks=bool(disks)) for i in range(wanted)
        ]
        rows += common.shared(runs, lambda case: one_run(case, folder, operations), jobs)
        kills = sum(count for row in rows for mode, count in row["delivered"].items() if mode != "full")
    delivered, found = (sum((Counter(row[name]) for row in rows), Counter()) for name in ("delivered", "found"))
    ways = zip(("before", "after", "half", "time"), ("before", "after", "in the middle of", "at any time"), strict=True)
    told = ", ".join(f"{delivered[mode]} {way}" for mode, way in ways)
    figures = {"runs taken to their end": len(rows), f"kills ({told}; an operation)": kills}
    figures |= {"stopped by a full disk": delivered["full"]} | {what: found[what] for what in WRONG}
    return {"figures": figures, "problems": [problem for row in rows for problem in row["problems"]]}


if __name__ == "__main__":
    if LOADED not in os.environ:
        import tempfile

        made = library(Path(tempfile.mkdtemp(prefix="campaign-library-")))
        os.environ |= {"LD_PRELOAD": str(made), LOADED: str(made)}
        os.execv(sys.executable, [sys.executable, "-m", "tests.campaigns.kills", *sys.argv[1:]])
    common.campaign("kills", run, cases=1000, disks=1)
