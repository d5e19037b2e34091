"""Sensors that are late, or measure no rates: imagination, the plant, the data and a file all have the same ones."""

import json
from functools import partial

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import savgol_filter

import folders
from pegasus_jax import memory, tasks
from pegasus_jax.assembly.experiments import build, compose
from pegasus_jax.checks import ConfigError
from pegasus_jax.config import Config, Sensors
from pegasus_jax.episode import run
from pegasus_jax.exports import as_c, parity, write
from pegasus_jax.imagine import matching
from pegasus_jax.imagine.rollout import rollout
from pegasus_jax.math.units import rate_of
from pegasus_jax.memory import coordinates
from pegasus_jax.policies.rate_limited import rate_limited
from pegasus_jax.runs import check, config_io, facts, store
from pegasus_jax.runs.controller import controller
from pegasus_jax.start import preset
from pegasus_jax.tasks.remembered import remembering, smoothed
from pegasus_jax.tasks.sensed import reduced, sensed
from pegasus_jax.types import Cost, Dynamics, Prediction, Scenarios
from probes import PLAIN, cart, linear_policy, tiny

H, DT = 8, 0.3
A, B = np.array([[1, DT], [0, 1]]), np.array([DT**2 / 2, DT])  # the probe's cart
KINDS = {
    "late": dict(sensors=Sensors(delay=2)),
    "difference": dict(sensors=Sensors(measured=(0,), velocity="difference")),
    "late filter": dict(sensors=Sensors(measured=(0,), velocity="filter", delay=1)),
    "history": dict(sensors=Sensors(measured=(0,), delay=1), history=3),
    "slow": dict(control_rate=(0.4,)),
    "slow and late": dict(sensors=Sensors(measured=(0,), velocity="difference", delay=1), control_rate=(0.4,)),
}


def sensing(name):
    """(config, the cart's task through these sensors, what it remembers included)."""
    config = tiny(**KINDS[name])
    task = cart(H)._replace(sensor_std=np.zeros(2))
    task = task if name != "history" else task._replace(cost=task.cost._replace(of_state=lambda x: x[0] ** 2))
    return config, tasks.augmented(remembering(config, sensed(task, config.sensors)))


def exact(task):
    """The cart as a model; of a history it is what two positions and the controls between tell of a third."""

    def apply(posterior, draw, x, u):
        # q + dq = 2 q - q' + dt^2 (u + u') / 2; given are u, u', u'' and q', q''
        history = lambda: x - u[3:4] + DT**2 / 2 * (u[0] + u[1])  # noqa: E731
        change = (A - np.eye(2)) @ x + B * u[0] if len(x) == 2 else history()
        return Prediction(change, jnp.zeros_like(x))

    return Dynamics(None, None, None, None, None, apply)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", KINDS)
