"""Imagined rollouts that start where the plant has been."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pegasus_jax.assembly.experiments import compose
from pegasus_jax.imagine import visited
from pegasus_jax.imagine.rollout import limited
from pegasus_jax.imagine.visited import STATES, Starts, Visited, beside_visited, longest, remember, remembering, started
from pegasus_jax.models.ensemble import ensemble
from pegasus_jax.types import Dataset, RunState, Scenarios, TrainState
from pegasus_jax.vectorized import for_particles
from probes import cart, experience, network, regression, same, tiny, unchecked

K, D = 2000, 3
ALL = np.ones(D, bool)  # entries that differ between starts


def rows(size, capacity=700):
    """A data set whose row i is at i, beyond `size` at infinity."""
    x = jnp.where(jnp.arange(capacity) < size, jnp.arange(capacity, dtype=jnp.float32), jnp.inf)[:, None] * jnp.ones(D)
    return Dataset(x, x[:, :1], x, jnp.int32(size))


def run_state(data, succeeded=True):
    nothing = TrainState(None, None)
    return RunState(
        jax.random.key(0),
        data,
        nothing,
        nothing,
        jnp.int32(1),
        jnp.int32(1),
        jnp.bool_(succeeded),
        nothing.params,
        jnp.int32(0),
    )


def remembered(data, succeeded=True, angles=(), varies=ALL):
    return remember(None, run_state(data, succeeded), angles=angles, varies=varies)


def drawn(share, states, angles=(), around=0.0, succeeded=True):
    start = beside_visited(lambda key, given: jnp.full((K, D), -5.0), share, angles, jnp.full(D, around))
    found = start(jax.random.key(0), Visited(None, states, jnp.ones(D), jnp.bool_(succeeded), jnp.bool_(False)))
    assert np.array_equal(found.own, np.full((K, D), -5.0))
    return np.asarray(found.mixed)


def test_the_rows_of_millions_are_in_use_too():
    """A row's place times their number has no 32 bits."""
    size = 4_300_000
    data = Dataset(jnp.arange(size, dtype=jnp.float32)[:, None], jnp.zeros((1, 1)), jnp.zeros((1, 1)), jnp.int32(size))
    kept = np.asarray(remember(None, run_state(data), angles=(), varies=np.ones(1, bool)).states)[:, 0]
    np.testing.assert_array_equal(kept, np.arange(STATES) * size // STATES)


@pytest.mark.parametrize("size", [1, 7, STATES, 600])
def test_the_states_are_the_rows_in_use_evenly(size):
    kept = np.asarray(remembered(rows(size)).states)
    assert kept.shape == (STATES, D)
    places, counts = np.unique(kept[:, 0], return_counts=True)
    assert len(places) == min(size, STATES)
    assert set(places) <= set(range(size))
    assert counts.max() - counts.min() <= 1
    assert places[0] == 0
    assert places[-1] >= size - 1 - size // STATES


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_so_large_a_share_starts_there(share):
    """Four standard deviations of a binomial, and all states alike."""
    x = drawn(share, jnp.arange(STATES, dtype=jnp.float32)[:, None] * jnp.ones(D))
    there = x[:, 0] >= 0
    assert abs(there.mean() - share) <= 4 * np.sqrt(share * (1 - share) / K)
    assert np.array_equal(x[~there], np.full((int((~there).sum()), D), -5.0))
    assert np.array_equal(x[there][:, 0], x[there][:, 2])  # whole states
    if share == 1:
        assert len(np.unique(x[:, 0])) > 0.9 * (1 - np.exp(-K / STATES)) * STATES


def test_before_a_success_nothing_starts_there():
    assert np.array_equal(drawn(1.0, jnp.zeros((STATES, D)), succeeded=False), np.full((K, D), -5.0))
    assert not bool(remembered(rows(3), succeeded=False).succeeded)


def walked(scale, turns=0.0):
    """The spread of 600 rows of a plant whose states are counted in other units, and whose second entry is an angle."""
    x = np.random.default_rng(0).normal(size=(600, D)) * [1.0, 0.3, 0.0] + [0, 3.0, 5.0]
    x[:, 1] += turns * np.arange(600)
    data = rows(600, 600)._replace(x=jnp.asarray(x * [scale, 1.0, 1.0], jnp.float32))
    return remembered(data, angles=(1,))


def test_the_spread_is_that_of_the_states_whatever_turns_an_angle_has_made():
    np.testing.assert_allclose(walked(1.0).spread, [1.0, 0.3, 0.0], rtol=0.1, atol=1e-6)
    np.testing.assert_allclose(walked(1.0, turns=2 * np.pi).spread, walked(1.0).spread, rtol=1e-2, atol=1e-4)


@pytest.mark.parametrize("steepest", [8.0, 12.0])
def test_what_is_dropped_does_not_depend_on_the_unit_of_a_state(steepest):
    """A cost of K particles that falls by `steepest` where one moves by the spread, in m and in mm; 10 is the most."""

    def gradient(scale):
        given = walked(scale)
        x = jnp.zeros((K, D))
        slope = jnp.array([steepest / given.spread[0], 0.0, 1e6])  # the last entry never changes
        return np.asarray(jax.grad(lambda x: jnp.mean(limited(x, longest(given, K)) @ slope))(x))[:, 0]

    metres, millimetres = gradient(1.0), gradient(1000.0)
    assert np.all((metres != 0) == (steepest < 10))
    np.testing.assert_allclose(metres, 1000 * millimetres, rtol=1e-4)


def test_a_search_on_a_plant_of_ones_own_drops_what_is_too_steep(monkeypatch):
    """A cost that is a thousand times as high at the start as it should be loses nothing for that."""

    def norm(steepest, factor=1.0):
        monkeypatch.setattr(visited, "STEEPEST", steepest)
        task = cart()
        experiment = compose(
            tiny(
                search__visited_starts=0.5, search__refine_fraction=0.5, search__steps=4, search__cost_width_start=1.0
            ),
            task,
            dynamics=regression(2, 1),
            cost=lambda x: factor * (1 + task.cost.of_state(x)),
        )

        @jax.jit
        def searched(key):
            state = experiment.init(key)
            return experiment.search(experiment.add_episode(state, experiment.collect(state)))[1]

        return float(searched(jax.random.key(0)).gradient_norm[0])

    usual = norm(10.0)
    assert norm(1e-3) < 0.9 * usual
    assert norm(10.0, 1000.0) == pytest.approx(1000 * usual, rel=1e-3)


@pytest.mark.parametrize(
    ("still", "varies", "size", "goal"),
    [((2,), (0, 2), 5, True), ((2,), (0, 1), 5, False), ((), (0, 1, 2), 5, False), ((0, 1, 2), (0,), 0, False)],
)
def test_what_never_changes_in_an_episode_and_differs_between_them_is_a_goal(still, varies, size, goal):
    """Rows that are not in use are no evidence; nor are entries that are the same in all episodes."""
    y = np.zeros((9, D), np.float32)
    y[:size] = 0.5 * ~np.isin(np.arange(D), still)
    data = rows(size, 9)._replace(y=jnp.asarray(y))
    assert bool(remembered(data, varies=np.isin(np.arange(D), varies)).goal) == goal


def test_particles_with_a_goal_are_not_matched():
    """From its first step on their search minimizes what one does that keeps every particle and its cost apart."""

    def first(goal, **search):
        settings = dict(visited_starts=0.5, refine_fraction=0.5, cost_width_start=1.0) | search
        config = tiny(**{f"search__{name}": value for name, value in settings.items()}, search__steps=4)
        experiment = compose(config, cart(), dynamics=regression(2, 1))

        @jax.jit
        def searched(key, goal):
            state = experiment.init(key)
            state = experiment.add_episode(state, experiment.collect(state))
            y = jnp.where(goal, state.data.y.at[:, 0].set(0.0), state.data.y)
            state = state._replace(data=state.data._replace(y=y))
            return experiment.search(state)[1]

        return float(unchecked(searched)(jax.random.key(0), goal).objective[0])

    apart = dict(matching="never", cost_estimator="particles")
    assert first(goal=True, matching="always") == pytest.approx(first(goal=True, **apart), rel=1e-5)
    assert first(goal=False, matching="always") != pytest.approx(first(goal=False, **apart), rel=1e-3)


def test_angles_are_those_near_the_starts_whatever_turns_the_plant_made():
    turns = jnp.full((STATES, D), 0.5 + 6 * np.pi, jnp.float32)
    x = drawn(1.0, turns, angles=(1,), around=np.pi)
    np.testing.assert_allclose(x[:, 1], 0.5, atol=1e-4)
    np.testing.assert_allclose(x[:, [0, 2]], 0.5 + 6 * np.pi, atol=1e-4)
    np.testing.assert_allclose(drawn(1.0, turns, angles=(1,), around=-np.pi)[:, 1], 0.5 - 2 * np.pi, atol=1e-4)


@pytest.mark.parametrize("members", [1, 3])
def test_a_model_that_remembers_predicts_as_before(members):
    model = network() if members == 1 else ensemble(network(), members)
    data = experience()

    @partial(jax.jit, static_argnums=(0, 1))
    def predicted(one, remembered):
        posterior = one.posterior(model.init(jax.random.key(1)), data)
        posterior = remember(posterior, run_state(data), angles=(), varies=ALL) if remembered else posterior
        keys = jax.random.split(jax.random.key(2), 6)
        draws = jax.vmap(one.sample, (0, None))(keys, posterior) if one.deal is None else one.deal(keys, posterior)
        alone = one.apply(posterior, jax.tree.map(lambda leaf: leaf[0], draws), data.x[0], data.u[0])
        return for_particles(one.apply)(posterior, draws, data.x[:6], data.u[:6]), alone

    assert same(predicted(model, False), predicted(remembering(model), True))


@pytest.mark.parametrize("refining", [False, True])
def test_only_a_search_that_refines_starts_there(refining):
    draws = Scenarios(Starts(jnp.zeros((2, D)), jnp.ones((2, D))), None, None, None, None)
    assert np.array_equal(started(draws, jnp.bool_(refining)).start, np.full((2, D), float(refining)))


@pytest.mark.slow
def test_a_refinement_starts_there_and_what_is_imagined_afterwards_does_not():
    task, found = cart(), []
    for share in (0.0, 1.0):
        config = tiny(search__visited_starts=share, search__refine_fraction=0.5, search__steps=20, fit__steps=2)
        exp = compose(config, task, dynamics=regression(len(task.state_names), len(task.control_names)))
        state = exp.init(jax.random.key(0))
        state = exp.add_episode(state, jax.jit(exp.collect)(state))
        state = jax.jit(exp.improve)(state._replace(succeeded=jnp.bool_(True)))[0]
        found.append((state.policy.params, jax.jit(exp.imagine)(state)[0].x[0]))
    (own, own_starts), (other, starts) = found
    assert not same(own, other)
    assert same(own_starts, starts)
