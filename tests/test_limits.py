"""Constraints in imagination and on the plant, and first episodes that are gentle or somebody's."""

from __future__ import annotations

import shutil
import sys
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pegasus_jax import controller, episode, train
from pegasus_jax.assembly.experiments import compose, explore_of
from pegasus_jax.checks import ConfigError
from pegasus_jax.config import Explore
from pegasus_jax.imagine import limits
from pegasus_jax.imagine.limits import Constraint
from pegasus_jax.imagine.scenarios import Sampler
from pegasus_jax.learn.schedule import search_table
from pegasus_jax.learn.search import Problem, searcher
from pegasus_jax.runs import config_io, first, store
from pegasus_jax.runs.best import best_trial
from pegasus_jax.runs.check import before_training
from pegasus_jax.runs.display import limits as told
from pegasus_jax.runs.display import limits_line
from pegasus_jax.types import Prediction, TrainState
from pegasus_jax.vectorized import for_particles
from probes import cart, network, same, tiny, unchecked

RAIL = Constraint(lambda x: jnp.array([x[0] - 1, -1 - x[0]]), 0.1)


def path(*positions: float) -> np.ndarray:
    """One trajectory [H+1, 1, 2] through these positions."""
    return np.array(positions, np.float32)[:, None, None] * np.array([1.0, 0.0], np.float32)


# In imagination


def test_the_probability_is_the_share_of_trajectories_that_leave_the_limits():
    """Once or often, on either side, or to infinity; one that begins outside says nothing of its policy."""
    paths = [path(0, 0.9, 0), path(0, 1.1, 0), path(0, -1.1, -2), path(1.2, 1.3, 0), path(0, 1.0, 0)]
    assert limits.probability(jnp.concatenate(paths, 1), RAIL) == pytest.approx(2 / 4)
    assert limits.probability(jnp.concatenate([*paths, path(0, 0.5, np.nan)], 1), RAIL) == pytest.approx(3 / 5)
    assert limits.probability(path(1.2, 0, 0), RAIL) == 0


@given(st.lists(st.tuples(st.floats(0, 1), st.sampled_from([0.0, 0.05, 0.1, 0.3, 0.9])), min_size=2, max_size=5))
def test_the_first_of_several_is_the_one_that_wins_over_each_other(several: list[tuple[float, float]]) -> None:
    cost, chance = np.array(several, np.float32).T
    first = int(np.argmin(limits.ranked(jnp.asarray(cost), jnp.asarray(chance), bound=0.1)))
    for other in range(len(several)):
        cheaper = jnp.asarray(cost[first] <= cost[other])
        assert limits.prefers(cheaper, jnp.asarray(chance[first]), jnp.asarray(chance[other]), bound=0.1)


def test_a_constraint_of_one_number_is_that_of_a_vector_of_one():
    alone, paths = RAIL._replace(of_state=lambda x: jnp.abs(x[0]) - 1), path(0, 0.9, 1.3)
    for function in (limits.probability, limits.penalty):
        assert function(paths, alone) == function(paths, alone._replace(of_state=lambda x: jnp.abs(x[:1]) - 1))


def test_the_penalty_is_flat_within_and_has_a_gradient_everywhere_beyond():
    cost = jax.vmap(jax.value_and_grad(lambda position: limits.penalty(jnp.array([[[position, 0.0]]]), RAIL)))
    value, slope = (np.asarray(part) for part in cost(jnp.array([0.0, 0.5, 1.0, 1.5, 5.0, 100.0])))
    by_hand = np.log1p(np.log1p(np.exp((np.array([0.5, 1.0, 1.5]) - 1) / 0.05)))
    np.testing.assert_allclose(value[1:4], by_hand, rtol=1e-4)
    assert value[0] < 1e-6
    assert np.all(np.diff(value) > 0)
    assert slope[0] < 1e-5
    assert slope[2] > slope[3] > slope[4] > slope[5] > 1e-3


