"""pegasus-check: what would go wrong is said before anything moves, and pegasus-train says it first too."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import forked
from benchmarks import once
from pegasus_jax.checks import ConfigError
from pegasus_jax.cli.train import check as check_command
from pegasus_jax.cli.train import understood
from pegasus_jax.config import Config, Explore, Sensors
from pegasus_jax.runs import check, config_io
from pegasus_jax.tasks.cost_check import Facts
from probes import TINY_WORDS, cart

ROBOT = """
import gymnasium, numpy as np, jax.numpy as jnp

def cost(x): return 1 - jnp.exp(-2 * (1 - jnp.cos(x[0])))
def big(x): return 10 * (1 - jnp.cos(x[0]))
def reward(x): return -(1 - jnp.cos(x[0])) / 2
def python(x): return 0.0 if x[0] > 0 else 1.0
def square(x): return 1 - jnp.exp(-x ** 2)

def note(what):
    with open("asked.log", "a") as file:
        print(what, file=file)

class Arm(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-2.0, 2.0, (1,), np.float32)
    dt = 0.05
    def reset(self, *, seed=None, options=None):
        note("reset")
        super().reset(seed=seed)
        self.x = np.array([np.pi, 0.0]) + self.np_random.normal(0, 0.05, 2)
        return self.seen(), {}
    def seen(self):
        return self.x.copy()
    def step(self, control):
        note("step")
        self.x[1] += 0.1 * float(control[0])
        return self.seen(), 0.0, False, False, {}
    def close(self):
        note("close")

class Degrees(Arm):
    def seen(self):
        return np.rad2deg(self.x)

class Fails(Arm):
    def reset(self, **options):
        raise OSError("no motor answers")

class Twice(Arm):
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float64)
    def seen(self):
        return np.array([*self.x, 0.5 * np.cos(self.x[0]), 0.7])

for kind in (Arm, Degrees, Fails, Twice):
    gymnasium.register(f"{kind.__name__}-v0", kind)
