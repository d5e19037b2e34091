"""Costs of controls, time, references and goals: the same numbers in imagination, on a plant and on an environment."""

import json
import runpy
from dataclasses import replace
from functools import partial
from inspect import signature

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from folders import a_run
from pegasus_jax import episode, memory, tasks
from pegasus_jax.assembly.experiments import build, compose
from pegasus_jax.checks import ConfigError
from pegasus_jax.exports.drive import drives
from pegasus_jax.exports.write import FORMATS, export
from pegasus_jax.imagine import costs
from pegasus_jax.runs import check, config_io, facts
from pegasus_jax.runs.check import before_training
from pegasus_jax.runs.controller import controller
from pegasus_jax.runs.restore import restored
from pegasus_jax.start import train
from pegasus_jax.tasks import signals, starts, terms
from pegasus_jax.types import Cost
from probes import cart, tiny


def parse(**words):
    return config_io.parse(words)


LATE = {
    "task": "cartpole",
    "sensors.measured": "[0,3]",
    "sensors.velocity": "difference",
    "sensors.delay": "3",
}


def price(x, u, previous_u, t, reference, goal):
    """Every term with a weight that tells it from the others."""
    rest = 2 * jnp.sum(u) + 3 * jnp.sum(previous_u) + 5 * t + 7 * jnp.sum(reference) + 11 * goal[0] + 13 * goal[1]
    return jnp.sum(x) + rest


def sine(t):
    return jnp.sin(t)


def goals(key):
    return jax.random.uniform(key, (2,), minval=-0.3, maxval=0.3)


# The names of its parameters


def test_a_cost_says_by_names_what_it_takes():
    assert terms.terms_of(lambda x: 0) == ()
    assert terms.terms_of(lambda state, u: 0) == ("u",)
    assert terms.terms_of(lambda x, t, previous_u, width=0.3, *rest, **more: 0) == ("t", "previous_u")
    assert terms.terms_of(jax.jit(lambda x, goal: 0)) == ("goal",)
    assert terms.terms_of(price) == terms.TERMS
    assert terms.terms_of(partial(price, goal=3)) == ("u", "previous_u", "t", "reference")  # its owner's
    assert terms.terms_of(lambda x, *, goal=3: 0) == ()


@pytest.mark.parametrize(
    ("cost", "said"),
    [
        (lambda x, v: 0, r"takes v, which nothing gives it; .*choices: u, previous_u, t, reference, goal"),
        (lambda x, previous: 0, "did you mean 'previous_u'"),
        (lambda x, goal: 0, "takes a goal, and there is none; give goal_low= and goal_high="),
        (lambda x, reference: 0, "takes a reference, and there is none; give reference=file.csv"),
    ],
)
def test_a_cost_that_nobody_can_serve_is_one_line(cost, said):
    with pytest.raises(ConfigError, match=said) as caught:
        compose(tiny(), cart(), cost=cost)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ({"goal_low": "[0]", "goal_high": "[1]"}, "the goal is of no use: cost=.* no parameter goal"),
        ({"goal_low": "[0,0]", "goal_high": "[1]"}, "goal_low has 2 entries and goal_high 1"),
        ({"goal_low": "[0]", "goal_high": "[0]"}, "goal_low=0 must be less than goal_high=0"),
        ({"goal_low": "[0]", "goal_high": "[1]", "goals": goals}, "leave out goal_low= and goal_high="),
        ({"goals": lambda key: jnp.zeros((2, 2))}, r"returns an array of shape \(2, 2\); expected one number or"),
        ({"goals": "nowhere:goals"}, "goals=nowhere:goals cannot be imported"),
        ({"reference": lambda t: jnp.nan}, "expected finite numbers"),
        (
            {"reference": "lost.csv"},
            "reference=lost.csv is not there; expected a file .csv or .npz, or module:function",
        ),
        ({"starts": "[[0,0]]"}, r"a row of starts has 2 entries; expected 4: x \[m\], "),
    ],
)
def test_settings_that_cannot_be_are_one_line(words, said):
    with pytest.raises(ConfigError, match=said) as caught:
        tasks.augmented(tasks.of_config(parse(task="cartpole", **words)))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 and no more"])
def test_a_damaged_reference_is_one_line(content, tmp_path):
    file = tmp_path / "path.npz"
    file.write_bytes(content)
    with pytest.raises(ConfigError, match=r"path.npz cannot be read as times and values: ") as caught:
        tasks.of_config(parse(task="cartpole", cost=price, reference=str(file), goals=goals))
    assert "\n" not in str(caught.value)


# What a cost gets, and when