def test_imagined_with_the_true_model_is_what_the_plant_does(name):
    """Without noise every state, control and memory of both is the same, whatever the sensors are.

    Of a history from the row on at which it tells the rate.
    """
    _, task = sensing(name)
    policy = rate_limited(linear_policy(len(memory.seen_names(task)), 1)._replace(memory=task.memory), task)
    gain = 0.5 * jax.random.normal(jax.random.key(4), (1, len(memory.seen_names(task)))) - 0.3
    ran = run(jax.random.key(0), lambda key, t, seen: policy.apply(gain, None, seen), task)
    whole = memory.join(ran.x, memory.replay(task.memory, ran))
    first = 3 if name == "history" else 0
    draws = [jnp.zeros((H - first, 1, size)) for size in (ran.x.shape[1], whole.shape[1])]
    given = Scenarios(whole[first : first + 1], jnp.zeros(1), jnp.zeros(1), *draws)
    rolled = rollout(gain, None, given, dynamics=exact(task), policy=policy, match=matching.keep)
    np.testing.assert_allclose(rolled.u[:, 0], ran.u[first:], rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(rolled.x[:, 0], whole[first:], rtol=1e-3, atol=1e-3)
    assert ran.u.std() > 0.02
    if "slow" in name:
        assert np.abs(np.diff(ran.u[:, 0], prepend=0)).max() == pytest.approx(0.4 * DT)


def test_a_late_plant_is_the_plant_of_the_controls_before():
    plain = cart(H)._replace(sensor_std=np.zeros(2))
    late = sensed(plain, Sensors(delay=2))
    u = np.random.default_rng(0).uniform(-2, 2, (H, 1)).astype(np.float32)
    moved = [
        run(jax.random.key(0), lambda key, t, x, c=c: jnp.asarray(c)[t], task).x
        for task, c in ((late, u), (plain, np.concatenate([np.zeros((2, 1), np.float32), u[:-2]])))
    ]
    np.testing.assert_array_equal(*moved)


@pytest.mark.parametrize("length", [3, 4, 5, 9, 14])
def test_rates_afterwards_are_those_of_scipy(length):
    """Whatever rows lie behind the end, and whatever turns the angle makes."""
    rows = 15
    task = cart(rows - 1)._replace(angles=(0,), dt=0.1)
    q = np.cumsum(np.random.default_rng(0).normal(1.5, 1, rows))
    seen = np.stack([np.angle(np.exp(1j * q)), np.full(rows, np.nan)], 1)
    seen[length + 1 :] = 99
    x, more = jax.jit(partial(smoothed, task=task))(jnp.asarray(seen), length, jnp.zeros((rows - 1, 1)))
    np.testing.assert_array_equal(more, (np.arange(rows - 1) == 0)[:, None])  # where the episode begins
    if length >= 4:
        truth = savgol_filter(q[: length + 1], 5, 3, deriv=1, delta=0.1)
        np.testing.assert_allclose(x[: length + 1, 1], truth, rtol=1e-3, atol=1e-3)
    np.testing.assert_array_equal(x[: length + 1, 0], seen[: length + 1, 0].astype(np.float32))
    assert np.isfinite(x[: length + 1]).all()


@pytest.mark.parametrize("length", [1, 2, 3, 4])
def test_rates_of_a_short_episode_are_right_where_they_are_constant(length):
    """The plant did not stop at its end, though no rows follow."""
    task, rows = cart(8)._replace(dt=0.1), np.zeros((9, 2), np.float32)
    rows[: length + 1, 0] = 0.2 * np.arange(length + 1)
    x, _ = smoothed(jnp.asarray(rows), length, jnp.zeros((8, 1)), task=task)
    np.testing.assert_allclose(x[: length + 1, 1], 2, rtol=1e-4)


@pytest.mark.parametrize("history", [1, 2])
def test_starts_of_one_s_own_are_those_of_what_is_measured(history):
    starts = ((0.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 3.0))
    config = Config(task="cartpole", sensors=Sensors(measured=(0, 3)), history=history, starts=starts)
    task = build(config).task
    np.testing.assert_array_equal(np.asarray(task.starts)[:, :2], [[0, 0], [1, 3]])
    assert np.shape(task.starts)[1] == np.shape(task.starts_std)[0] == len(task.start_mean)


ASKED = {  # by the names of its parameters, what a cost takes of a policy that remembers is asked for at each call
    "difference": lambda x, reference: 1 - jnp.exp(-((x[0] - reference[0]) ** 2)),
    "history": lambda x, goal: 1 - jnp.exp(-((x[0] - goal[0]) ** 2)),
    "slow": lambda x, t: 1 - jnp.exp(-((x[0] - t) ** 2)),
}
SETTINGS = {
    "difference": "sensors.measured=[0,3] sensors.velocity=difference sensors.delay=1",
    "filter": "sensors.measured=[0,3] sensors.velocity=filter sensors.cutoff=1.5 x64=true",
    "history": "sensors.measured=[0,3] history=3 sensors.delay=1 model=log_normal goal_low=[-1,0] goal_high=[1,2]",
    "late": "sensors.delay=2",
    "slow": "control_rate=20",
}
FORMATS = ("numpy", *(["c"] if any(map(as_c.shutil.which, as_c.COMPILERS)) else []), "onnx", "stablehlo")


@pytest.fixture(scope="module", params=SETTINGS)
def sensor_run(request, tmp_path_factory):
    """A run whose controller remembers. Where rates are computed, a cosine and a sine are seen."""
    name, words = request.param, dict(word.split("=", 1) for word in SETTINGS[request.param].split())
    asked = {"cost": ASKED[name]} if name in ASKED else {}
    asked |= {"reference": lambda t: jnp.sin(t)} if name == "difference" else {}
    task = tasks.of_config(config_io.parse({"task": "cartpole", **words, **asked}))
    task = task._replace(circles=((1, 2),)) if "velocity" in SETTINGS[name] else task
    changes = {key.replace(".", "__"): value for key, value in words.items()} | {"search__particles": "16"}
    return name, folders.a_run(tmp_path_factory.mktemp("run") / "run", made=task, trials=2, **changes)


def episode_of(name, control, steps=12):
    """An episode's observations [L, O], of a file, and what `controller` does: all that is asked for is told it."""
    sensors = {"filter": 3, "difference": 3, "history": 2}.get(name, 4)
    x = np.random.default_rng(3).normal(size=(steps, sensors)) * [1, *[3] * (sensors - 1)]
    now, ahead = 0.1 * np.arange(steps)[:, None], np.array([0, 0.1, 0.3])
    asked = {"difference": np.cos(now + ahead), "history": np.full((steps, 2), [0.3, -0.7]), "slow": now}
    control.reset()
    if name == "history":
        control.goal = [0.3, -0.7]
    if name == "difference":
        control.reference = np.cos
    return np.concatenate([x, asked.get(name, now[:, :0])], 1), np.stack([control(row) for row in x])


def test_a_file_remembers_as_the_controller_does(sensor_run):
    """Compared with the policy on 1,000 observations in episodes of 20; its contract says what it remembers."""
    name, run_of = sensor_run
    rows, expected = episode_of(name, controller(run_of, 2))
    for format in FORMATS:
        file = write.export(run_of, 2, format)
        said = json.loads(write.contract_of(file).read_text())
        assert said["parity"]["largest_difference"] <= said["parity"]["allowed"] < 2e-5
        found = write.FORMATS[format].run(file, rows.astype(expected.dtype), parity.EPISODE)
        # Of the policy that is told its own controls alone, roundings grow along an episode.
        np.testing.assert_allclose(found, expected, rtol=0, atol=0.02 if name == "late" else 2e-4)
        assert len(said["observation"]) == rows.shape[1]
        sensors = [entry["name"] for entry in said["observation"] if entry.get("is") != "asked for, no sensor's"]
        told = {"difference": 3, "history": 2, "slow": 1}.get(name, 0)
        assert len(sensors) == rows.shape[1] - told
        kept = {"difference": 2, "filter": 1, "history": 3, "late": 2, "slow": 1}
        assert said["history"]["controls"] == kept[name]
        assert said["control"][0].get("rate_per_s") == (20 if name == "slow" else None)
        assert (said["filter"] == "none") == (name not in ("difference", "filter"))
        if said["filter"] != "none":  # of the angle where its cosine and its sine are observed
            assert said["filter"]["rates_of"] == [store.task_of(run_of).state_names[i] for i in (0, 3)]
        assert ("memory" in said) == (format in ("onnx", "stablehlo"))
    assert np.ptp(expected) > 0.5
    zeros_begin_an_episode(run_of, rows[:3].astype(expected.dtype), expected)


def zeros_begin_an_episode(run_of, rows, expected):
    """In each row of a batch by itself; a memory that is handed on is the episode so far."""
    said = json.loads((run_of / "controller.onnx.json").read_text())
    session = onnxruntime.InferenceSession(run_of / "controller.onnx", providers=["CPUExecutionProvider"])
    memory = begun = np.array([[entry["initial"] for entry in said["memory"]]], rows.dtype)
    for x, u in zip(rows, expected, strict=False):
        both = {"observation": np.stack([rows[0], x]), "memory": np.concatenate([begun, memory])}
        control, after = session.run(["control", "next_memory"], both)
        np.testing.assert_allclose(control, [expected[0], u], atol=2e-4)
        memory = after[1:]
    act = jax.export.deserialize(bytearray((run_of / "controller.stablehlo").read_bytes())).call
    with jax.enable_x64(rows.dtype == np.float64):
        control, after = act(rows[0], begun[0])
        np.testing.assert_allclose(act(rows[1], after)[0], expected[1], atol=2e-4)


def test_a_reset_forgets_the_episode(sensor_run):
    name, run_of = sensor_run
    control = controller(run_of, 2)
    rows, expected = episode_of(name, control, steps=2)
    second = rows[1, : {"difference": 3, "history": 2, "slow": 4}.get(name)]
    control.reset()
    fresh = control(second)
    assert not np.allclose(expected[1], fresh, rtol=1e-6)
    control.reset()
    np.testing.assert_array_equal(control(second), fresh)


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("sensors.measured=[0,1] sensors.velocity=difference", "x' [m/s] is a rate itself; the nearest is sensors.mea"),
        ("sensors.measured=[9]", "sensors.measured=9 is not an entry; choose from 0 to 3"),
        ("sensors.measured=[0,1]", "the cost depends on theta [rad], entry 3, which is not measured"),
        ("sensors.delay=25", "sensors.delay=25 is no less than the episode, horizon=25"),
        ("sensors.velocity=diff", "sensors.velocity=diff is not a choice; did you mean 'difference'?"),
        ("sensors.cutoff=3", "sensors.cutoff=3 is of no use with sensors.velocity=none"),
        ("history=2 sensors.velocity=filter", "both stand for rates; the nearest is history=1"),
        ("history=0", "history=0 is out of range"),
    ],
)
def test_sensors_that_cannot_be_are_one_line(words, part):
    with pytest.raises(ConfigError) as refused:
        tasks.of_config(config_io.parse({"task": "cartpole", **dict(word.split("=", 1) for word in words.split())}))
    assert part in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


