"""What is said while a command runs, and when."""

from __future__ import annotations

import io
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from pegasus_jax.config import Config, Explore
from pegasus_jax.runs import display as progress
from pegasus_jax.runs.config_io import parse
from pegasus_jax.runs.display import Clock, Display, announcement, best_line, duration, stopped, summary
from pegasus_jax.runs.trials_table import PLAIN, spark
from pegasus_jax.tasks import guide

ROW: dict[str, Any] = {
    "trial": 7,
    "plant_seconds": 17.5,
    "random": False,
    "policy": 6,
    "episode_cost": 0.375,
    "mean_cost": 0.31,
    "success_rate": 0.85,
    "episode_success": False,
    "ended": "horizon",
    "steps": 25,
    "objective_last": 0.25,
    "objective_fresh": 0.298,
    "calibration": 1.34,
    "skipped_updates": 0,
    "seconds": {"fit": 15.0, "compile": 3.0, "between_episodes": 18.04},
}
UNMEASURED = {"mean_cost": None, "success_rate": None}


def test_a_trial_in_one_line() -> None:
    assert summary([ROW], 15) == (
        "trial  7/15 | 17.5 s of plant time | episode by the policy of trial 6: cost 0.375, no success"
        " | new policy: cost 0.310, success 85%, imagined cost 0.298"
        " | model errors 1.3 times as large as predicted | 18.0 s until the next episode, 3.0 s of them compiling"
    )


@pytest.mark.parametrize(
    ("changes", "says", "does_not_say"),
    [
        (UNMEASURED, "cost 0.375, no success | new policy: imagined cost 0.298", "success 85%"),
        ({"episode_success": True}, "cost 0.375, success | new policy", "no success"),
        ({"ended": "interrupted", "steps": 17}, "cost 0.375, interrupted after 17 periods, no success", "horizon"),
        ({"policy": 4}, "by the policy of trial 4", "trial 6"),
        ({"policy": 0, "random": True}, "episode of random controls: cost 0.375", "by the policy"),
        (
            {**UNMEASURED, "objective_fresh": None, "calibration": None},
            "cost 0.375, no success | 18.0 s until the next episode",
            "new policy",
        ),
        ({"replaced": False}, "policy kept: cost 0.310", "new policy"),
        ({"replaced": False, "policy": 3, "policy_next": 3}, "policy kept: cost 0.310", "policy of trial 3 again"),
        ({"replaced": False, "policy": 4, "policy_next": 3}, "policy of trial 3 again: cost 0.310", "policy kept"),
        ({"skipped_updates": 3}, "3 updates skipped", "None"),
        (
            {"seconds": {"compile": 5.0, "between_episodes": 1.5}},
            " | 1.5 s until the next episode, 1.5 s of them compiling",
            "5.0",
        ),
        (
            {"policy": 0, "random": True, "objective_fresh": None},
            "first policy, before any search: cost 0.310, success 85%",
            "new policy",
        ),
    ],
)
def test_a_line_says_what_was_executed_and_what_is_known(changes: dict[str, Any], says: str, does_not_say: str) -> None:
    line = summary([ROW | changes], 15)
    assert says in line
    assert does_not_say not in line


def test_several_seeds_are_means_and_the_median_of_the_errors() -> None:
    others = [ROW | {"success_rate": 1.0, "calibration": 2.0}, ROW | {"success_rate": 0.95, "calibration": 9.0}]
    line = summary([ROW, *others], 15)
    assert "success 93%" in line
    assert "2 of 3 seeds solved" in line
    assert "errors 2.0 times" in line
    assert "episodes: cost 0.375, 1 of 2 succeeded" in summary([ROW, ROW | {"policy": 5, "episode_success": True}], 15)


def test_a_trial_that_is_not_the_best_says_which_is() -> None:
    text = io.StringIO()
    display = Display(9, Console(file=text, width=400))
    display.trial([ROW | {"trial": 1, "success_rate": 0.95}])
    display.trial([ROW | {"trial": 2}])
    assert ["best so far: trial 1" in line for line in text.getvalue().splitlines()] == [False, True]