@given(old=st.floats(0, 100), chance=st.floats(0, 1), bound=st.floats(0.01, 0.99))
def test_the_multiplier_rises_beyond_the_bound_and_falls_within_it(old, chance, bound):
    new = float(limits.ascend(jnp.asarray(old), jnp.asarray(chance), bound=bound))
    assert 0 <= new <= limits.MOST
    assert (new >= old - 1e-5) if chance >= bound else (new <= old + 1e-5)


@pytest.mark.parametrize(
    ("cheaper", "chance", "other", "wins"),
    [
        (True, 0.2, 0.05, False),  # it breaks the bound, the other does not
        (False, 0.05, 0.2, True),
        (True, 0.05, 0.01, True),  # both are within
        (False, 0.0, 0.1, False),
        (False, 0.2, 0.3, True),  # both are beyond
        (True, 0.3, 0.2, False),
        (True, 0.3, 0.3, True),
    ],
)
def test_a_policy_beyond_the_bound_wins_over_none_within_it(cheaper, chance, other, wins):
    assert bool(limits.prefers(jnp.asarray(cheaper), jnp.asarray(chance), jnp.asarray(other), bound=0.1)) == wins


def on_a_line(steps):
    """A search for p near 2 where p may not be above 1, and its learner."""

    def value(p, posterior, target, row, multiplier):
        return (p - 2) ** 2 + multiplier * jnp.log1p(jax.nn.softplus((p - 1) / 0.05)), jnp.asarray(p > 1, float)

    still = Sampler(lambda *_: jnp.zeros(()), lambda *_: jnp.zeros(()))
    ascend = partial(limits.ascend, bound=0.05)
    found = searcher(Problem(value, still, optax.sgd(0.01), search_table(steps), ascend=ascend))
    return found, TrainState(jnp.asarray(0.0), found.init(jnp.asarray(0.0)))


def test_a_search_ends_at_the_limit_and_may_stop_and_go_on():
    """Where one without a constraint goes to 2. The multiplier is in the state, so two calls are one to the bit."""
    found, learner = on_a_line(300)
    run = jax.jit(partial(found.run, steps=150))
    half, _ = run(jax.random.key(0), learner, None, first=0)
    twice, _ = run(jax.random.key(0), half, None, first=150)
    once, _ = jax.jit(partial(found.run, steps=300))(jax.random.key(0), learner, None)
    assert same(once, twice)
    assert 0.8 < float(once.params) < 1.05
    assert float(half.optimizer.multiplier) != limits.FIRST


def test_a_search_without_a_constraint_has_no_multiplier():
    """So a stored run has the same arrays as before."""
    exp = compose(tiny(), cart())
    kept, limited = (
        jax.eval_shape(e.init, jax.random.key(0)).policy.optimizer.multiplier
        for e in (exp, compose(tiny(), cart()._replace(constraint=RAIL)))
    )
    assert kept is None
    assert limited.shape == ()


def test_a_particle_stays_where_it_is_over():
    """Grossly beyond the limit, or stopped; the others move as the model says, one by one or all at once."""
    drift = network()._replace(apply=lambda posterior, draw, x, u: Prediction(jnp.ones(2), jnp.ones(2)))
    x, none = jnp.array([[0.0, 1.0], [1.5, 1.0], [2.5, 1.0], [-2.5, 1.0], [0.0, 4.0]]), jnp.zeros((5, 1))
    for constraint, stop, moves in (
        (RAIL, None, [1, 1, 0, 0, 1]),
        (None, lambda x: x[1] > 3, [1, 1, 1, 1, 0]),
        (RAIL, lambda x: x[1] > 3, [1, 1, 0, 0, 0]),
        (None, None, [1, 1, 1, 1, 1]),
    ):
        apply, expected = limits.absorbing(drift, constraint, stop).apply, np.outer(moves, [1, 1])
        np.testing.assert_array_equal(for_particles(apply)(None, none, x, none).mean, expected)
        np.testing.assert_array_equal([apply(None, none[0], row, none[0]).mean for row in x], expected)


SLOW = Constraint(lambda x: jnp.array([jnp.abs(x[1]) / 0.5 - 1]))  # at most 0.5 m/s