def test_an_early_end_by_what_is_not_measured_is_refused():
    """It would be told 0, and never come."""
    task = tasks.make("cartpole")._replace(stop=lambda x: jnp.abs(x[0]) > 40)
    with pytest.raises(ConfigError, match=r"the stop depends on x \[m\], entry 0, which is not measured"):
        reduced(task._replace(cost=Cost(lambda x: jnp.cos(x[3]))), [1, 2, 3])
    reduced(task, [0, 3])


class Slide(gymnasium.Env):
    """The probe's cart, of which the position is observed, behind an entry that is of no use."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,))
    action_space = gymnasium.spaces.Box(-2.0, 2.0, (1,))
    dt = DT

    def reset(self, *, seed=None, options=None):
        self.x = np.array([1.0, 0.0]) + np.random.default_rng(seed).normal(0, 0.1, 2)
        return np.array([7.0, self.x[0]]), {}

    def step(self, control):
        self.x = A @ self.x + B * control[0]
        return np.array([7.0, self.x[0]]), 0.0, False, False, {}


gymnasium.register("Slide-v0", Slide)


class Five(gymnasium.Env):
    """Two coordinates, an entry that is neither, and the rates of both."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (5,))
    action_space = gymnasium.spaces.Box(-2.0, 2.0, (1,))
    state_names = ("q", "p", "volt", "q'", "p'")
    dt = DT

    def reset(self, *, seed=None, options=None):
        return np.zeros(5), {}