"""
WORDS = ["task=gym", "angles=[0]", "horizon=5", "eval_episodes=0"]
TINY = [*TINY_WORDS, "trials=1"]


def call(name: str, *words: str, cwd: Path) -> tuple[int, str, list[str]]:
    (cwd / "robot.py").write_text(ROBOT)
    done = forked.command(name, *once(*WORDS, *words), cwd=cwd)
    log = cwd / "asked.log"
    return done.returncode, done.stdout + done.stderr, log.read_text().split() if log.exists() else []


def test_it_says_what_a_robot_is_like_and_moves_nothing(tmp_path: Path) -> None:
    code, said, asked = call("check", "env=robot:Arm-v0", "cost=robot:big", "start_mean=[3.14,0]", cwd=tmp_path)
    assert (code, asked) == (0, ["reset", "close"]), said
    for part in ("OrderEnforcing of Arm", "u0 from -2 to 2", "5 periods of 0.05 s", "x0, x1", "more than 1: success"):
        assert part in said
    assert "begin with a cost 2.6 times as wide" in said
    assert said.endswith("result  no error; read the notes\n")
    assert [path.name for path in tmp_path.iterdir() if path.name not in ("robot.py", "__pycache__")] == ["asked.log"]


def test_it_says_what_is_taken_for_what_was_left_unsaid(tmp_path: Path) -> None:
    words = ["env=robot:Arm-v0", "cost=robot:cost", "start_mean=[3.14,0]", "dt=0.1", "eval_episodes=20"]
    code, said, _ = call("check", *words, cwd=tmp_path)
    assert code == 0, said
    for part in ("dt=0.1, and env=robot:Arm-v0 has dt 0.05", "eval_episodes=0 leaves them out"):
        assert part in said


def test_the_cost_where_episodes_start_is_the_average_of_them(tmp_path: Path) -> None:
    """Not the cost of their mean, which is the goal here."""
    wide = ["env=robot:Arm-v0", "cost=robot:cost", "start_mean=[0,0]", "start_std=[1.5]"]
    code, said, _ = call("check", *wide, cwd=tmp_path)
    assert code == 0, said
    (told,) = (line.split()[3] for line in said.splitlines() if "cost at start" in line)
    angles = np.random.default_rng(1).normal(0, 1.5, 100_000)
    assert float(told) == pytest.approx(np.mean(1 - np.exp(-2 * (1 - np.cos(angles)))), abs=0.08)


@pytest.mark.parametrize("command", ["check", "train"])
@pytest.mark.parametrize(
    ("words", "says", "asks"),
    [
        (["env=robot:Arm-v0", "cost=robot:reward"], "is it a reward?", ["close"]),
        (["env=robot:Arm-v0", "cost=robot:python"], "is not a JAX function", ["close"]),
        (["env=robot:Degrees-v0", "cost=robot:cost"], "x0 is 18", ["reset", "close"]),
        (["env=robot:Fails-v0", "cost=robot:cost"], "OSError: no motor answers (robot.py:", ["close"]),
    ],
)
def test_a_mistake_is_one_line_and_moves_nothing(
    command: str, words: list[str], says: str, asks: list[str], tmp_path: Path
) -> None:
    code, said, asked = call(command, *words, "start_mean=[3.14,0]", *TINY, "out=run", cwd=tmp_path)
    lines = [line for line in said.splitlines() if not line.startswith(("learning ", "running on "))]
    assert (code, len(lines)) == (2, 1), said
    assert says in said
    assert asked == asks
    assert not (tmp_path / "run").exists()


def test_training_notes_what_checking_does(tmp_path: Path) -> None:
    words = ["env=robot:Twice-v0", "cost=robot:big", *TINY, "explore.trials=2", "dt=0.06"]
    code, said, _ = call("train", *words, "out=run", cwd=tmp_path)
    assert code == 0, said
    notes = [line for line in said.splitlines() if line.startswith("note: ")]
    assert len(notes) == 5, said
    for part in (
        "has dt 0.05",
        "more than 1: success",
        "x2 follows from cos(x0)",
        "resets: x3;",
        "trials=1 ends before",
    ):
        assert part in "\n".join(notes)


@pytest.mark.slow
def test_a_mujoco_file_is_checked_without_a_robot(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(
        '<mujoco><worldbody><body><joint name="j" type="hinge" axis="0 1 0" damping=".05"/><geom type="capsule"'
        ' size=".03" fromto="0 0 0 0 0 -.5"/></body></worldbody><actuator><motor joint="j" ctrlrange="-2 2"/>'
        "</actuator></mujoco>"
    )
    words = ["task=mjcf", "mjcf=arm.xml", "cost=robot:big", "dt=0.04", "start_std=[0.1]"]
    code, said, asked = call("check", *words, cwd=tmp_path)
    assert (code, asked) == (0, []), said
    for part in ("j [rad], j' [rad/s]", "more than 1: success"):
        assert part in said
    code, said, _ = call("check", *words, "start_mean=[180,0]", cwd=tmp_path)
    assert (code, said.count("\n")) == (2, 1), said
    assert "degrees?" in said


NAMES = ("angle [rad]", "rate [deg/s]")


def facts(start: float) -> Facts:
    wide = np.full(2, np.inf)
    return Facts(np.array([start, 0.0]), np.zeros(2), (0,), -wide, wide, np.zeros((0, 2)))


def test_angles_of_more_than_two_turns_are_degrees() -> None:
    at = lambda x: np.array([[x, 500.0]])  # noqa: E731
    assert check.plausible(at(-6.0), facts(3.14), NAMES) == []
    assert "more than a turn" in check.plausible(at(-7.0), facts(3.14), NAMES)[0]
    for reading, start in ((90.0, 0.0), (0.0, -180.0)):
        with pytest.raises(ConfigError, match=r"angle \[rad\] is .*degrees\? Return np.deg2rad"):
            check.plausible(at(reading), facts(start), NAMES)


def test_readings_that_follow_from_others_are_named() -> None:
    draws = np.random.default_rng(0)
    a, b = draws.normal(size=(2, 20))
    free = np.column_stack([a, b, a * b])
    assert check.alike(free) == []
    assert check.alike(free[:1]) == []
    (twice,) = check.alike(np.column_stack([a, b, 57.3 * a + 2]))
    assert twice.startswith("x2 follows from x0 in")
    (both,) = check.alike(np.column_stack([a, b, 3 * a - b]))
    assert both.startswith("x2 follows from x0, x1 in")
    (height,) = check.alike(np.column_stack([a, b, 0.5 * np.sin(a)]), angles=(0,))
    assert height.startswith("x2 follows from sin(x0) in")
    (still,) = check.alike(np.column_stack([a, np.full(20, 1e4), np.zeros(20)]))
    assert "the same after each of 20 resets: x1, x2;" in still
    (many,) = check.alike(np.zeros((20, 78)))
    assert "resets: x0, x1, x2, x3, x4, x5, x6, x7 and 70 more;" in many


@pytest.mark.parametrize(
    ("stop", "says"),
    [
        (lambda x: x > 1, r"returns an array of shape \(2,\)"),
        (lambda x: 3 * x[0], "is 3 at the start; expected a probability"),
        (lambda x: x[0] > 0.5, "is 1 at the start: every episode would end there"),
        (lambda x: x[0] > missing, "NameError"),  # type: ignore[name-defined] # noqa: F821
        (lambda x: jax.nn.sigmoid(x[0] - 9), None),
        (lambda x: x[0] > 1.5, None),
    ],
)
def test_where_episodes_end_is_looked_at_before_they_begin(stop: Any, says: str | None) -> None:
    task, config = cart()._replace(stop=stop), Config(task="gym", stop="robot:fallen")
    with pytest.raises(ConfigError, match=says) if says else nullcontext():
        check.stopping(config, task)


@pytest.mark.parametrize(
    ("names", "angles", "told"),
    [
        (("heading [rad]", "rate [rad/s]"), (0,), []),
        (
            ("heading [rad]", "rate [rad/s]"),
            (),
            ["heading [rad] is not in angles=; if it can turn around, give angles=[0]"],
        ),
        (
            ("hip [rad]", "knee [rad]"),
            (),
            ["hip [rad], knee [rad] are not in angles=; if they can turn around, give angles=[0,1]"],
        ),
        (("hip [rad]", "knee [rad]"), (1,), ["hip [rad] is not in angles=; if it can turn around, give angles=[0,1]"]),
        (("y [m]", "x1"), (0,), ["angles=[0]: y [m] is said to be an angle, and its unit is not rad"]),
        (("x0", "x1"), (0,), []),
    ],
)
def test_names_that_do_not_agree_with_angles_are_noted(
    names: tuple[str, ...], angles: tuple[int, ...], told: list[str]
) -> None:
    free = np.full(2, np.inf)
    facts = Facts(np.zeros(2), np.ones(2), angles, -free, free, np.zeros((0, 2)))
    assert check.turning(facts, names) == told


def test_a_period_that_may_be_in_milliseconds_is_noted() -> None:
    task = cart()._replace(horizon=60)
    assert check.lasting(task._replace(dt=9.9)) == []
    assert check.lasting(task._replace(dt=25.0)) == ["an episode of 60 periods of 25 s takes 1500 s; is dt in seconds?"]


@pytest.mark.parametrize(
    ("trials", "random", "told"),
    [
        (1, 5, "; give trials=6 or more, or explore.trials=1"),
        (2, 3, "trials=2 ends before the 3 random episodes of explore.trials=3 do: no policy will be learned"),
        (5, 5, ""),  # searched after the last one
        (1, 1, ""),
        (1, 0, ""),
    ],
)
def test_a_run_that_ends_before_its_first_search_is_noted(trials: int, random: int, told: str) -> None:
    config = Config(trials=trials, explore=Explore(trials=random))
    notes = check.before_training(config, cart())
    assert [told in note for note in notes] == [True] * bool(told)


@pytest.mark.parametrize(
    ("word", "told"),
    [
        ("seeds=0", "seeds=0 is out of range"),
        ("final=maybe", "final=maybe is"),
        ("mesh=4", "mesh=4 is not of the form SEEDSxPARTICLES"),
        ("mesh=2x1", "mesh=2x1 cannot share 1 seeds evenly; give mesh=1x1"),
        ("processes=2", "coordinator=HOST:PORT, processes=N and process=I"),
    ],
)
def test_what_a_run_would_refuse_the_check_refuses_too(word: str, told: str) -> None:
    for command in (check_command, understood):
        with pytest.raises(ConfigError, match=told):
            command(["task=cartpole", word])


def test_what_is_of_no_use_is_not_recommended() -> None:
    """The horizon of a task of ours is its own."""
    found = "\n".join(check.report(config_io.parse({"task": "cartpole"})))
    assert "25 periods of 0.1 s an episode" in found
    assert "horizon=" not in found


@pytest.mark.parametrize(("cutoff", "told"), [(1.0, False), (5.0, False), (100.0, True), (None, False)])
def test_a_filter_that_hardly_filters_is_noted(cutoff: float | None, told: bool) -> None:
    config = Config(sensors=Sensors(velocity="filter", cutoff=cutoff))
    assert [note.partition(":")[0] for note in check.filtering(config, cart()._replace(dt=0.1))] == [
        "sensors.cutoff=100 is above half of the control rate, 5 Hz"
    ] * told