def learned(constraint, trials=3):
    """The cart's speeds in episodes of the policy that is learned, and what was expected of it."""
    exp = compose(tiny(search__steps=150), cart(horizon=10)._replace(constraint=constraint))
    state, improve = jax.jit(exp.init)(jax.random.key(3)), jax.jit(exp.improve)
    for _ in range(trials):
        state = exp.add_episode(state, jax.jit(exp.collect)(state))
        before = state.policy.params
        state, _ = improve(state)
    _, successor = jax.jit(exp.succeed)(state, before)
    fly = unchecked(jax.jit(jax.vmap(exp.episode, (0, None, None))))
    flights = fly(jax.random.split(jax.random.key(9), 100), state.policy.params, False)
    return np.abs(flights.x[:, :, 1]).max(1), successor.chance, float(jnp.mean(flights.cost[:, -3:]))


@pytest.mark.slow
def test_what_is_learned_keeps_to_the_limit_on_the_plant():
    """And still comes to the goal; without the constraint the same search is faster than that."""
    free, none, _ = learned(None)
    speeds, chance, cost = learned(SLOW)
    assert none is None
    assert np.mean(free > 0.5) > 0.9
    assert np.mean(speeds > 0.55) <= 0.1
    assert chance <= 0.2
    assert cost < 0.3


# Bad input

USERS = """
import jax.numpy as jnp
rail = lambda x: jnp.abs(x[0]) - 1.0
both = lambda x: jnp.array([x[0] - 1, -1 - x[0]])
never = lambda x: -1 - x[0] ** 2
always = lambda x: 1.0 - jnp.abs(x[0])
matrix = lambda x: -jnp.ones((2, 2)) - x[0]
log = lambda x: jnp.log(x[0])
steps = lambda x: jnp.where(jnp.abs(x[0]) > 1, 1.0, -1.0)
whether = lambda x: jnp.abs(x[0]) > 1
root = lambda x: jnp.sqrt(jnp.sum(x * x)) - 20
words = lambda x: "far"
push = lambda x: jnp.array([-x[0] - x[1]])
three = lambda x: jnp.ones(3)
numpys = lambda x: [float(-x[0])]
degrees = lambda x: jnp.abs(x[3]) - 200.0
nothing = lambda x: jnp.array([jnp.nan])
"""


@pytest.fixture
def users(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "limited_by.py").write_text(USERS)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "limited_by", raising=False)
    return "limited_by"


def looked_at(**words: str) -> list[str]:
    from pegasus_jax import tasks

    config = config_io.parse({"task": "cartpole", **{name.replace("__", "."): text for name, text in words.items()}})
    return before_training(config, tasks.of_config(first.loaded(config)))


@pytest.mark.parametrize(
    ("function", "says"),
    [
        ("always", "is 1 where episodes start, not negative: every episode would break it"),
        ("matrix", r"returns an array of shape \(2, 2\); expected a number, or a vector"),
        ("log", "is not finite where episodes start"),
        ("steps", "has a gradient of 0 at each of"),
        ("whether", "returns values of type bool"),
        ("root", "has a gradient of nan at x="),
        ("words", "TypeError"),
        ("nosuch", "has no nosuch"),
        ("numpys", r"is not a JAX function: .* of x at limited_by.py:\d+; use jax.numpy"),
    ],
)
def test_a_constraint_that_cannot_be_kept_is_one_line(function: str, says: str, users: str) -> None:
    with pytest.raises(ConfigError, match=says) as refused:
        looked_at(constraint=f"{users}:{function}")
    assert str(refused.value).startswith(f"constraint={users}:{function}")
    assert "\n" not in str(refused.value)