gymnasium.register("Five-v0", Five)


def five(measured, **words):
    known = dict(env="Five-v0", cost=lambda x: x[0] ** 2, horizon=8, start_mean=[0] * 5, rates=[3, 4], **words)
    return tasks.of_config(tasks.resolve(preset("gym", settings=known | {"sensors.measured": measured})))


@given(st.sets(st.integers(0, 4), min_size=1).flatmap(lambda kept: st.permutations(sorted(kept))))
@settings(max_examples=40, deadline=None)
def test_a_rate_stays_with_what_it_is_the_rate_of(measured):
    """Whatever is measured, in whatever order: all of it is in pairs, or none of it counts as one."""
    task = five(measured)
    assert task.state_names == tuple(Five.state_names[i] for i in measured)
    pairs = [(task.state_names[i], task.state_names[r]) for i, r in zip(coordinates(task), task.rates, strict=False)]
    whole = {*measured} == {0, 1, 3, 4}
    assert pairs == ([(q, f"{q}'") for q in task.state_names if q in ("q", "p")] if whole else [])


def test_no_rate_of_a_rate_is_computed_and_none_is_taken_for_another():
    with pytest.raises(ConfigError, match=r"q' is a rate itself; the nearest is sensors.measured=\[0,1,2\]"):
        five([0, 3], **{"sensors.velocity": "difference"})
    with pytest.raises(ConfigError, match="model=lagrangian needs a state of coordinates and their rates"):
        tasks.rates_of(five([0, 4]))
    now, before = (facts.of_task(five([0, 3])) | {"rates": rates} for rates in ([], [1]))
    assert "its rates was" in str(facts.difference(before, now, pairs=True))  # once a pair, now not known to be one
    assert facts.difference(before, now, pairs=False) is None  # another model did not look at them


