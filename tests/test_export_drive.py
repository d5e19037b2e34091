"""pegasus-run: an environment driven on time by the exported policy, stopped where it hangs, logged in any case."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import pegasus_jax
from folders import TINY, a_run, row
from pegasus_jax import tasks
from pegasus_jax.checks import ConfigError
from pegasus_jax.cli.drive import handle
from pegasus_jax.exports.drive import drives, overruns, timed
from pegasus_jax.report import content
from pegasus_jax.report.read import look
from pegasus_jax.runs import config_io, store
from pegasus_jax.runs.driven import locked

ROBOT = """
import os, signal, sys, time
import gymnasium, jax.numpy as jnp, numpy as np

def note(what):
    with open(os.environ["NOTES"], "a") as file:
        print(what, file=file)

class Arm(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,))
    action_space = gymnasium.spaces.Box(-2.0, 2.0, (1,))
    dt, count = 0.02, 0

    def reset(self, *, seed=None, options=None):
        note("reset")
        print("it is reset", file=sys.stderr, flush=True)
        if os.environ.get("BREAKS") == "reset":
            raise OSError("the motor driver does not answer")
        self.x = np.array([3.0, 0.0])
        return self.x, {}

    def step(self, control):
        Arm.count += 1
        if Arm.count == 4 and "HANGS" in os.environ:
            self.hang()
        if Arm.count == 4 and os.environ.get("BREAKS") == "step":
            raise OSError("the motor driver does not answer")
        self.x = self.x + 0.02 * np.array([self.x[1], float(control[0])])
        return self.x, 0.0, False, False, {}

    def hang(self):
        while True:
            try:
                time.sleep(60)
            except BaseException:
                if os.environ["HANGS"] == "gently":
                    raise

    def rest(self):
        note("rest")

    def close(self):
        note("close")

gymnasium.register("Driven-v0", Arm)

def cost(x):
    if "TRACES" in os.environ:
        note("traced")
    return 1 - jnp.exp(-(x[0] ** 2))
"""
WORDS = {"task": "gym", "env": "driven_robot:Driven-v0", "cost": "driven_robot:cost", "angles": "[0]"}
WORDS |= {"start_mean": "[3,0]", "eval_episodes": "0", "horizon": "10"}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the robot's module, and a run of it."""
    home = tmp_path_factory.mktemp("robot")
    (home / "driven_robot.py").write_text(ROBOT)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NOTES", str(home / "notes"))
        patch.syspath_prepend(str(home))
        made = tasks.of_config(config_io.parse({**TINY, **WORDS}))
        a_run(home / "run", trials=2, made=made, **WORDS)
        tasks.close_environments()
    return home


class Called(NamedTuple):
    """What a command left."""

    code: int
    out: str
    err: str
    asked: list[str]  # of the robot