def test_a_policy_that_has_not_run_is_not_compared() -> None:
    """What a line of a run without evaluation has measured is the policy that ran, and not the one it learned."""
    text = io.StringIO()
    display = Display(9, Console(file=text, width=400))
    own = ROW | {"mean_cost": None, "success_rate": None, "random": False, "episode_success": False}
    for trial, cost in enumerate((0.9, 0.7, 0.5, 0.6), 1):
        display.trial([own | {"trial": trial, "policy": trial - 1, "episode_cost": cost, "random": trial == 1}])
    said = [line.partition("best so far: ")[2].split(" | ")[0] for line in text.getvalue().splitlines()]
    assert said == ["", "", "", "trial 2"]


@pytest.mark.parametrize("first", [0, 1])
def test_a_policy_that_a_run_began_with_may_be_the_best(first: int) -> None:
    """Where it is kept: without a checkpoint nobody can use it."""
    text = io.StringIO()
    display = Display(9, Console(file=text, width=400))
    display.first = first
    own = ROW | {"mean_cost": None, "success_rate": None, "random": False}
    display.trial([own | {"trial": 1, "policy": 0, "episode_cost": 0.2}])
    display.trial([own | {"trial": 2, "policy": 1, "episode_cost": 0.4}])
    assert ("best so far: trial 0" in text.getvalue().splitlines()[-1]) == (first == 0)


def test_a_trial_that_is_still_evaluated_has_its_line_before_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "BRIEF", 0.1)
    text = io.StringIO()
    with Display(3, Console(file=text, width=400)).running() as display:
        display.phase(2, "fit")
        time.sleep(0.4)
        display.trial([ROW | {"trial": 1}])
        time.sleep(0.4)
    assert [line[:9].strip() for line in text.getvalue().splitlines()] == ["trial  1/", "trial 2/3"]


def test_a_first_controller_is_named() -> None:
    line = summary([ROW | {"policy": 0, "random": True}], 15, exploring="explore.policy=robot:swing")
    assert "episode of explore.policy=robot:swing: cost 0.375" in line
    assert guide.exploring(Config(explore=Explore(policy="robot:swing"))) == "explore.policy=robot:swing"
    assert guide.exploring(Config()) == "random controls"


def test_the_best_policy_is_named() -> None:
    known = {"objective_fresh": 0.3}
    rows = [
        ROW | known | {"trial": n, "policy": n - 1, "success_rate": n / 4, "episode_cost": n / 10} for n in (1, 2, 3)
    ]
    assert best_line([row | {"objective_fresh": None} for row in rows], 3).startswith("no policy was learned")
    assert best_line(rows, 2) == "best policy: trial 2 (success 50%, cost 0.310)"
    robot = [row | UNMEASURED for row in rows]
    assert best_line(robot, 1) == (
        "best policy: trial 1 (cost 0.200, ran in 1 episode); that of trial 3 has not run yet: trial=last takes it"
    )
    assert best_line(robot, 3) == "best policy: trial 3 (not run yet)"


def test_a_person_reads_durations() -> None:
    assert [duration(s) for s in (0.4, 99, 110, 5000, 9000)] == ["0 s", "99 s", "2 min", "83 min", "2.5 h"]


def test_what_will_be_done_and_how_to_go_on(tmp_path: Path) -> None:
    config = parse({"task": "cartpole", "model": "gp", "trials": "4"})
    assert announcement(config, Path("runs/a")) == "learning cartpole, model gp, policy mlp: 4 trials, folder runs/a"
    assert "3 of 4 trials are done, 2 seeds" in announcement(config, Path("runs/a"), 2, 3)
    for word in ("log_normal", "deterministic", "ensemble", "lagrangian"):
        assert f"model {word}, policy" in announcement(parse({"model": word}), Path("a"))
    five = {"task": "swimmer_knife_edge", "model.ensemble_size": "5"}
    assert "model log_normal of 5," in announcement(parse(five), Path("a"))
    assert "begins again" in stopped(tmp_path)
    run = tmp_path / "my run"
    run.mkdir()
    (run / "config.yaml").touch()
    assert "stopped before the first episode had ended" in stopped(run)
    assert f"pegasus-train 'resume={run}' goes on" in stopped(run)
    (run / "episodes").mkdir()
    (run / "episodes" / "0001.npz").touch()
    assert "all rows of every episode are kept" in stopped(run)