def test_of_a_simulation_the_cost_gets_all_and_what_else_its_user_gives_what_is_measured():
    """As docs/sensors.md says: a limit, or a controller, of what no sensor tells could not be kept, or be used."""
    seen = {}

    def saw(name, value):
        return lambda x: seen.setdefault(name, set()).add(x.shape) or value(x)

    given = {
        "cost": saw("cost", lambda x: 1 - jnp.exp(-(x[0] ** 2) - x[3] ** 2)),
        "constraint": saw("constraint", lambda x: jnp.abs(x[0]) - 9),
        "explore.policy": saw("explore.policy", lambda x: x[:1]),
    }
    words = {"sensors.measured": [0, 2, 3], "history": 2, "search.particles": 20}
    check.report(preset("cartpole", model="log_normal", settings=words | given))
    assert seen == {"cost": {(4,)}, "constraint": {(3,)}, "explore.policy": {(3,)}}


def squared(x):
    """Of what is measured, and its rate."""
    assert x.shape == (2,)
    return 1 - jnp.exp(-(x[0] ** 2) - 0.1 * x[1] ** 2)


def test_an_environment_gets_rates_as_a_robot_computes_them():
    words = "sensors.measured=[1] sensors.velocity=difference sensors.delay=1 horizon=8 start_mean=[7,1]"
    config = config_io.parse(
        {"task": "gym", "env": "Slide-v0", "cost": squared} | dict(word.split("=", 1) for word in words.split())
    )
    task = tasks.of_config(tasks.resolve(config))
    assert (task.state_names, task.rates) == (("x1", "rate of x1"), (1,))
    assert [*map(rate_of, ("x [m]", "swing [rad]"))] == ["rate of x [m/s]", "rate of swing [rad/s]"]
    np.testing.assert_array_equal(task.start_mean, [1, 0])
    config = tiny(sensors=config.sensors, search__steps=2, fit__steps=2, trials=2, **PLAIN)
    exp = compose(config, task)
    state = jax.jit(exp.init)(jax.random.key(0))
    add_episode = jax.jit(exp.add_episode)
    ran = exp.collect(state)
    x, u = np.asarray(ran.x), np.asarray(ran.u)
    np.testing.assert_allclose(x[1:, 1], np.diff(x[:, 0]) / DT, rtol=1e-4)
    assert x[0, 1] == 0
    added = add_episode(state, ran)
    np.testing.assert_allclose(added.data.u[:8, 0], [0, *u[:-1, 0]])  # aligned: the control that acted
    state, _ = jax.jit(exp.improve)(added)
    later = exp.collect(state)
    see = jax.vmap(memory.steps(exp.task.memory)[0])
    seen = jax.jit(lambda later: see(memory.replay(exp.task.memory, later)[:-1], later.x[:-1]))(later)
    np.testing.assert_allclose(seen[:, 0], later.x[:-1, 0])
    np.testing.assert_allclose(seen[:, -1], later.x[:-1, 1], rtol=1e-3, atol=1e-4)  # as the rows' own differences