def test_a_constraint_is_looked_at_without_complaint_or_with_a_note(users: str) -> None:
    assert looked_at(constraint=f"{users}:rail") == looked_at(constraint=f"{users}:both") == []
    for function in ("never", "degrees"):  # the angle is one: 200 rad are too many turns
        (note,) = looked_at(constraint=f"{users}:{function}")
        assert "is positive at none of" in note
        assert "Angles are in radians" in note


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ({"constraint_bound": "1"}, r"constraint_bound=1 is out of range; expected a number in \(0, 1\)"),
        ({"constraint_bound": "0"}, "constraint_bound=0 is out of range"),
        ({"explore__amplitude": "1.5"}, "explore.amplitude=1.5 is out of range; .* the nearest is 1"),
        ({"explore__amplitude": "0"}, "explore.amplitude=0 is out of range"),
        ({"explore__policy": "limited_by:three"}, r"returns an array of shape \(3,\); expected \(1,\)"),
        ({"explore__policy": "limited_by:nothing"}, r"is \[nan\] at the start"),
        ({"explore__policy": "limited_by:numpys"}, "is not a JAX function"),
        ({"explore__policy": "runs/none"}, "neither a run's folder nor a function"),
    ],
)
def test_bad_input_is_one_clear_line(words: dict[str, str], says: str, users: str) -> None:
    with pytest.raises(ConfigError, match=says) as refused:
        looked_at(**words)
    assert "\n" not in str(refused.value)


def test_the_search_of_a_gaussian_refuses_a_constraint(users: str) -> None:
    from pegasus_jax.assembly.experiments import build

    with pytest.raises(ConfigError, match=r"has no trajectories; leave out constraint="):
        build(config_io.parse({"task": "cartpole", "algorithm": "pilco", "model": "gp", "policy": "rbf",
                               "constraint": f"{users}:rail"}))  # fmt: skip


# The first episodes


@pytest.mark.parametrize(("low", "high"), [(-2.0, 2.0), (0.0, 1.0), (1.0, 3.0)])
def test_gentle_controls_begin_small_and_stay_within_their_part_of_the_range(low, high):
    low, high = jnp.array([low]), jnp.array([high])
    plans = jax.vmap(lambda key: episode.gently(episode.uniform(key, low, high, 50), 0.4, low, high))
    u = np.asarray(plans(jax.random.split(jax.random.key(0), 200)))[..., 0]
    rest = float(jnp.clip(0.0, low, high)[0])
    far = max(float(high[0]) - rest, rest - float(low[0]))
    reach = np.abs(u - rest).max(0) / far
    assert np.all(reach <= 0.4 * np.linspace(0.2, 1, 50) + 1e-6)
    assert reach[0] > 0.07
    assert reach[-1] > 0.35


def test_nothing_said_of_amplitude_leaves_the_controls_as_they_are():
    task = cart()
    low, high = jnp.asarray(task.control_low, float), jnp.asarray(task.control_high, float)
    plan = explore_of(Explore(), task)(jax.random.key(1))
    assert same(plan, episode.uniform(jax.random.key(1), low, high, task.horizon))


@pytest.mark.parametrize("amplitude", [None, 0.1])
def test_the_first_episodes_are_of_the_users_controller_and_the_others_are_not(amplitude):
    """Within the limits; with an amplitude, and what is random on top."""
    task = cart()._replace(guide=lambda x: jnp.array([-5.0]) * x[0], sensor_std=np.zeros(2))
    exp = compose(tiny(explore__amplitude=amplitude), task)
    params = exp.policy.init(jax.random.key(0))
    explored, followed = (jax.jit(exp.episode)(jax.random.key(2), params, which) for which in (True, False))
    own = np.clip(-5 * np.asarray(explored.x[:-1, 0]), -2, 2)
    added = np.asarray(explored.u[:, 0]) - own
    if amplitude is None:
        np.testing.assert_allclose(added, 0, atol=1e-6)
    else:
        assert 0.01 < np.abs(added).max() <= 0.2 + 1e-6
    assert np.abs(np.asarray(followed.u[:, 0]) - np.clip(-5 * np.asarray(followed.x[:-1, 0]), -2, 2)).max() > 0.5


# What is said