class Watch:
    """A clock that is set by hand."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        monkeypatch.setattr(progress.time, "monotonic", lambda: self.now)


def test_only_steady_trials_say_how_long_the_next_ones_take(monkeypatch: pytest.MonkeyPatch) -> None:
    watch = Watch(monkeypatch)
    clock = Clock()

    def trial(number: int, *phases: str, takes: float, compiling: float = 0.0) -> None:
        for phase in phases:
            clock.phase(number, phase)
        clock.compiled += compiling
        watch.now += takes

    learning = ("collect", "fit", "search", "evaluate")
    trial(1, "collect", takes=1)  # random controls, nothing learned
    trial(2, *learning, takes=90, compiling=60)
    trial(3, "read", "fit", "search", takes=5)  # its episode was on disk
    clock.phase(4, "collect")
    assert clock.left(10) is None
    trial(4, *learning, takes=20, compiling=0.5)
    clock.phase(5, "collect")
    assert clock.left(10) == pytest.approx(6 * 20)
    watch.now += 8
    assert clock.left(10) == pytest.approx(5 * 20 + 12)
    for number in range(5, 9):
        trial(number, *learning, takes=40)
    clock.phase(9, "collect")
    assert clock.left(10) == pytest.approx(2 * 40)  # the latest trials count


def test_a_log_has_a_line_a_phase_and_is_never_silent_for_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "BRIEF", 0.1)
    monkeypatch.setattr(progress, "SILENCE", 0.6)
    text = io.StringIO()
    with Display(3, Console(file=text, width=200)).running() as display:
        display.phase(1, "collect")  # too short for a line
        display.phase(1, "fit")
        with display.compiling("fit"):
            time.sleep(0.4)
        display.phase(1, "search", 0.2, ", step 200 of at most 1000")
        time.sleep(1.1)
    lines = text.getvalue().splitlines()
    assert lines[0] == "compiling the fit (once)"
    assert lines[1] == "trial 1/3  searching a policy, step 200 of at most 1000"
    assert lines[2] == f"{lines[1]}  1 s so far"
    before = text.getvalue()
    time.sleep(0.8)
    assert text.getvalue() == before


def test_a_stage_that_waits_for_the_compiler_has_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "BRIEF", 0.1)
    text = io.StringIO()
    with Display(2, Console(file=text, width=200)).running() as display:
        display.phase(1, "collect")
        for part in ("episode", "add_episode"):
            time.sleep(0.4)
            with display.compiling(part):
                time.sleep(0.4)
        time.sleep(0.4)
    told = ["trial 1/2  running its episode", "compiling the episode (once)", "compiling the data set (once)"]
    assert text.getvalue().splitlines() == told


def test_quiet_is_quiet(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(progress, "BRIEF", 0.02)
    with Display(3, quiet=True).running() as display:
        display.phase(1, "fit")
        time.sleep(0.2)
    assert capfd.readouterr() == ("", "")


def test_a_terminal_says_that_it_compiles_and_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    text = io.StringIO()
    with Display(3, Console(file=text, force_terminal=True, width=100)).running() as display:
        assert display.live is not None
        display.phase(2, "search", 0.5)
        with display.compiling("search"):
            assert display.progress.tasks[0].description == "compiling the search (once)"
        assert display.progress.tasks[0].description == "trial 2/3  searching a policy"
        assert display.progress.tasks[0].completed == 0.5


def test_a_terminal_has_a_table_of_the_trials() -> None:
    text = io.StringIO()
    rows = [
        ROW | {"trial": n, "mean_cost": 1 - n / 4, "success_rate": n / 4, "objective_fresh": 0.3} for n in (1, 2, 3)
    ]
    with Display(4, Console(file=text, force_terminal=True, width=120, height=30)).running() as display:
        for number, known in enumerate(rows, 1):
            display.phase(number, "search", 0.5)
            display.trial([known])
        display.phase(4, "fit", 0.1)
        display.clock.steady = [60.0]
        screen = Console(file=io.StringIO(), width=120)
        screen.print(display._now())
        lines = screen.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert lines[0].split("  ")[0] == "trial"
    assert "plant [s]" in lines[0]
    assert [line.split()[0] for line in lines[1:4]] == ["1/4", "2/4", "3/4"]
    assert lines[3].split()[2:6] == ["0.375", "0.250", "75%", "0.300"]
    assert lines[4] == "cost ▇▅▃   success ▃▅▇"
    assert lines[5] == "best so far: trial 3 (success 75%, cost 0.250)"
    assert lines[6].startswith("trial 4/4  fitting the model")
    assert lines[6].rstrip().endswith("about 60 s left")
    assert text.getvalue().count("3/4") >= 1  # the table stays when the display ends


@pytest.mark.parametrize(
    ("values", "drawn"), [([0, 0.5, 1], "▁▅█"), ([2, np.nan, 1], "█ ▅"), ([-1, 0], "▁▁"), ([], "")]
)
def test_a_curve_of_one_line(values: list[float], drawn: str) -> None:
    assert spark(values) == drawn
    assert len(spark(values, PLAIN)) == len(drawn)


def test_a_table_makes_room_for_what_a_robot_asks() -> None:
    text = io.StringIO()
    with Display(2, Console(file=text, force_terminal=True, width=100)).running() as display:
        display.asks = True
        display.phase(1, "collect")
        assert display.live is None
        display.phase(1, "fit")
        assert display.live is not None


def test_nothing_slow_is_imported_before_the_first_line() -> None:
    """JAX and MuJoCo take seconds; what a command will do is known without them."""
    code = (
        "import sys, pegasus_jax.cli.main\n"
        "from pegasus_jax.runs import display, store, config_io\n"
        "print(*{'jax', 'mujoco', 'gymnasium', 'scipy', 'matplotlib'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_words_of_the_environment_come_after_those_that_are_typed(tmp_path: Path) -> None:
    def helped(words: str) -> subprocess.CompletedProcess[str]:
        program = [sys.executable, "-c", "from pegasus_jax.cli.main import train; train()"]
        return subprocess.run(
            [*program, "task=cartpole", "trials=9", "--help"],
            capture_output=True,
            text=True,
            check=False,
            cwd=tmp_path,
            env={**os.environ, "PEGASUS_SETTINGS": words},
        )

    assert re.search(r"^  trials=9 ", helped("").stdout, re.MULTILINE)
    assert re.search(r"^  trials=7 ", helped("trials=7 'policy.hidden=[8]'").stdout, re.MULTILINE)
    for wrong in ("trials=7 '", "trails=7"):
        done = helped(wrong)
        assert (done.returncode, done.stderr.count("\n")) == (2, 1)
        assert wrong.partition("=")[0] in done.stderr or "PEGASUS_SETTINGS" in done.stderr


def test_the_first_line_comes_first_and_a_stop_before_the_run_begins_says_so(tmp_path: Path) -> None:
    program = [sys.executable, "-c", "from pegasus_jax.cli.main import train; train()", "task=cartpole", "out=demo"]
    process = subprocess.Popen(program, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    line = process.stdout.readline()
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert line == "learning cartpole, model lagrangian, policy mlp: 15 trials, folder demo\n"
    assert err == "stopped before the first trial of demo; the same command begins again\n"
    assert process.returncode == 130
