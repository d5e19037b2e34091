"""task=gym: environments that were not written for us become tasks by a line on the command line and a cost."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from pegasus_envs import gym_plant
from pegasus_envs.gym_plant import close_environments, env_plant, env_spec, make_env, period
from pegasus_jax import episode, interrupt, start, tasks
from pegasus_jax.assembly.experiments import compose
from pegasus_jax.checks import ConfigError, RunError
from pegasus_jax.config import Config
from pegasus_jax.memory import past_controls
from pegasus_jax.policies.driver import driver
from pegasus_jax.runs import check, config_io, store
from pegasus_jax.runs.collect import failed
from pegasus_jax.start import preset
from pegasus_jax.task import Task
from pegasus_jax.tasks import assumed
from pegasus_jax.types import Cost, Policy
from probes import TINY_WORDS, cart, tiny

TINY = [*TINY_WORDS, "trials=2"]
COSTS = """
import jax.numpy as jnp

def upright(x):  # Pendulum-v1: cos, sin, rate
    return (1 - x[0]) / 2

def balanced(x):  # InvertedDoublePendulum-v5: cart, sin x2, cos x2, rates, force
    return 1 - jnp.exp(-(x[1] ** 2 + x[2] ** 2 + (x[3] - 1) ** 2 + (x[4] - 1) ** 2))
