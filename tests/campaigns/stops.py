"""Stops of a robot: python -m tests.campaigns.stops cases=100

Real processes of pegasus-train with a robot that writes down when it is asked for what. A signal, or an exception of
its own, stops them: while they import, compile, search, evaluate, or in the middle of an episode. `close` must follow
within a second, once, and no control after the signal. Other work on the machine makes the latencies longer.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import statistics
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests.campaigns import common

ROBOTS = Path(__file__).with_name("robots.py")
TINY = [
    *("task=gym", "cost=robots:cost", "angles=[0]", "start_mean=[3.14,0]", "start_std=[.05,.05]", "fit.steps=5"),
    *("model.hidden=[8]", "policy.hidden=[8]", "search.particles=16"),
]
SIGNALS = {"SIGINT": 130, "SIGTERM": 143, "SIGHUP": 129, "SIGINT twice": 130}
MOMENTS = ("import", "compile", "search", "episode", "episode", "episode", "evaluate")
CLOSE = 1.0  # seconds that `close` may take
GRACE = 0.05  # seconds in which a control that was on its way may begin
RETURN = 0.05  # seconds after its last note in which a step returns, also on a busy machine
ROBOT_KINDS = (
    "Arm",
    "Arm",
    "Slow",
    "Alarms",
    "Bound",
    "InJax",
    "Buffer",
    "InPlace",
    "CloseRaises",
    "Handlers",
    "Swallows",
)


class Case(NamedTuple):
    """One stop."""

    seed: int
    how: str
    moment: str
    robot: str
    horizon: int


def drawn(number: int, seed: int) -> Case:
    """A case: what stops it goes round, the rest is drawn."""
    draw = random.Random(f"{seed} {number}")
    how = [*SIGNALS, "exception"][number % 5]
    moment = "episode" if how == "exception" else MOMENTS[number % len(MOMENTS)]
    return Case(number, how, moment, draw.choice(ROBOT_KINDS), draw.choice([5, 60, 80]) if moment == "episode" else 20)


def words(case: Case) -> list[str]:
    """What pegasus-train is called with, so that there is time for the stop."""
    long = 200_000 if case.moment == "search" else 5
    episodes = 30 if case.moment == "evaluate" else 0
    chosen = [
        f"env=robots:{case.robot}-v0",
        f"horizon={case.horizon}",
        f"search.steps={long}",
        f"eval_episodes={episodes}",
    ]
    return [*TINY, *chosen, "trials=3", "out=run"]


def log(folder: Path) -> list[tuple[float, str]]:
    """When the robot was asked for what."""
    path = folder / "robot.log"
    rows = [line.split() for line in path.read_text().splitlines()] if path.exists() else []
    return [(float(row[0]), row[1]) for row in rows if len(row) == 3]


def reached(case: Case, folder: Path, began: float, step: int) -> bool:
    """Whether the moment has come at which the stop is due."""
    called = [what for _, what in log(folder)]
    if case.moment == "import":
        return time.monotonic() - began > 0.5
    if case.moment == "evaluate":
        return called.count("reset") >= 2 and called.count("stepped") > case.horizon + step
    if case.moment == "episode":
        return called.count("stepped") >= step
    return called.count("stepped") >= case.horizon  # the first episode is over: programs compile, then search


def unignored() -> None:
    """Undo what nohup and a shell's & leave to their children: the commands respect signals that are ignored."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def started(case: Case, folder: Path, fails: int) -> subprocess.Popen[str]:
    """pegasus-train in `folder`; a cold cache where it should compile for long."""
    told = {**os.environ, "ROBOT_LOG": str(folder / "robot.log"), "ROBOT_FAILS": str(fails)}
    if case.moment == "compile":
        told |= {"JAX_COMPILATION_CACHE_DIR": str(folder / "cache"), "XLA_FLAGS": ""}
        told["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "0"
    program = [
        sys.executable,
        "-P",
        "-c",
        "import sys; sys.path.insert(0, ''); from pegasus_jax.cli.main import train; train()",
    ]
    pipes: dict[str, Any] = dict(stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    pipes["preexec_fn"] = unignored
    return subprocess.Popen([*program, *words(case)], cwd=folder, env=told, **pipes)


def stopped(case: Case, folder: Path, limit: float = 120.0) -> dict[str, Any]:
    """Start, stop at the moment, wait: what happened, with times."""
    draw = random.Random(f"{case.seed} when")
    step = draw.randint(1, case.horizon - 1)
    # At most a second, or the first search of a warm cache might be over; when it is, it was in another phase.
    later = draw.uniform(0.1, 2.5) if case.moment in ("compile", "search", "import") else draw.uniform(0, 0.02)
    process, began = started(case, folder, step if case.how == "exception" else 0), time.monotonic()
    sent = None
    if case.how != "exception":
        while process.poll() is None and not reached(case, folder, began, step) and time.monotonic() - began < limit:
            time.sleep(0.005)
        time.sleep(later)
        sent = time.monotonic() if process.poll() is None else None
        for again in range(1 + case.how.endswith("twice")):
            if again:
                time.sleep(0.1)
            process.send_signal(getattr(signal, case.how.split()[0]))
    try:
        out, err = process.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        process.kill()
        out, err = process.communicate()
    if case.how == "exception":
        sent = max((when for when, what in log(folder) if what == "fails"), default=None)
    return {"status": process.returncode, "out": out, "err": err, "sent": sent}


def rows_kept(run: Path) -> int:
    """Controls in the episodes on disk."""
    count = 0
    for path in (run / "episodes").glob("*.npz"):
        with np.load(path) as file:
            count += len(file["u"])
    return count


def judged(case: Case, folder: Path, seen: dict[str, Any]) -> tuple[float | None, list[str]]:
    """Seconds from the stop to `close`, and what was wrong."""
    calls, sent, wrong = log(folder), seen["sent"], []
    if sent is None:
        return None, ["ended before it was stopped"]
    closes = [when for when, what in calls if what == "close"]
    opened = any(what == "open" for _, what in calls)
    if opened and len(closes) != 1:
        wrong.append(f"closed {len(closes)} times")
    latency = closes[0] - sent if closes else None
    if latency is not None and latency > CLOSE:
        wrong.append("close too late")
    if sum(what == "step" and when > sent + GRACE for when, what in calls):
        wrong.append("controls after the stop")
    expected = {2} if case.how == "exception" else {SIGNALS[case.how], -getattr(signal, case.how.split()[0])}
    if seen["status"] not in expected:
        wrong.append("exit status")
    # While the interpreter still imports, before any line of ours, Ctrl-C is Python's own.
    if (opened or case.moment != "import") and "Traceback" in seen["out"] + seen["err"]:
        wrong.append("traceback")
    # A step has returned when another one begins, or after a while; before that nobody knows its row.
    steps = sum(what == "step" for _, what in calls)
    done = max(steps - 1, sum(what == "stepped" and when < sent - RETURN for when, what in calls))
    # A second Ctrl-C ends at once: it closes the environment, and writes nothing more.
    if (
        case.moment == "episode"
        and not case.how.endswith("twice")
        and rows_kept(folder / "run") < min(done, case.horizon)
    ):
        wrong.append("rows lost")
    return latency, wrong


def one(case: Case, folder: Path) -> dict[str, Any]:
    """One stop in a folder of its own."""
    home = folder / f"stop{case.seed}"
    shutil.rmtree(home, ignore_errors=True)
    home.mkdir()
    shutil.copy(ROBOTS, home / "robots.py")
    seen = stopped(case, home)
    latency, wrong = judged(case, home, seen)
    told = f"{case.how}, {case.moment}, {case.robot}, horizon {case.horizon}"
    detail = f"status {seen['status']}, close after {latency if latency is None else round(latency, 3)} s"
    problems = [f"{told}: {', '.join(wrong)} ({detail}; {common.last_line(seen['err'])})"] if wrong else []
    if not wrong:
        shutil.rmtree(home)
    return {"latency": latency, "wrong": wrong, "problems": problems}


WRONG = (
    "ended before it was stopped",
    "close too late",
    "controls after the stop",
    "exit status",
    "traceback",
    "rows lost",
)


def run(folder: Path, cases: int, seed: int, jobs: int) -> dict[str, Any]:
    """`cases` stops. One job measures latencies best."""
    one(Case(-1, "exception", "episode", "Arm", 5), folder)  # fills the cache as far as an episode
    rows = common.shared([drawn(number, seed) for number in range(cases)], lambda case: one(Case(*case), folder), jobs)
    found = Counter(what for row in rows for what in row["wrong"])
    latencies = sorted(row["latency"] for row in rows if row["latency"] is not None)
    figures: dict[str, Any] = {"stops": len(rows), "of them with an open robot": len(latencies)}
    if latencies:
        shown = (latencies[0], statistics.median(latencies), latencies[-1])
        figures["seconds from the stop to `close`: least, median, most"] = ", ".join(f"{value:.3f}" for value in shown)
    figures["not closed, or more than once"] = sum(n for what, n in found.items() if what.startswith("closed"))
    figures |= {what: found[what] for what in WRONG}
    return {"figures": figures, "problems": [problem for row in rows for problem in row["problems"]]}


if __name__ == "__main__":
    common.campaign("stops", run, cases=100, jobs=1)
