"""A robot at the command line, as docs/robot.md says: it moves when an episode needs it, and is let go safely."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import forked
from benchmarks import once
from pegasus_envs.gym_plant import env_spec
from pegasus_jax import controller
from pegasus_jax.checks import ConfigError
from pegasus_jax.config import Config
from pegasus_jax.runs import config_io, groups, store, study
from pegasus_jax.runs.restore import restored
from pegasus_jax.runs.store import RunError
from pegasus_jax.viz.learning_curves import groups_picture
from probes import TINY_WORDS

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "robot.md").read_text(), re.DOTALL)
ROBOT = next(block for block in EXAMPLES if "class Arm(" in block)
# The documented arm, without its sleep, which writes down what is asked of it and breaks where it is told to.
WATCHED = """
import os, pathlib

def note(what):
    with open("asked.log", "a") as file:
        print(what, file=file)

class Watched(Arm):
    count, dt = 0, 1e-3
    def reset(self, **options):
        note("reset")
        return super().reset(**options)
    def step(self, control):
        note("step")
        Watched.count += 1
        if Watched.count == int(os.environ.get("BREAKS", 0)):
            raise OSError("the motor driver does not answer")
        if Watched.count == int(os.environ.get("HANGS", 0)):
            time.sleep(60)
        return super().step(control)
    def close(self):
        note("close")
        super().close()

gymnasium.register("Watched-v0", Watched)
"""
WORDS = ["task=gym", "env=robot:Watched-v0", "cost=robot:cost", "angles=[0]", "start_mean=[3.14,0]", "eval_episodes=0"]
TINY = [*TINY_WORDS, "trials=2"]
PROGRAM = [sys.executable, "-P", "-c"]


def started(name: str, *words: object, cwd: Path, **environment: int) -> subprocess.Popen[str]:
    (cwd / "robot.py").write_text(ROBOT + WATCHED)
    program = [*PROGRAM, f"from pegasus_jax.cli.main import {name}; {name}()", *map(str, words)]
    told = {**os.environ, **{key: str(value) for key, value in environment.items()}}
    return subprocess.Popen(program, cwd=cwd, env=told, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def call(name: str, *words: object, cwd: Path, **environment: int) -> tuple[int, str, str]:
    (cwd / "robot.py").write_text(ROBOT + WATCHED)
    done = forked.command(name, *words, cwd=cwd, env={key: str(value) for key, value in environment.items()})
    return done.returncode, done.stdout, done.stderr


def asked(cwd: Path) -> list[str]:
    """What the robot has been asked for since the last look."""
    path = cwd / "asked.log"
    lines = path.read_text().split() if path.exists() else []
    path.unlink(missing_ok=True)
    return lines


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run of two trials of five steps, and what it asked of the robot."""
    home = tmp_path_factory.mktemp("robot")
    code, _, err = call("train", *WORDS, *TINY, "horizon=5", "out=run", cwd=home)
    assert code == 0, err
    assert "episode by the policy of trial 1: cost" in err
    return home


@pytest.mark.slow
def test_a_robot_moves_for_the_episodes_that_are_data_and_for_nothing_else(learned: Path) -> None:
    """One reset to check it, a reset and a horizon of steps a trial; going on opens it again, a look at the run not."""
    trial = ["reset", *["step"] * 5]
    assert asked(learned) == ["reset", *trial, *trial, "close"]
    rows = store.trials(learned / "run")
    assert [(row["mean_cost"], row["success_rate"]) for row in rows] == [(None, None)] * 2
    assert all(0 <= row["episode_cost"] <= 1 for row in rows)
    code, out, err = call("plot", "run", cwd=learned)
    assert (code, asked(learned)) == (0, []), err
    assert "run/plots/learning.png" in out
    code, _, err = call("train", "resume=run", "trials=3", cwd=learned)
    assert (code, asked(learned)) == (0, [*trial, "close"]), err
    code, out, err = call("evaluate", "run", "episodes=2", "json=true", cwd=learned)
    assert (code, asked(learned)) == (0, [*trial, *trial, "close"]), err