def test_a_trials_line_and_a_runs_last_one():
    rows = [
        {"constraint_broken": False, "constraint_rows": 0.0, "constraint_expected": None, "ended": "horizon"},
        {"constraint_broken": True, "constraint_rows": 0.12, "constraint_expected": 0.03, "ended": "terminated"},
        {"constraint_broken": True, "constraint_rows": 0.01, "constraint_expected": 0.0, "ended": "horizon"},
    ]
    assert told(rows[:1]) == "constraint broken at 0% of the rows"
    assert told(rows[1:2]) == "constraint broken at 12% of the rows, expected in 3% of the next policy's episodes"
    assert told([{}]) == limits_line([{"ended": "horizon"}]) == ""
    assert limits_line(rows) == "constraint broken in 2 of 3 episodes; 1 of these ended early"


def test_of_two_that_succeed_the_best_is_the_one_that_keeps_to_the_constraint():
    row: dict[str, Any] = {"mean_cost": None, "success_rate": None, "ended": "horizon", "episode_success": True}
    rows = [
        row | {"trial": 1, "policy": 0, "episode_cost": 0.9},
        row | {"trial": 2, "policy": 1, "episode_cost": 0.3, "constraint_broken": False},
        row | {"trial": 3, "policy": 2, "episode_cost": 0.2, "constraint_broken": True},
    ]
    assert best_trial(rows) == 1


# As a user does it

ROBOT = """
import gymnasium, numpy as np, jax.numpy as jnp

class Cart(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
    dt = 0.1
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.normal([0, 0], 0.01)
        return self.x.astype(np.float32), {}
    def step(self, control):
        self.x = self.x + 0.1 * np.array([self.x[1], 4 * float(control[0])])
        return self.x.astype(np.float32), 0.0, bool(abs(self.x[0]) > 1), False, {}

gymnasium.register("Cart-v0", Cart)

def cost(x): return 1 - jnp.exp(-((x[0] - 0.3) ** 2 + 0.1 * x[1] ** 2) / 0.1)
def rail(x): return jnp.abs(x[0]) - 0.5
def end(x): return jnp.abs(x[0]) > 1
def push(x): return [0.5]
"""
TINY = {
    "model.hidden": [8],
    "policy.hidden": [8],
    "search.steps": 6,
    "fit.steps": 20,
    "search.particles": 8,
    "horizon": 12,
}


@pytest.mark.campaign
def test_a_robot_with_a_constraint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Its user's controller begins, breaks the constraint and is stopped. A cut run goes on; another begins with it."""
    (tmp_path / "limited_cart.py").write_text(ROBOT)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    names = {"env": "limited_cart:Cart-v0", "cost": "limited_cart:cost", "stop": "limited_cart:end"}
    words = {**names, "constraint": "limited_cart:rail", "start_mean": [0, 0], "eval_episodes": 0, **TINY}
    train("gym", settings={**words, "explore.policy": "limited_cart:push", "trials": 3}, out="one")
    said, rows = capfd.readouterr().out, store.trials(tmp_path / "one")
    assert (rows[0]["constraint_broken"], rows[0]["ended"]) == (True, "terminated")
    assert 0 < rows[0]["constraint_rows"] < 1
    assert all(0 <= row["constraint_expected"] <= 1 for row in rows)
    assert limits_line(rows) in said
    assert "in 1 of 3 episodes; 1 of these ended early" in limits_line(rows)
    assert np.load(tmp_path / "one" / "episodes" / "0001.npz")["u"] == pytest.approx(0.5)

    shutil.copytree("one", "cut")
    store.write_trials(tmp_path / "cut", rows[:2])
    for trial in Path("cut", "checkpoints").glob("0003*"):
        shutil.rmtree(trial) if trial.is_dir() else trial.unlink()
    train(resume="cut")
    again = store.trials(tmp_path / "cut")[2]
    assert again | {"seconds": 0} == rows[2] | {"seconds": 0}

    train("gym", settings={**words, "explore.policy": "one", "explore.trials": 2, "trials": 1}, out="next")
    assert config_io.load(tmp_path / "next" / "config.yaml").explore.policy == str(tmp_path / "one")
    found = store.load_episode(tmp_path / "next", 1)
    assert found is not None
    best = controller("one")
    expected = [best(x) for x in np.asarray(found.trajectory.x)[:-1]]
    np.testing.assert_allclose(found.trajectory.u, expected, atol=1e-5)