@pytest.fixture(scope="module")
def run():
    """An experiment whose cost takes everything, and an episode of it."""
    config = parse(task="cartpole", cost=price, reference=sine, goals=goals, **SMALL)
    exp = build(config)
    ran = jax.jit(exp.episode)(jax.random.key(2), jax.jit(exp.init)(jax.random.key(1)).policy.params, True)
    return exp, ran


SMALL = {
    "model": "log_normal",
    "model.hidden": "[8]",
    "policy.hidden": "[8]",
    "fit.steps": "3",
    "search.steps": "2",
    "search.particles": "16",
    "search.refine_fraction": "0",
    "search.init": "previous",
    "trials": "2",
}


def test_a_cost_of_a_state_gets_the_control_that_led_to_it_the_one_before_and_its_time(run):
    exp, ran = run
    task, (x, u) = exp.task, (np.asarray(ran.x), np.asarray(ran.u))
    before = np.concatenate([np.zeros((1, 1)), u[:-1]])
    t, goal = 0.1 * np.arange(1, 26), np.asarray(ran.memory)[-2:]
    rest = 2 * u[:, 0] + 3 * before[:, 0] + 5 * t + 7 * np.sin(t) + 11 * goal[0] + 13 * goal[1]
    found = jax.vmap(task.cost.of_state)(episode.states(task, ran)[1:])
    np.testing.assert_allclose(found, x[1:].sum(1) + rest, rtol=1e-4)
    # On the plant it is the same but for the noise of its sensors, .01 in each of four entries.
    np.testing.assert_allclose(ran.cost, found, atol=0.12)
    assert np.any(ran.cost != found)


def test_imagined_costs_are_those_of_the_imagined_controls(run):
    exp, ran = run
    state = jax.jit(exp.add_episode)(jax.jit(exp.init)(jax.random.key(1)), ran)
    rolled, cost = jax.jit(exp.imagine)(state)
    x, u = np.asarray(rolled.x)[1:, :, :4], np.asarray(rolled.u)[..., 0]
    before = np.concatenate([np.zeros((1, 16)), u[:-1]])
    t, goal = 0.1 * np.arange(1, 26)[:, None], np.asarray(rolled.x)[0, :, -2:]
    rest = 2 * u + 3 * before + 5 * t + 7 * np.sin(t) + 11 * goal[:, 0] + 13 * goal[:, 1]
    np.testing.assert_allclose(cost, x.sum(-1) + rest, rtol=1e-3, atol=1e-3)
    assert np.ptp(goal, 0).min() > 0.1  # each particle has a goal of its own


def test_the_policy_sees_goal_and_reference_in_units_of_their_size(run):
    task = run[0].task
    assert memory.seen_names(task)[4:] == (
        "t [s]",
        *("reference 0", "reference 0 in 0.1 s", "reference 0 in 0.3 s"),
        *("goal 0", "goal 1"),
    )
    m = jnp.array([4.0, 3.0, 0.5, 0.1, -0.2])
    seen = memory.steps(task.memory)[0](m, jnp.zeros(4))[4:]
    np.testing.assert_allclose(seen, [0.5, np.sin(0.5), np.sin(0.6), np.sin(0.8), 0.1, -0.2], rtol=1e-5)
    units = memory.units(task.memory)
    assert units[0] == 2.5
    rms = np.sqrt(np.mean(np.sin(0.1 * np.arange(29)) ** 2))
    np.testing.assert_allclose(units[1:], [rms] * 3 + [0.3 / 3**0.5] * 2, rtol=0.1)
    scale = tasks.input_scale(task, ())
    np.testing.assert_allclose(scale, [1, 1, 1, *(1 / np.array(units)), 1, 1])


def test_goals_of_episodes_differ_and_are_those_of_the_limits():
    config = parse(task="cartpole", cost=lambda x, goal: x[0] - goal[0], goal_low="[1,2]", goal_high="[3,2.5]")
    remembered = tasks.augmented(tasks.of_config(config)).memory
    keys = jax.random.split(jax.random.key(0), 30)
    drawn = np.asarray(jax.vmap(lambda key: memory.begin(remembered, key, jnp.zeros(4)))(keys))
    assert drawn.shape == (30, 2)
    assert drawn.min(0)[0] < 1.3 < 2.7 < drawn.max(0)[0]
    assert np.all((drawn >= [1, 2]) & (drawn <= [3, 2.5]))


def test_what_has_no_terms_is_as_it_was():
    """No memory, and the very functions of before."""
    cost = Cost(lambda x: x[0])
    task = tasks.augmented(cart()._replace(cost=cost))
    assert task.memory.names == ()
    assert task.cost is cost


# Expectations