@pytest.mark.slow
def test_what_it_learned_is_a_function(learned: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(learned)
    control = controller("run")
    assert asked(learned) == []
    _, experiment, state = restored(learned / "run", "best")
    for x in np.random.default_rng(0).normal(size=(5, 2)) * 3:
        u = control(x)
        np.testing.assert_allclose(u, experiment.policy.apply(state.policy.params, None, x), rtol=1e-5)
        assert u.shape == (1,)
        assert abs(u[0]) <= 2
    for wrong in ([1.0], [1.0, np.nan]):
        with pytest.raises(ValueError, match="2 finite numbers"):
            control(wrong)
    with pytest.raises(RunError, match="is not a run"):
        controller("nowhere")


@pytest.mark.slow
def test_a_robot_that_fails_ends_the_command_in_one_line(tmp_path: Path) -> None:
    """In the second of two episodes of five steps. Its two whole rows are kept, and resuming learns from them."""
    code, _, err = call("train", *WORDS, *TINY, "horizon=5", "out=run", cwd=tmp_path, BREAKS=8)
    assert (code, "Traceback" in err) == (2, False), err
    assert re.fullmatch(
        r"pegasus: robot:Watched-v0 failed in an episode, OSError: the motor driver does not answer \(robot.py:\d+\);"
        " its 2 rows are kept; resume=run goes on",
        err.splitlines()[-1],
    )
    assert asked(tmp_path) == ["reset", "reset", *["step"] * 5, "reset", *["step"] * 3, "close"]
    cut = store.load_episode(tmp_path / "run", 2)
    assert cut is not None
    assert (cut.ended, cut.trajectory.x.shape, cut.trajectory.u.shape) == ("error", (3, 2), (2, 1))
    code, out, err = call("train", "resume=run", "final=true", cwd=tmp_path)
    # The episode that was cut short is learned from; the last policy's own is the only one that moves the robot.
    assert (code, asked(tmp_path)) == (0, ["reset", *["step"] * 5, "close"]), err
    assert re.search(r"^best policy: trial 2 \(cost .*, ran in 1 episode\)$", out, re.MULTILINE), out
    assert [(row["steps"], row["ended"], row["policy"]) for row in store.trials(tmp_path / "run")] == [
        (5, "horizon", 0),
        (2, "error", 1),
    ]
    assert int(restored(tmp_path / "run")[2].data.size) == 7
    code, _, err = call("train", "resume=run", "trials=3", cwd=tmp_path)
    assert (code, asked(tmp_path)) == (0, []), err


@pytest.mark.parametrize(
    ("wrong", "says", "asks"),
    [("cost=robot:coast", "cost=robot:coast cannot be imported", []), ("angles=[2]", "choose from 0 to 1", ["close"])],
)
def test_a_mistaken_setting_moves_no_robot(wrong: str, says: str, asks: list[str], tmp_path: Path) -> None:
    """One that is opened to be asked what it is like is closed again, in peace, though it was never reset."""
    code, _, err = call("train", *once(*WORDS, *TINY, wrong), "horizon=5", "out=run", cwd=tmp_path)
    assert (code, err.count("\n")) == (2, 1), err
    assert says in err
    assert asked(tmp_path) == asks


def test_ctrl_c_in_the_middle_of_an_episode(tmp_path: Path) -> None:
    process = started("train", *WORDS, *TINY, "horizon=5", "out=run", cwd=tmp_path, HANGS=3)
    log, deadline = tmp_path / "asked.log", time.monotonic() + 200
    while not (log.exists() and log.read_text().count("step") == 3):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert (process.returncode, "Traceback" in err) == (130, False), err
    assert err.splitlines()[-1] == "stopped; all rows of every episode are kept, pegasus-train resume=run goes on"
    assert asked(tmp_path)[-1] == "close"


class Bounds(gymnasium.Env):
    """An environment of two observations whose first control has no limit."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,))
    action_space = gymnasium.spaces.Box(np.array([-np.inf, -1.0]), np.array([np.inf, 1.0]), dtype=np.float64)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        raise AssertionError("it was reset")


def test_facts_that_are_given_are_not_asked_for() -> None:
    gymnasium.register("Bounds-v0", Bounds)
    known = env_spec(
        "Bounds-v0", control_low=[-3, -0.5], control_high=[2, 1], dt=0.1, start_mean=[1, 2], start_std=[0.1]
    )
    np.testing.assert_array_equal(known.control_low, [-3, -0.5])
    np.testing.assert_array_equal(known.control_high, [2, 1])
    np.testing.assert_array_equal(known.start_std, [0.1, 0.1])
    assert (known.dt, known.horizon) == (0.1, 100)
    with pytest.raises(ValueError, match="give control_low= and control_high="):
        env_spec("Bounds-v0", start_mean=[0, 0])
    with pytest.raises(ValueError, match="controls from -2 to 2 are beyond its limits, from -1 to 1"):
        env_spec("Bounds-v0", control_low=[-2], control_high=[2], start_mean=[0, 0])
    with pytest.raises(ValueError, match="start_mean has 3 entries; expected 2"):
        env_spec("Bounds-v0", control_low=[-1], control_high=[1], start_mean=[0, 0, 0])
    with pytest.raises(ValueError, match="start_mean has 1 entries; expected 2"):
        env_spec("Bounds-v0", control_low=[-1], control_high=[1], start_mean=[0])


@pytest.mark.slow
def test_runs_that_were_not_evaluated_are_compared_by_their_episodes(learned: Path) -> None:
    runs, problems = groups.readable([learned / "run"])
    assert not problems
    assert groups.measured(groups.grouped(runs)) == groups.OWN
    assert groups_picture(groups.grouped(runs), learned / "learning.png").stat().st_size > 1000
    with pytest.raises(ConfigError, match="eval_episodes=0"):
        study.study(Config(eval_episodes=0), [0])
    assert config_io.load(learned / "run" / "config.yaml").start_mean == (3.14, 0.0)