def driven(home: Path, *words: str, stopped: signal.Signals | None = None, **environment: str) -> Called:
    """`pegasus-run`, and a signal to it half a second after the robot's reset."""
    notes = home / "notes"
    notes.unlink(missing_ok=True)
    program = [sys.executable, "-P", "-m", "pegasus_jax.cli.drive", "run", *words]
    told = {
        **os.environ,
        "NOTES": str(notes),
        "PYTHONPATH": f"{home}:{os.environ.get('PYTHONPATH', '')}",
        **environment,
    }
    process = subprocess.Popen(program, cwd=home, env=told, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    if stopped:
        while not notes.exists() and process.poll() is None:
            time.sleep(0.05)
        time.sleep(0.5)
        process.send_signal(stopped)
    out, err = process.communicate(timeout=120)
    return Called(process.returncode, out, err, notes.read_text().split() if notes.exists() else [])


def newest(home: Path) -> dict[str, np.ndarray]:
    with np.load(sorted((home / "run" / "driven").glob("*.npz"))[-1]) as file:
        return dict(file)


def test_a_robot_is_driven_by_the_policy_at_its_period(home: Path) -> None:
    done = driven(home, "episodes=2", "seconds=0.3", "trial=1", TRACES="1")
    moving = done.asked[done.asked.index("reset") :]  # nothing is traced any more: the last control stays in force
    assert (done.code, moving) == (0, ["reset", "rest", "reset", "rest", "close"]), done.err
    said = "the policy of trial 1 drives driven_robot:Driven-v0: x0, x1 -> u0 from -2 to 2; every 0.02 s for 0.3 s"
    before_motion = [*done.err.splitlines()]
    assert before_motion[-5:] == [
        "preparing the controller of trial 1; nothing moves yet",
        *[f"{said}, watchdog 0.5 s", "it is reset"] * 2,
    ]
    lines = done.out.splitlines()
    assert len(lines) == 2
    assert lines[1].startswith("run/driven/0002.npz: 15 controls, mean cost 1.000, ended by horizon; ")
    log = newest(home)
    control = pegasus_jax.controller(home / "run", trial=1)
    np.testing.assert_allclose(log["u"], [control(x) for x in log["x"][:-1]], atol=1e-4)
    np.testing.assert_allclose(log["cost"], 1 - np.exp(-(log["x"][1:, 0] ** 2)), rtol=1e-5)
    assert (str(log["ended"]), int(log["policy"]), int(log["trial"]), float(log["dt"])) == ("horizon", 1, 2, 0.02)
    assert log["time"][0] == 0
    assert log["time"][-1] > 13.9 * 0.02  # its step does not wait
    assert int(log["overruns"]) == overruns(log["time"], 0.02)
    assert "policy of trial 1, as asked" in done.err.splitlines()
    report = " ".join(re.sub("<[^>]*>", " ", content.driven.section(look(home / "run"))).split())
    late = int(log["overruns"])
    assert f"driven/0002.npz trial 1 0.3 {log['cost'].mean():.3f} no horizon {late}" in report
    cut = store.arrays(home / "run" / "driven" / "0002.npz") | {"trial": 3, "ended": "interrupted"}
    np.savez(home / "run" / "driven" / "0003.npz", **cut)
    best = content.best(look(home / "run")._replace(best=1, rows=[row(1)], steps=[]))
    assert "driven 3 times by pegasus-run, 1 of them cut short: cost 1.000, 0 of 2 succeeded" in best
    (home / "run" / "driven" / "0003.npz").write_bytes(b"no log")
    assert any("0003.npz cannot be read" in problem for problem in look(home / "run").problems)
    (home / "run" / "driven" / "0003.npz").unlink()


@pytest.mark.slow
@pytest.mark.parametrize("how", ["gently", "deaf"])
def test_a_robot_that_hangs_is_closed_and_its_rows_are_kept(home: Path, how: str) -> None:
    """Where Ctrl-C would end the hanging call, and where nothing does: then the process ends."""
    began = time.monotonic()
    done = driven(home, "watchdog=0.4", HANGS=how)
    assert (done.code, done.asked) == (2, ["reset", "close"]), done.err
    assert time.monotonic() - began < 60
    (line,) = (line for line in done.err.splitlines() if line.startswith("pegasus: "))
    assert "was given no control for 0.4 s, so the watchdog closed it; its 3 rows are kept in run/driven/" in line
    log = newest(home)
    assert str(log["ended"]) == "interrupted"
    assert log["x"].shape == (4, 2)
    assert log["u"].shape == log["time"][:, None].shape == (3, 1)
    assert np.isfinite(log["cost"]).all()


@pytest.mark.parametrize(("where", "rows"), [pytest.param("step", 3, marks=pytest.mark.slow), ("reset", 0)])
def test_a_robot_that_fails_is_closed_and_its_rows_are_kept(home: Path, where: str, rows: int) -> None:
    before = len([*(home / "run").glob("driven/*.npz")])
    done = driven(home, BREAKS=where)
    assert (done.code, done.asked) == (2, ["reset", "close"])
    (line,) = (line for line in done.err.splitlines() if line.startswith("pegasus: "))
    assert "the motor driver does not answer" in line
    assert (f"its {rows} rows are kept in run/driven/" in line) == bool(rows)
    assert len([*(home / "run").glob("driven/*.npz")]) - before == bool(rows)
    assert not rows or len(newest(home)["u"]) == rows


@pytest.mark.slow
def test_ctrl_c_closes_the_robot_and_its_rows_are_kept(home: Path) -> None:
    done = driven(home, "seconds=60", stopped=signal.SIGINT)
    assert (done.code, done.asked) == (130, ["reset", "close"])
    assert done.err.splitlines()[-1] == "stopped; its rows are kept"
    assert 1 < len(newest(home)["u"]) < 500


# The clock, on an environment whose steps take as long as they are told


class Slow(NamedTuple):
    reset: Any
    step: Any
    rest: Any = None


def clocked(waits: list[float], period: float) -> np.ndarray:
    """When controls are sent to an environment whose steps take so long."""
    times: list[float] = []
    left = iter(waits)

    def step(u: Any) -> tuple[Any, Any, str]:
        time.sleep(next(left))
        return u, u, ""

    plant = timed(Slow(lambda seed: 0, step), period, times, [], lambda: None)
    plant.reset(0)
    for _ in waits:
        plant.step(0)
    return np.array(times) - times[0]


def test_controls_are_a_period_apart_whether_a_step_waits_or_not() -> None:
    times = clocked([0.0, 0.03, 0.0, 0.02, 0.0], 0.05)
    assert np.all(times > 0.05 * np.arange(5) - 1e-4)
    assert np.all(np.diff(times) > 0.05 - 0.1 * 0.05)


def test_after_a_late_control_the_others_do_not_hurry() -> None:
    times = clocked([0.0, 0.2, 0.0, 0.0, 0.0], 0.05)
    assert times[2] - times[1] > 0.2 - 1e-3
    assert np.all(np.diff(times) > 0.045)
    assert overruns(times, 0.05) >= 1


def test_an_overrun_is_a_tenth_of_a_period() -> None:
    assert overruns(np.array([0.0, 0.1, 0.2, 0.305, 0.405]), 0.1) == 0
    assert overruns(np.array([0.0, 0.1, 0.22, 0.3, 0.5]), 0.1) == 2
    assert overruns(np.array([0.0]), 0.1) == overruns(np.array([]), 0.1) == 0


# What a user does wrong


def test_one_at_a_time_drives_by_a_run(home: Path) -> None:
    """Two would write the same log."""
    with locked(home / "run"):
        done = driven(home, "seconds=0.1")
    assert (done.code, "reset" in done.asked) == (2, False)
    assert done.err.splitlines()[-1] == "pegasus: another pegasus-run drives by run; begin when it has ended"


def test_what_cannot_be_is_refused(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for words, complaint in (
        (["seconds=soon"], "seconds=soon is not a number of seconds; for example seconds=2.5"),
        (["seconds=0"], "seconds=0 is out of range"),
        (["episodes=0"], "episodes=0 is out of range"),
        (["watchdgo=1"], "did you mean 'watchdog'"),
    ):
        with pytest.raises(ConfigError, match=complaint):
            handle([str(home / "run"), *words])
    with pytest.raises(ConfigError, match="task=cartpole has no environment to drive; pegasus-eval"):
        next(drives(a_run(tmp_path / "run", trials=1)))
    monkeypatch.syspath_prepend(str(home))
    monkeypatch.setenv("NOTES", str(tmp_path / "notes"))
    with pytest.raises(ConfigError, match=r"watchdog=0.01 is out of range; expected a number in \(0.02, inf\)"):
        next(drives(home / "run", watchdog=0.01))
    tasks.close_environments()