def test_the_expectation_of_a_cost_of_controls_is_that_of_their_gaussian(x64):
    """A quadratic cost of x and u, whose expectation is known: by 512 nodes, from matched particles."""
    task = terms.augmented(cart()._replace(cost=Cost(lambda x, u, previous_u: (x[0] + u[0] - 2 * previous_u[0]) ** 2)))
    assert task.memory.matched
    spread = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0.5, 0, 1, 0], [-0.3, 0, 0.2, 1]])
    particles = jax.random.normal(jax.random.key(0), (100, 4)) @ spread.T + jnp.array([0.1, 0, 0.2, -0.3])
    weights = np.array([1.0, 0, 1, -2])
    mean, cov = np.mean(particles, 0), np.cov(particles.T)
    found = jax.jit(costs.of_matched(task.cost))(particles[None])
    np.testing.assert_allclose(found, [[(weights @ mean) ** 2 + weights @ cov @ weights]], rtol=1e-6)


def test_a_closed_form_of_the_state_alone_cannot_serve_a_cost_of_controls():
    with pytest.raises(ConfigError, match="leave its expected out"):
        compose(tiny(), cart(), cost=Cost(lambda x, u: x[0], lambda mean, cov: mean[0]))


def test_goals_switch_matching_off_and_a_reference_does_not():
    def task(**words):
        return tasks.augmented(tasks.of_config(parse(task="cartpole", **words)))

    assert not task(cost=lambda x, goal: goal[0], goals=goals).memory.matched
    assert task(cost=lambda x, reference, t: t, reference=sine).memory.matched


# References of files


def test_a_file_is_a_line_between_its_rows_and_holds_its_ends(tmp_path):
    (tmp_path / "named.csv").write_text("t,a,b\n0,1,10\n1,3,10\n2,3,-10\n")
    (tmp_path / "bare.csv").write_text("0,1,10\n1,3,10\n2,3,-10\n\n")
    np.savez(tmp_path / "arrays.npz", t=[0.0, 1, 2], values=[[1.0, 10], [3, 10], [3, -10]])
    (tmp_path / "of a spreadsheet.csv").write_text("0,1,10\n1,3,10\n2,3,-10\n", encoding="utf-8-sig")
    for name in ("named.csv", "bare.csv", "arrays.npz", "of a spreadsheet.csv"):
        value = signals.reference_of(str(tmp_path / name))
        for t, expected in ((-1, [1, 10]), (0.25, [1.5, 10]), (1.5, [3, 0]), (9, [3, -10])):
            np.testing.assert_allclose(value(jnp.asarray(float(t))), expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("back.csv", "0,1\n2,1\n1,1\n", r"times \[s\] must increase, and 1 follows 2"),
        ("alone.csv", "t\n0\n1\n", r"no values beside the times \[s\]"),
        ("empty.csv", "t,a\n", "no values"),
        ("words.csv", "t,a\n0,1\n1,up\n", "cannot be read as times and values: could not convert string to float"),
        (
            "slip.csv",
            "O.5,5\n1,3\n2,3\n",
            "cannot be read as times and values: could not convert string to float: 'O.5'",
        ),
        ("nan.csv", "0,1\n1,nan\n", "has nan in row 2"),
        ("ragged.csv", "0,1\n1,1,2\n", "cannot be read as times and values"),
    ],
)
def test_a_file_that_is_no_reference_is_one_line(tmp_path, name, text, said):
    (tmp_path / name).write_text(text)
    with pytest.raises(ConfigError, match=said) as caught:
        signals.reference_of(str(tmp_path / name))
    assert "\n" not in str(caught.value)


# Starts


def test_starts_are_drawn_equally_likely_with_the_spread_of_the_task():
    task, keys = (
        tasks.of_config(parse(task="cartpole", starts="[[0,0,0,0],[1,0,0,3.14]]")),
        lambda: jax.random.split(jax.random.key(0), 400),
    )
    on_plant = np.asarray(jax.vmap(lambda key: task.plant.observe(task.plant.reset(key)))(keys()))
    np.testing.assert_array_equal(on_plant, jax.vmap(partial(starts.start, task=task))(keys()))
    upright = on_plant[:, 3] > 1.57
    assert 0.4 < upright.mean() < 0.6
    np.testing.assert_allclose(on_plant[upright].mean(0), [1, 0, 0, 3.14], atol=0.05)
    np.testing.assert_allclose(on_plant[upright].std(0), [0.2] * 4, atol=0.05)
    np.testing.assert_allclose(task.start_mean, [0.5, 0, 0, 1.57], atol=1e-6)
    np.testing.assert_allclose(task.start_std, np.hypot([0.5, 0, 0, 1.57], 0.2), rtol=1e-6)


