"""Costs: the saturating form, and what is made of the costs of many particles."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from pegasus_envs.cartpole import cartpole
from pegasus_envs.double_cartpole import double_cartpole
from pegasus_envs.swimmer.plant import swimmer
from pegasus_jax import tasks
from pegasus_jax.imagine import costs as cost
from pegasus_jax.math.angles import encode
from pegasus_jax.math.gaussian import sincos
from pegasus_jax.types import Cost

COSTS = np.random.default_rng(0).uniform(size=(6, 4)).astype(np.float32)  # [H, K]
number = st.floats(-5, 5, width=32)


@given(number, number, st.floats(0.1, 3))
def test_saturating_cost(a, b, width):
    of_state = cost.saturating(lambda x: jnp.array([x[0], 2 * x[1]]), width, ()).of_state
    expected = 1 - np.exp(-(a**2 + 4 * b**2) / (2 * width**2))
    np.testing.assert_allclose(of_state(jnp.array([a, b])), expected, atol=1e-5)


def test_saturating_cost_is_flat_and_smooth_at_the_goal_and_far_away():
    """A distance would have no gradient at zero; its square has."""
    of_state = cost.saturating(lambda x: x, 0.25, ()).of_state
    for point, value in ((jnp.zeros(3), 0.0), (jnp.full(3, 1e3), 1.0)):
        assert float(of_state(point)) == value
        assert np.array_equal(jax.grad(of_state)(point), np.zeros(3))


def test_the_cost_of_every_particle():
    saturating = cost.saturating(lambda x: x, 1.0, ())
    x = jnp.asarray(np.random.default_rng(1).normal(size=(3, 4, 2)), jnp.float32)
    expected = [[float(saturating.of_state(x[t, k])) for k in range(4)] for t in range(3)]
    np.testing.assert_allclose(cost.of_particles(saturating)(x), expected, rtol=1e-6)


def test_mean_and_total_differ_by_the_horizon():
    np.testing.assert_allclose(cost.mean(COSTS), COSTS.mean(), rtol=1e-6)
    np.testing.assert_allclose(cost.total(COSTS), 6 * COSTS.mean(), rtol=1e-6)


# Expected costs. Every task of the package has an error that is affine in the features

PLANTS = {
    "cartpole": cartpole,
    "double_cartpole": double_cartpole,
    **{
        f"swimmer_{goal}_{legs}": partial(swimmer, goal, legs)
        for goal in ("knife_edge", "belly_up", "corkscrew", "depth_change")
        for legs in (2, 6)
    },
}
every_plant = pytest.mark.parametrize("name", PLANTS)
GOALS = {
    "cartpole": [0, 0, 0, np.pi],
    "double_cartpole": np.zeros(6),
    "swimmer_knife_edge_2": [np.pi / 2, 0, 0, 1, 0, 0, 0],
    "swimmer_belly_up_2": [np.pi, 0, 0, 1, 0, 0, 0],
    "swimmer_corkscrew_2": [0.7, 0, 0, 1, -2 * np.pi / 3, 0, 0],
    "swimmer_depth_change_2": [0, 0, 0, 2, 0, 0, 0],
}


@every_plant
def test_the_error_is_its_affine_form(name, x64):
    plant = PLANTS[name]()
    states = len(plant.state_names)
    matrix, offset = cost.affine_error(plant.error, states, plant.angles)
    x = 3 * np.random.default_rng(0).normal(size=(20, states))
    expected = encode(jnp.asarray(x), plant.angles) @ matrix.T + offset
    np.testing.assert_allclose(jax.vmap(plant.error)(x), expected, atol=1e-12)


@pytest.mark.parametrize("name", GOALS)
def test_the_expected_cost_against_samples(name, x64):
    """Of features that are Gaussian; and of a Gaussian state, whose sines and cosines nearly are for small angles."""
    plant, count = PLANTS[name](), 200_000
    noise = np.random.default_rng(1)
    states = len(plant.state_names)
    root = 0.1 * noise.normal(size=(states, states))
    mean, cov = np.array(GOALS[name]) + 0.1 * noise.normal(size=states), root @ root.T * plant.width

    @jax.jit
    def moments(mean, cov):
        features = sincos(mean, cov, plant.angles)
        expected = cost.expectation(cost.saturating(plant.error, plant.width, plant.angles))(mean, cov)
        return features.mean, features.cov, cost.affine_error(plant.error, states, plant.angles), expected

    feature_mean, feature_cov, (matrix, offset), expected = moments(mean, cov)
    draws = noise.multivariate_normal(feature_mean, feature_cov, count, method="svd")
    costs = 1 - np.exp(-0.5 * np.sum((draws @ np.asarray(matrix).T + offset) ** 2, 1) / plant.width**2)
    assert 0.02 < costs.mean() < 0.9
    assert float(expected) == pytest.approx(costs.mean(), abs=5 * costs.std() / count**0.5)
    x = noise.multivariate_normal(mean, cov, count)
    of_states = jax.jit(jax.vmap(cost.saturating(plant.error, plant.width, plant.angles).of_state))(x)
    assert float(expected) == pytest.approx(float(of_states.mean()), abs=0.02)


@pytest.mark.parametrize("size", [1, 4, 13])
def test_nodes_have_the_moments_of_a_standard_normal(size):
    """The first two exactly; the next two nearly: a standardized sample of as many is off by .11 and .21 (std)."""
    z = cost.normal_nodes(512, size)
    np.testing.assert_allclose(z.mean(0), 0, atol=1e-12)
    np.testing.assert_allclose(z.T @ z / 512, np.eye(size), atol=1e-12)
    np.testing.assert_allclose(np.mean(z**3, 0), 0, atol=0.06)
    np.testing.assert_allclose(np.mean(z**4, 0), 3, atol=0.2)


def test_the_expectation_by_nodes_of_a_quadratic_cost_is_exact(x64):
    noise = np.random.default_rng(5)
    (mean, slope), root, curve = noise.normal(size=(2, 3)), noise.normal(size=(3, 3)), noise.normal(size=(3, 3))
    cov = root @ root.T
    expected = jax.jit(cost.expected_by_nodes(lambda x: x @ curve @ x + slope @ x + 7))(mean, cov)
    known = mean @ curve @ mean + np.trace(curve @ cov) + slope @ mean + 7
    np.testing.assert_allclose(expected, known, rtol=1e-10)


@pytest.mark.parametrize("name", GOALS)
def test_the_expectation_by_nodes_against_the_closed_form(name, x64):
    """And its gradient, which a search follows; the hundred particles of a search are several times as far off."""
    plant = PLANTS[name]()
    states, noise = len(plant.state_names), np.random.default_rng(6)
    saturating = cost.saturating(lambda x: x[:2] - 0.3, 0.5, ())
    by_nodes, closed = cost.expected_by_nodes(saturating.of_state), cost.expectation(saturating)
    root = 0.4 * noise.normal(size=(states, states))
    mean, cov = 0.5 * noise.normal(size=states), root @ root.T
    near, exact = (jax.jit(jax.value_and_grad(f, (0, 1)))(mean, cov) for f in (by_nodes, closed))
    assert 0.05 < float(exact[0]) < 0.95
    assert float(near[0]) == pytest.approx(float(exact[0]), abs=0.01)
    np.testing.assert_allclose(near[1][0][:2], exact[1][0][:2], atol=0.03)
    np.testing.assert_allclose(near[1][0][2:], 0, atol=1e-12)

    def of_chance(seed: int) -> float:
        x = np.random.default_rng(seed).multivariate_normal(mean, cov, 100)
        return float(jnp.mean(jax.vmap(saturating.of_state)(x)))

    off = np.std([of_chance(seed) for seed in range(20)])
    assert abs(float(near[0]) - float(exact[0])) < off / 3


def test_the_cost_of_a_task_and_its_expectation_agree_where_the_state_is_known(x64):
    task = tasks.make("double_cartpole")
    x = np.random.default_rng(2).normal(size=(20, 6)) * 0.3
    assert task.cost.expected is not None
    known = jax.jit(jax.vmap(task.cost.expected, (0, None)))(x, np.zeros((6, 6)))
    np.testing.assert_allclose(known, jax.vmap(task.cost.of_state)(x), atol=1e-12)


def test_a_widened_cost_is_that_of_a_smaller_error(x64):
    """And the width may be traced."""
    error = lambda x: jnp.array([x[0] - jnp.cos(x[1])])  # noqa: E731
    noise = np.random.default_rng(4)
    x, root = noise.normal(size=2), 0.3 * noise.normal(size=(2, 2))
    wide = lambda factor: cost.saturating(error, 0.7, (1,)).widen(factor)  # noqa: E731
    of_state, of_gaussian = (jax.jit(lambda f, *a, i=i: wide(f)[i](*a)) for i in range(2))
    third = cost.saturating(lambda x: error(x) / 3, 0.7, (1,))
    np.testing.assert_allclose(of_state(3.0, x), third.of_state(x), rtol=1e-10)
    expected = jax.jit(third.expected)(x, root @ root.T)
    np.testing.assert_allclose(of_gaussian(3.0, x, root @ root.T), expected, rtol=1e-10)


def test_what_a_gaussian_state_costs_is_as_its_user_says_at_the_costs_own_width(x64):
    """Wider it is a mean over nodes, of the wider cost: nobody said what that is."""
    own = Cost(lambda x: 1 - jnp.exp(-0.5 * x @ x), lambda mean, cov: 7.0 + 0 * mean[0])
    mean, cov = jnp.ones(2), 0.1 * jnp.eye(2)
    at = jax.jit(lambda factor: cost.widened(own, factor).expected(mean, cov))
    assert at(1.0) == cost.widened(own, 1).expected(mean, cov) == 7.0
    nodes = cost.expectation(cost.widened(Cost(own.of_state), 2.0))(mean, cov)
    assert at(2.0) == pytest.approx(float(nodes), rel=1e-12)


def test_any_cost_is_widened_as_a_gaussian_one_is(x64):
    """The closed form, its slope and nearly its expectation, of a cost of which only the values are known."""
    known = cost.saturating(lambda x: jnp.array([x[0] - 0.3, 0.4 * x[1]]), 0.7, ())
    own = Cost(known.of_state)
    x, cov = 2 * np.random.default_rng(4).normal(size=(50, 2)), np.array([[0.5, 0.2], [0.2, 0.3]])

    @jax.jit
    def all_of(factor):
        costs = cost.widened(known, factor), cost.widened(own, factor)
        return [(jax.vmap(jax.value_and_grad(c.of_state))(x), cost.expectation(c)(x[0], cov)) for c in costs]

    for factor in (1.0, 2.0, 8.0):
        (closed, expected), (values, by_nodes) = all_of(factor)
        jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6, atol=1e-9), values, closed)
        np.testing.assert_allclose(by_nodes, expected, atol=2e-3)


@given(st.floats(-0.5, 1.5, width=32), st.floats(-0.5, 1.5, width=32), st.sampled_from([1.0, 2.0, 8.0]))
@example(1.0, 0.0, 2.0)
@example(1.0, float(np.nextafter(np.float32(1), np.float32(0))), 8.0)
def test_a_widened_cost_keeps_the_order_and_has_a_slope(one, other, factor):
    """Also at 0 and 1, beside them, and for a cost of 1 and more, which keeps its slope."""
    wide = cost.widened(Cost(lambda x: x), factor).of_state
    values, slopes = (jax.vmap(f)(jnp.array([one, other])) for f in (wide, jax.grad(wide)))
    assert (one - other) * float(values[0] - values[1]) >= 0
    assert np.all(np.isfinite(slopes) & (slopes > 0))
    np.testing.assert_allclose(slopes[jnp.array([one, other]) >= 1], 1)
    assert abs(float(wide(jnp.zeros(())))) < 1e-6
    assert factor > 1 or np.allclose(values, [one, other], atol=1e-6)


def test_the_matched_cost_is_that_of_the_particles_gaussian(x64):
    saturating = cost.saturating(lambda x: jnp.array([x[0] - jnp.cos(x[1])]), 0.7, (1,))
    x = np.random.default_rng(3).normal(size=(3, 9, 2))
    matched = jax.jit(cost.of_matched(saturating))(x)
    expected = jax.jit(saturating.expected)
    assert matched.shape == (3, 1)
    for t in range(3):
        np.testing.assert_allclose(matched[t, 0], expected(x[t].mean(0), np.cov(x[t].T)), rtol=1e-10)


def test_particles_that_stop_cost_what_the_user_says_from_then_on():
    """A hard stop by hand: the state that ends a particle has its own cost, those after it `stop_cost`."""
    x = jnp.asarray([[[0.0], [0.0]], [[2.0], [0.0]], [[0.0], [0.0]], [[0.0], [3.0]]])  # [H, K, D]
    costs = jnp.asarray(COSTS[:4, :2])
    found = cost.until_stop(costs, x, lambda x: x[0] > 1, 0.9)
    expected = COSTS[:4, :2].copy()
    expected[2:, 0] = 0.9
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    # Of an expectation over particles, the half that goes on counts.
    one = cost.until_stop(costs[:, :1], x, lambda x: x[0] > 1, 0.9)
    np.testing.assert_allclose(one[:, 0], [*COSTS[:2, 0], *(0.5 * COSTS[2:4, 0] + 0.45)], rtol=1e-6)


def test_a_soft_stop_has_a_gradient_and_is_its_own_expectation():
    """Stopping with probability p at every state: after t of them (1 - p)^t of a particle goes on."""
    x = jnp.zeros((5, 3, 2))
    found = cost.until_stop(jnp.full((5, 3), 0.2), x, lambda x: 0.25 + 0 * x[0], 1.0)
    np.testing.assert_allclose(found[:, 1], 1 - 0.8 * 0.75 ** np.arange(5), rtol=1e-6)
    total = lambda shift: jnp.mean(  # noqa: E731
        cost.until_stop(jnp.full((5, 3), 0.2), x + shift, lambda x: jax.nn.sigmoid(x[0]), 1.0)
    )
    slope = (total(1e-2) - total(-1e-2)) / 2e-2
    assert slope > 0.1
    np.testing.assert_allclose(jax.grad(total)(0.0), slope, rtol=1e-2)