"""


def train(*words: object, cwd: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    (cwd / "costs.py").write_text(COSTS)
    program = [sys.executable, "-P", "-c", "from pegasus_jax.cli.main import train; train()", "task=gym"]
    given = dict(cwd=cwd, capture_output=True, text=True, check=False, env=os.environ | variables)
    return subprocess.run([*program, *map(str, words)], **given)  # type: ignore[call-overload]


@pytest.mark.parametrize(
    ("env", "cost", "states", "limit"),
    [
        ("Pendulum-v1", "costs:upright", 3, 2.0),
        pytest.param("InvertedDoublePendulum-v5", "costs:balanced", 9, 1.0, marks=pytest.mark.campaign),
    ],
)
def test_an_environment_not_written_for_us(env: str, cost: str, states: int, limit: float, tmp_path: Path) -> None:
    """What the run stored is what Gymnasium says: the same controls from the same start give the same observations.

    TensorBoard's writer imports PyTorch where it is there; SciPy, in the compiler's thread, would ask it for a Tensor.
    """
    (torch := tmp_path / "slow" / "torch").mkdir(parents=True)
    (torch / "__init__.py").write_text("import time\nprint('importing')\ntime.sleep(3)\nclass Tensor: pass\n")
    path = os.pathsep.join([str(torch.parent), os.environ.get("PYTHONPATH", "")])
    done = train(f"env={env}", f"cost={cost}", "horizon=8", *TINY, "out=run", cwd=tmp_path, PYTHONPATH=path)
    assert done.returncode == 0, done.stderr
    assert "importing" in done.stdout + done.stderr
    assert done.stderr.count("circles=[[") == 1
    rows = store.trials(tmp_path / "run")
    assert [row["random"] for row in rows] == [True, False]
    assert all(np.isfinite(row["mean_cost"]) for row in rows)
    for trial in (1, 2):
        ran = store.load_episode(tmp_path / "run", trial)
        assert ran is not None
        steps = len(ran.trajectory.u)  # the double pendulum falls before it is over
        with np.load(store.episode_path(tmp_path / "run", trial)) as file:
            assert file["observation"].shape == (steps + 1, states)
            assert ran.trajectory.x.shape == (steps + 1, states - len(file["circles"]))
        assert (steps == 8) == (ran.ended == "horizon")
        assert np.all(np.abs(ran.trajectory.u) <= limit)
    assert config_io.load(tmp_path / "run" / "config.yaml").env == env


def task_of(env: str, states: int, horizon: int = 9, low: float = -2.0, high: float = 2.0) -> Task:
    """A task on a registered environment of one control, whose cost is that of its first observation."""
    return cart(horizon)._replace(
        rates=(),
        name=env,
        plant=None,
        environment=env_plant(env, (), states, 1),
        cost=Cost(lambda x: x[0] ** 2, widen=lambda factor: Cost(lambda x: (x[0] / factor) ** 2)),
        state_names=tuple(f"x{i}" for i in range(states)),
        start_mean=np.zeros(states),
        start_std=np.ones(states),
        sensor_std=np.zeros(states),
        control_low=np.array([low]),
        control_high=np.array([high]),
    )


def test_an_episode_is_what_gymnasium_says() -> None:
    controls = np.linspace(-2, 2, 9, dtype=np.float32)[:, None]
    ran = episode.drive(4, lambda t, x: controls[t], task_of("Pendulum-v1", 3))
    assert (ran.ended, ran.error) == ("horizon", None)
    env = gymnasium.make("Pendulum-v1")
    x, _ = env.reset(seed=4)
    np.testing.assert_array_equal(ran.trajectory.x, [x, *(env.step(u)[0] for u in controls)])
    np.testing.assert_array_equal(ran.trajectory.u, controls)


class Base(gymnasium.Env):
    """Counts its steps, and remembers what was sent."""

    action_space: gymnasium.Space = gymnasium.spaces.Box(-1, 1, (1,))
    observation_space: gymnasium.Space = gymnasium.spaces.Box(-np.inf, np.inf, (1,))
    sent: ClassVar[list] = []
    closed = 0

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> Any:
        self.count = 0
        type(self).sent.clear()
        return np.zeros(1), {}

    def step(self, action: Any) -> Any:
        self.count += 1
        self.sent.append(np.array(action))
        return np.full(1, float(self.count)), 0.0, False, False, {}

    def close(self) -> None:
        type(self).closed += 1


class Terminates(Base):
    def step(self, action: Any) -> Any:
        assert self.count < 3, "stepped after its end"
        x, cost, *_ = super().step(action)
        return x, cost, self.count == 3, False, {}


class Truncates(Terminates):
    def step(self, action: Any) -> Any:
        x, cost, over, _, info = super().step(action)
        return x, cost, False, over, info


class Breaks(Base):
    def step(self, action: Any) -> Any:
        if self.count == 3:
            raise OSError("the limit switch opened")
        return super().step(action)


class Swallows(Base):
    """A signal comes in the third step, and a bare except takes it."""

    def step(self, action: Any) -> Any:
        try:
            if self.count == 2:
                signal.raise_signal(signal.SIGINT)
        except:  # noqa: E722
            pass
        return super().step(action)


class Buffer(Base):
    """Writes every observation into one array, and what it does to a control into that."""

    def reset(self, **options: Any) -> Any:
        super().reset(**options)
        self.buffer = np.zeros(1, np.float32)
        return self.buffer, {}

    def step(self, action: Any) -> Any:
        self.buffer[:] = super().step(action)[0]
        action *= 0.0
        return self.buffer, 0.0, False, False, {}


class Whole(Base):
    action_space = gymnasium.spaces.Box(-5, 5, (1,), np.int32)


class Two(Base):
    action_space = gymnasium.spaces.Box(-1, 1, (2,))


class Rests(Terminates):
    """Its rest is called `rested` times, and fails the third time."""

    rested = 0

    def rest(self) -> None:
        Rests.rested += 1
        if Rests.rested == 3:
            raise OSError("the brake does not close")


class Restless(Base):
    rest = 0.5  # of a user's own, and no method


CLASSES = (Terminates, Truncates, Breaks, Swallows, Buffer, Whole, Two, Rests, Restless)
for made in CLASSES:
    gymnasium.register(f"{made.__name__}-v0", made)


@pytest.mark.parametrize(("made", "ended"), [(Terminates, "terminated"), (Truncates, "truncated")])
def test_an_end_ends_the_episode_and_no_row_is_invented(made: type, ended: str) -> None:
    task = task_of(f"{made.__name__}-v0", 1)
    for seed in range(2):  # a reset begins another
        ran = episode.drive(seed, lambda t, x: np.ones(1), task)
        assert (ran.ended, ran.error) == (ended, None)
        np.testing.assert_array_equal(ran.trajectory.x[:, 0], [0, 1, 2, 3])
        assert ran.trajectory.u.shape == (3, 1)


def test_an_environment_rests_after_an_episode_and_may_have_no_way_to() -> None:
    """Else the last control stays in force while a model is fitted. What it raises is an error of that episode."""
    task = task_of("Rests-v0", 1)
    for horizon, ended in ((2, "horizon"), (9, "terminated"), (2, "error")):
        ran = episode.drive(0, lambda t, x: np.ones(1), task._replace(horizon=horizon))
        assert (ran.ended, len(ran.trajectory.u)) == (ended, min(horizon, 3))
    assert (str(ran.error), Rests.rested) == ("the brake does not close", 3)
    task.environment.rest()  # it was closed, and is not opened for that
    assert Rests.rested == 3
    assert episode.drive(0, lambda t, x: np.ones(1), task_of("Restless-v0", 1)).error is None


def test_an_environment_of_another_number_of_controls_gets_none() -> None:
    """As one that was changed after its policy was learned: NumPy would send one control to every motor."""
    Base.sent.clear()
    ran = episode.drive(0, lambda t, x: np.ones(1), task_of("Two-v0", 1))
    assert (ran.ended, str(ran.error)) == ("error", "its action_space has shape (2,); expected (1,)")
    assert not Base.sent


def test_a_time_limit_that_is_the_horizon_ends_nothing_early() -> None:
    ends = [episode.drive(0, lambda t, x: np.ones(1), task_of("Truncates-v0", 1, horizon=n)).ended for n in (3, 4)]
    assert ends == ["horizon", "truncated"]


def test_the_rows_before_an_exception_are_kept_and_the_environment_is_closed() -> None:
    Breaks.closed = 0
    ran = episode.drive(0, lambda t, x: np.ones(1), task_of("Breaks-v0", 1))
    assert (ran.ended, str(ran.error)) == ("error", "the limit switch opened")
    np.testing.assert_array_equal(ran.trajectory.x[:, 0], [0, 1, 2, 3])
    assert Breaks.closed == 1


def test_no_control_follows_a_signal_that_the_environment_swallowed() -> None:
    Swallows.closed, before = 0, {number: signal.getsignal(number) for number in interrupt.SIGNALS}
    interrupt.listen()
    try:
        ran = episode.drive(0, lambda t, x: np.ones(1), task_of("Swallows-v0", 1))
        assert (ran.ended, type(ran.error)) == ("interrupted", interrupt.Interrupted)
        assert (len(Swallows.sent), len(ran.trajectory.u), Swallows.closed) == (3, 3, 1)
        assert interrupt.status() == 130
    finally:
        interrupt.listen()
        for number, handler in before.items():
            signal.signal(number, handler)


def test_observations_and_controls_are_copies() -> None:
    ran = episode.drive(0, lambda t, x: np.full(1, 0.5), task_of("Buffer-v0", 1, horizon=4))
    np.testing.assert_array_equal(ran.trajectory.x[:, 0], [0, 1, 2, 3, 4])
    np.testing.assert_array_equal(ran.trajectory.u[:, 0], [0.5] * 4)


def test_whole_controls_are_rounded_and_recorded_as_they_were_sent() -> None:
    asked = np.array([0.4, 0.6, -2.7, 9.0])
    ran = episode.drive(0, lambda t, x: asked[t : t + 1], task_of("Whole-v0", 1, horizon=4))
    np.testing.assert_array_equal(ran.trajectory.u[:, 0], [0, 1, -3, 5])
    assert [(u.dtype, int(u[0])) for u in Whole.sent] == [(np.dtype(np.int32), n) for n in (0, 1, -3, 5)]


def test_an_environment_is_used_as_it_was_made() -> None:
    """Its wrappers decide what its limits are, what it observes, what reaches the motor, and when it is over."""
    gymnasium.register(
        "Safe-v0",
        lambda: gymnasium.wrappers.TimeLimit(
            gymnasium.wrappers.RescaleAction(Base(), np.float32(-10), np.float32(10)), 4
        ),
    )
    known = env_spec("Safe-v0", start_mean=[0.0])
    np.testing.assert_array_equal([known.control_low, known.control_high], [[-10], [10]])
    ran = episode.drive(0, lambda t, x: np.full(1, 5.0), task_of("Safe-v0", 1, low=-10, high=10))
    assert (ran.ended, len(ran.trajectory.u)) == ("truncated", 4)
    np.testing.assert_allclose(np.ravel(Base.sent), [0.5] * 4)
    np.testing.assert_allclose(ran.trajectory.u[:, 0], [5.0] * 4)


def test_constructor_arguments_are_what_they_look_like() -> None:
    seen: dict = {}
    gymnasium.register("Asks-v0", lambda **given: seen.update(given) or Base())
    make_env("Asks-v0", ("port=/dev/ttyACM0", "baud=9600", "fast=true"))
    assert seen == {"port": "/dev/ttyACM0", "baud": 9600, "fast": True}
    for text, value in {"False": False, "None": None, "True": True, "null": None}.items():
        make_env("Asks-v0", (f"fast={text}",))
        assert seen["fast"] is value


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
        max_leaves=5,
    )
)
@settings(max_examples=20, deadline=None)
def test_a_value_from_python_reaches_the_constructor_as_it_is(value: Any) -> None:
    """Also from the config.yaml of a run; a list of numbers of NumPy, or a tuple, as a list."""
    assume("${" not in str(value))
    config = config_io.override(
        Config(task="gym"), {"env_args": preset("gym", settings={"env_args.x": value}).env_args}
    )
    (pair,) = config_io.stored_config(config_io.plain(config)).env_args
    assert pair.startswith("x=")
    found = gym_plant._value(pair.removeprefix("x="))
    assert found == value
    assert type(found) is type(value)


def test_arguments_from_python_may_be_a_dict(tmp_path: Path) -> None:
    dotted, nested = {"env_args.x": "5", "env_args.y": 2}, {"env_args": {"x": "5", "y": 2}}
    assert preset("gym", settings=nested).env_args == preset("gym", settings=dotted).env_args == ('x="5"', "y=2")
    for words in ({"env_args": {"pole_mas": 1}}, {"env_args.pole_mas": 1}):
        for config in ("cartpole", preset("cartpole")):
            with pytest.raises(ConfigError, match=r"env_args.pole_mas is no constant of the plant; .*pole_mass"):
                start.train(config, settings=words, out=tmp_path / "run")


def test_what_no_folder_can_keep_is_no_argument() -> None:
    made = {given: preset("gym", settings={"env_args.x": given}).env_args for given in ((1, 2), np.float32(0.5))}
    assert made == {(1, 2): ("x=[1, 2]",), np.float32(0.5): ("x=0.5",)}
    with pytest.raises(
        ConfigError, match=r"env_args.x is of type object, which a run's folder cannot keep; expected a"
    ):
        preset("gym", settings={"env_args.x": object()})
    assert tasks.of_config(preset("cartpole", settings={"env_args.pole_mass": "0.4"})).horizon
    with pytest.raises(ConfigError, match=r"env_args.pole_mass=true is not a number"):
        tasks.of_config(preset("cartpole", settings={"env_args.pole_mass": True}))


@pytest.mark.parametrize(
    ("answer", "step", "says"),
    [
        (np.zeros(1), None, "its reset returned ndarray; expected (observation, info)"),
        (
            (np.zeros(1), {}),
            (np.zeros(1), 0.0, False, {}),
            "its step returned 4 values; expected (observation, reward,",
        ),
        ((np.zeros(1), {}), (np.zeros((1, 1)), 0.0, False, False, {}), "of shape (1, 1); expected (1,)"),
        ((np.zeros(1), {}), (None, 0.0, False, False, {}), "it observed an array of shape (); expected (1,)"),
        ((np.zeros(1), {}), (np.array([np.nan]), 0.0, False, False, {}), "entry 0 of its observation is nan"),
    ],
)
def test_what_is_no_answer_of_gymnasium_is_said(answer: Any, step: Any, says: str) -> None:
    gymnasium.register("Odd-v0", lambda: Odd(answer, step))
    ran = episode.drive(0, lambda t, x: np.zeros(1), task_of("Odd-v0", 1))
    assert ran.ended == "error"
    assert says in str(ran.error)
    when = "the reset" if step is None else "control period 1"
    with pytest.raises(RunError) as refused:
        failed(ran, task_of("Odd-v0", 1))
    assert str(refused.value) == f"Odd-v0 failed in {when} of an episode: {ran.error}"


class Odd(Base):
    def __init__(self, answer: Any, after: Any) -> None:
        self.answer, self.after = answer, after

    def reset(self, **options: Any) -> Any:
        return self.answer

    def step(self, action: Any) -> Any:
        return self.after


@pytest.mark.parametrize(
    ("about", "dt"),
    [({"dt": 0.02}, 0.02), ({"metadata": {"render_fps": 50}}, 0.02), ({"metadata": {"render_fps": None}}, 1)],
)
def test_the_control_period_is_what_the_environment_says(about: dict, dt: float) -> None:
    assert period(type("Timed", (Base,), about)()) == pytest.approx(dt)


@pytest.mark.parametrize(
    ("about", "dt", "told"),
    [
        ({}, None, "env=Period-v0 says no dt; a period of 1 s is assumed"),
        ({}, 0.1, None),
        ({"metadata": {"render_fps": 20}}, None, None),
        ({"dt": 0.05}, None, None),
        ({"dt": 0.05}, 0.05, None),
        ({"dt": 0.05}, 0.1, "dt=0.1, and env=Period-v0 has dt 0.05"),
        ({"dt": "fast"}, 0.1, None),
    ],
)
def test_a_control_period_that_nobody_said_or_two_did_is_noted(about: dict, dt: float | None, told: str | None) -> None:
    gymnasium.register("Period-v0", type("Period", (Base,), about))
    close_environments()
    notes = assumed.notes(Config(task="gym", env="Period-v0", dt=dt, eval_episodes=0))
    assert [note.startswith(told or "") for note in notes] == [True] * (told is not None), notes
    close_environments()


@pytest.mark.parametrize(
    ("task", "said", "own", "told"),
    [("gym", None, 1000, True), ("gym", None, 100, False), ("gym", 1000, 1000, False), ("cartpole", None, 1000, False)],
)
def test_a_horizon_that_nobody_said_and_is_long_is_noted(task: str, said: int | None, own: int, told: bool) -> None:
    gymnasium.register("Long-v0", Base, max_episode_steps=1000)
    notes = assumed.length(Config(task=task, env="Long-v0", horizon=said), cart()._replace(horizon=own))
    assert [note.startswith("an episode has the environment's own 1000 periods") for note in notes] == [True] * told


@pytest.mark.parametrize(("horizon", "told"), [(5, False), (9, True)])
def test_a_limit_that_ends_every_episode_early_is_noted(horizon: int, told: bool) -> None:
    gymnasium.register("Brief-v0", Base, max_episode_steps=5)
    config = Config(task="gym", env="Brief-v0", dt=0.1, horizon=horizon)
    found = assumed.length(config, task_of("Brief-v0", 1, horizon))
    assert [note.partition(":")[0] for note in found] == [
        "horizon=9, and the environment's own limit ends each episode after 5 periods"
    ] * told


def test_a_rate_that_is_computed_is_no_dead_sensor() -> None:
    draw = np.random.default_rng(0)
    made = type("Encoder", (Base,), {"reset": lambda self, **_: (draw.normal(size=1), {})})
    gymnasium.register("Encoder-v0", made)
    words = {"task": "gym", "env": "Encoder-v0", "dt": "0.1", "horizon": "5", "eval_episodes": "0"}
    words |= {"cost": lambda x: 1 - jnp.exp(-(x[0] ** 2)), "sensors.velocity": "difference"}
    found = "\n".join(check.report(config_io.parse(words)))
    assert "rate of x0" in found
    assert "may be dead" not in found
    close_environments()


@pytest.mark.parametrize(("task", "episodes", "count"), [("gym", 20, 1), ("gym", 0, 0), ("cartpole", 20, 0)])
def test_episodes_that_only_measure_are_noted_where_a_robot_may_run_them(task: str, episodes: int, count: int) -> None:
    gymnasium.register("Measured-v0", Base)
    notes = assumed.notes(Config(task=task, env="Measured-v0", dt=0.1, eval_episodes=episodes))
    assert len(notes) == count
    assert all("20 more episodes" in note and "eval_episodes=0 leaves them out" in note for note in notes)


@pytest.mark.parametrize(
    ("observed", "says"),
    [
        (gymnasium.spaces.Dict({"a": gymnasium.spaces.Box(-1, 1, (2,)), "b": gymnasium.spaces.Box(-1, 1)}), 3),
        (gymnasium.spaces.Box(-1, 1, (2, 3)), 6),
        (gymnasium.spaces.Sequence(gymnasium.spaces.Discrete(2)), None),
        (gymnasium.spaces.Box(0, 255, (32, 32, 3), np.uint8), None),
    ],
)
def test_an_observation_that_is_no_vector_is_refused_with_a_way_out(observed: Any, says: int | None) -> None:
    made = type("Shaped", (Base,), {"observation_space": observed, "reset": lambda self, **_: (observed.sample(), {})})
    gymnasium.register("Shaped-v0", made)
    close_environments()
    with pytest.raises(ValueError, match="not a Box of one dimension; ") as error:
        env_spec("Shaped-v0")
    assert ("FlattenObservation(env)" in str(error.value)) == (says is not None)
    assert ("3,072 numbers are too many for this program, as an image's are" in str(error.value)) == (
        observed.shape == (32, 32, 3)
    )
    if says:
        gymnasium.register("Flat-v0", lambda: gymnasium.wrappers.FlattenObservation(made()))
        assert env_spec("Flat-v0").start_mean.shape == (says,)
    close_environments()


@pytest.mark.parametrize("dt", [lambda self: 0.05, "fast", 0.0, True])
def test_a_control_period_that_is_none_is_refused(dt: Any) -> None:
    with pytest.raises(ValueError, match="not a number of seconds; give dt="):
        period(type("Timed", (Base,), {"dt": dt})())


def test_what_did_not_take_place_costs_what_the_user_says() -> None:
    task = task_of("Terminates-v0", 1, horizon=6)._replace(stop_cost=0.7)
    np.testing.assert_allclose(episode.charged([0.1, 0.2], task), [0.1, 0.2, 0.7, 0.7, 0.7, 0.7])
    exp = compose(tiny(), task)
    state = jax.jit(exp.init)(jax.random.key(1))
    ran = exp.drive(jax.random.key(0), state.policy.params, True)
    np.testing.assert_allclose(ran.trajectory.cost, [1.0, 4.0, 9.0])  # of the states 1, 2 and 3
    whole = exp.episode(jax.random.key(0), state.policy.params, True)
    assert (whole.x.shape, whole.u.shape, int(whole.length)) == ((7, 1), (6, 1), 3)
    state = jax.jit(exp.add_episode)(state, whole)
    assert int(state.data.size) == 3
    np.testing.assert_array_equal(state.data.x[:, 0], [0, 1, 2, *[0] * (len(state.data.x) - 3)])


def test_nothing_is_compiled_while_a_robot_moves() -> None:
    """In double precision too, and of a first controller that is JAX's: all of it is traced before the reset."""
    traced: list[str] = []

    def noted(name: str, u: Any) -> Any:
        traced.append(name)
        return u

    with jax.enable_x64(True):
        task = task_of("Terminates-v0", 1, horizon=6)
        before: list[list[str]] = []
        reset = task.environment.reset
        task = task._replace(
            environment=task.environment._replace(reset=lambda seed: (before.append([*traced]), reset(seed))[1]),
            guide=jax.jit(lambda x: noted("guide", -x)),
            memory=past_controls(("u",), np.zeros(1), 1, shown=True),
        )
        policy = Policy(
            init=lambda key: jnp.ones(1),
            sample=lambda key: jnp.zeros(1),
            apply=lambda params, noise, seen: noted("policy", params * jnp.tanh(seen[:1] + seen[1:])),
        )
        drive = driver(task, policy, lambda key: jnp.zeros((6, 1)))
        ran = [drive(jax.random.key(0), jnp.ones(1), exploring) for exploring in (True, False, True)]
    assert [len(one.trajectory.u) for one in ran] == [3, 3, 3]
    assert before[0] == traced == ["policy", "guide"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "task=gym needs env= and cost="),
        (["env=Pendulum-v1"], "task=gym needs cost=; for example cost=mymodule:cost"),
        (["env=Pendulumm-v1", "cost=costs:upright"], "Pendulum"),
        (
            ["env=CartPole-v1", "cost=costs:upright"],
            "Discrete(2), not a Box of one dimension; controls must be numbers in",
        ),
        (["env=Pendulum-v1", "cost=costs:down"], "cost=costs:down cannot be imported"),
        (["env=Pendulum-v1", "cost=nowhere:down"], "no module named 'nowhere' in"),
        (["env=Pendulum-v1", "cost=costs"], "expected cost=module:function"),
        (["env=Pendulum-v1", "cost=costs:upright", "angles=[3]"], "choose from 0 to 2"),
        (["env=Pendulum-v1", "cost=costs:upright", "horizon=0"], "the nearest is 1"),
    ],
)
def test_bad_input_is_one_clear_line(words: list[str], message: str, tmp_path: Path) -> None:
    done = train(*words, cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert message in done.stderr


def test_limits_that_are_the_environments_own_are_typed_in_double_precision() -> None:
    """A box has them in single precision: 0.7 is less there."""

    class Narrow(Base):
        action_space = gymnasium.spaces.Box(-0.7, 0.7, (1,))

    gymnasium.register("Narrow-v0", Narrow)
    spec = env_spec("Narrow-v0", control_low=[-0.7], control_high=[0.7], dt=0.1)
    np.testing.assert_allclose(spec.control_high, [0.7])
    with pytest.raises(ValueError, match=r"controls from -0\.7 to 0\.71 are beyond its limits"):
        env_spec("Narrow-v0", control_low=[-0.7], control_high=[0.71], dt=0.1)
    with pytest.raises(ValueError, match=r"controls from 0\.5 to -0\.5: expected control_low below control_high"):
        env_spec("Narrow-v0", control_low=[0.5], control_high=[-0.5], dt=0.1)


@pytest.mark.parametrize("flags", [(np.array([False, False]), False), (False, np.zeros(2))])
def test_an_end_that_is_no_truth_is_named(flags: tuple) -> None:
    class Vague(Base):
        def step(self, action: Any) -> Any:
            return np.zeros(1), 0.0, *flags, {}

    gymnasium.register("Vague-v0", Vague)
    ran = episode.drive(0, lambda t, x: np.ones(1), task_of("Vague-v0", 1))
    close_environments()
    assert "its step returned terminated=" in str(ran.error)
    assert "expected True or False" in str(ran.error)