def test_a_goal_is_drawn_apart_from_the_start():
    """On the plant as in imagination, where one of a few starts is drawn with a spread around it."""
    config = parse(task="cartpole", starts="[[0,0,0,0]]", goal_low="[-1]", goal_high="[1]")
    task = build(replace(config, cost=lambda x, goal: jnp.abs(x[0] - goal[0]))).task  # type: ignore[arg-type]

    def drawn(key):
        x = starts.start(key, task=task)
        return jnp.concatenate([x, memory.begin(task.memory, key, x)])

    found = np.corrcoef(jax.vmap(drawn)(jax.random.split(jax.random.key(0), 500)).T)[-1, :-1]
    assert np.abs(found).max() < 0.15


# What is checked, and what a folder keeps


def test_a_check_says_what_sensors_goals_and_a_constraint_make_of_a_task():
    words = dict(task="cartpole", goal_low="[-1]", goal_high="[0.5]")
    config = replace(parse(**words), cost=lambda x, goal: jnp.abs(x[0] - goal[0]), constraint=lambda x: x[0] - 3)
    said = check.understood(config, build(config).task)
    assert said["policy sees"].endswith(", goal 0")
    assert said["goals"] == "from [-1] to [0.5]"
    assert "broken by at most 0.05 of the episodes" in said["constraint"]
    late = parse(**LATE)
    assert "measured rate of" in check.understood(late, build(late).task)["policy sees"]
    assert check.understood(parse(task="cartpole"), tasks.make("cartpole")) == {}


def test_a_note_on_a_large_cost_is_of_controls_within_their_limits_and_short():
    """Of two periods late, of which the check knows that they are controls too."""
    config = replace(parse(**LATE), cost=lambda x: 2 - jnp.exp(-(x[0] ** 2)))
    task = build(config).task
    _, _, low, high = terms.box(task)
    late = [i for i, name in enumerate(task.memory.names) if name.startswith("force")]
    assert len(late) >= 4
    assert (low[late] == -10).all()
    assert (high[late] == 10).all()
    (note,) = (line for line in before_training(config, task) if "more than 1" in line)
    assert len(note) < 400


def test_a_cost_is_checked_with_all_that_it_takes():
    def checked(cost):
        config = parse(task="cartpole", cost=cost, **SMALL)
        return before_training(config, build(config).task)

    assert checked(lambda x, u: 1 - jnp.exp(-(x[0] ** 2) - u[0] ** 2 / 100)) == []
    with pytest.raises(ConfigError, match=r"negative, at x=\[.*\], force \[N\] 1 before=.*is it a reward"):
        checked(lambda x, u: -(u[0] ** 2))
    with pytest.raises(ConfigError, match=r"has a gradient that is nan at x=\[.*2 before="):
        checked(lambda x, u, previous_u: jnp.linalg.norm(u - previous_u) + jnp.linalg.norm(x - x))
    with pytest.raises(ConfigError, match=r"reads entry 1 of an array of 1"):
        checked(lambda x, u: 1 - jnp.exp(-(u[1] ** 2)))
    with pytest.raises(ConfigError, match=r"more than 1|TypeError"):
        checked(lambda x, u: len(3))


def test_a_folder_keeps_the_terms_the_reference_and_the_size_of_goals(run):
    task = run[0].task
    kept = facts.of_task(task)
    assert kept["terms"] == list(terms.TERMS)
    read = facts.to_task(kept, "run.json")
    assert facts.difference(kept, facts.of_task(tasks.augmented(read)), pairs=True) is None
    restored = tasks.augmented(read)
    assert restored.memory.names == task.memory.names
    assert restored.memory.shown == task.memory.shown
    np.testing.assert_allclose(restored.memory.shown_units, task.memory.shown_units, rtol=1e-5)
    np.testing.assert_allclose(restored.reference.value(0.35), (np.sin(0.3) + np.sin(0.4)) / 2, rtol=1e-5)
    assert [*signature(read.cost.of_state).parameters] == ["x", *terms.TERMS]


@pytest.mark.slow
def test_the_controller_is_given_goals_and_references(tmp_path):
    """Beside the policy itself, which is given by hand what the controller remembers."""
    words = dict(cost=price, reference=sine, goals=goals, **SMALL)
    task = tasks.augmented(tasks.of_config(parse(task="cartpole", **words)))
    plain = {name.replace(".", "__"): value for name, value in SMALL.items() if name not in ("model", "trials")}
    run = a_run(tmp_path / "run", made=task, **plain)
    control = controller(run, trial="last")
    _, experiment, state = restored(tmp_path / "run")
    x = np.array([0.1, -0.2, 0.3, 3.0])
    with pytest.raises(ValueError, match="set goal, 2 numbers, before it is called"):
        control(x)
    with pytest.raises(ValueError, match="a goal is 2 finite numbers"):
        control.goal = [1.0]

    def seen(t, reference):
        return jnp.array([*x, t, *(reference(t + ahead) for ahead in (0, 0.1, 0.3)), 0.2, -0.1])

    def by_hand(t, reference):
        return experiment.policy.apply(state.policy.params, None, seen(t, reference))

    control.goal = [0.2, -0.1]
    for reference in (sine, lambda t: 0.3 + 0 * t):
        control.reset()
        for period in range(3):
            np.testing.assert_allclose(control(x), by_hand(0.1 * period, reference), rtol=1e-4)
        control.reference = 0.3
    for format in ("numpy", "onnx", "stablehlo"):  # a file that is asked, and remembers nothing
        made = FORMATS[format]
        rows = np.stack([seen(t, sine) for t in (0.0, 0.2)])
        found = made.run(export(run, "last", format, tmp_path / f"asked{made.suffix}"), rows, len(rows))
        np.testing.assert_allclose(found, [by_hand(t, sine) for t in (0.0, 0.2)], rtol=1e-4)
    control.reference = [0.3, 0.4]
    with pytest.raises(ValueError, match="a reference is 1 finite numbers"):
        control(x)


def hold(x, u, previous_u, goal):
    """Gymnasium's pendulum at an angle."""
    away = 1 - x[0] * jnp.cos(goal[0]) - x[1] * jnp.sin(goal[0])
    return 1 - jnp.exp(-away / 0.1) + 0.01 * u[0] ** 2 + 0.02 * (u[0] - previous_u[0]) ** 2


@pytest.mark.campaign
def test_a_robot_with_goals_from_the_first_episode_to_the_file_that_drives_it(tmp_path):
    """What is stored can be counted again by hand, and the file is the controller that was asked for the goal."""
    small = SMALL | {"eval_episodes": "0", "horizon": "6", "env": "Pendulum-v1", "circles": "[[0,1]]"}
    small |= {"goal_low": "[-0.3]", "goal_high": "[0.3]", "search.visited_starts": "0", "control_rate": "20"}
    small |= {"state_names": "[cosine,sine,rate]"}
    run = train("gym", out=tmp_path / "run", settings=small, cost=hold)
    drawn = []
    for trial in (1, 2):
        found = np.load(run / "episodes" / f"{trial:04d}.npz")
        seen, u, goal = found["observation"], found["u"], found["memory"][-1]
        before = np.concatenate([np.zeros((1, 1), np.float32), u[:-1]])
        drawn.append(goal)
        expected = [hold(*row, np.array([goal])) for row in zip(seen[1:], u, before, strict=True)]
        np.testing.assert_allclose(found["cost"], expected, rtol=1e-4)
    assert drawn[0] != drawn[1]
    assert np.all(np.abs(drawn) <= 0.3)
    control, x = controller(run), np.array([0.6, 0.8, 0.1], np.float32)
    file = runpy.run_path(str(export(run, out=tmp_path / "hold.py")))["Controller"]()
    for goal in (-0.2, 0.1):
        control.goal = goal
        np.testing.assert_allclose(file([*x, goal]), control(x), rtol=1e-4)
    kept = json.loads((tmp_path / "hold.py.json").read_text())
    assert [entry["name"] for entry in kept["observation"]] == ["cosine", "sine", "rate", "goal 0"]
    assert kept["observation"][-1] == {"name": "goal 0", "unit": None, "is": "asked for, no sensor's"}
    assert (kept["filter"], kept["history"]["controls"], kept["control"][0]["rate_per_s"]) == ("none", 1, 20)
    (done,) = drives(run)
    driven = np.load(done.log)
    control.reset()
    control.goal = driven["memory"][-1:]
    np.testing.assert_allclose(driven["u"], [control(row) for row in driven["observation"][:-1]], atol=1e-4)
    assert np.abs(np.diff(driven["u"], axis=0, prepend=0)).max() <= 1 + 1e-6  # 20 a second, of .05 s
    assert driven["cost"].shape == (6,)
    assert abs(driven["memory"][-1]) <= 0.3
    before = np.concatenate([np.zeros((1, 1), np.float32), driven["u"][:-1]])
    rows = zip(driven["observation"][1:], driven["u"], before, strict=True)
    np.testing.assert_allclose(driven["cost"], [hold(*row, driven["memory"][-1:]) for row in rows], rtol=1e-4)
