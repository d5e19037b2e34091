"""Costs: the saturating form, and what is made of the costs of many particles."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pegasus_jax import cost

COSTS = np.random.default_rng(0).uniform(size=(6, 4)).astype(np.float32)  # [H, K]
number = st.floats(-5, 5, width=32)


@given(number, number, st.floats(0.1, 3))
def test_saturating_cost(a, b, width):
    of_state = cost.saturating(lambda x: jnp.array([x[0], 2 * x[1]]), width)
    expected = 1 - np.exp(-(a**2 + 4 * b**2) / (2 * width**2))
    np.testing.assert_allclose(of_state(jnp.array([a, b])), expected, atol=1e-5)


def test_saturating_cost_is_flat_and_smooth_at_the_goal_and_far_away():
    """A distance would have no gradient at zero; its square has."""
    of_state = cost.saturating(lambda x: x, 0.25)
    for point, value in ((jnp.zeros(3), 0.0), (jnp.full(3, 1e3), 1.0)):
        assert float(of_state(point)) == value
        assert np.array_equal(jax.grad(of_state)(point), np.zeros(3))


def test_the_cost_of_every_particle():
    of_state = cost.saturating(lambda x: x, 1.0)
    x = jnp.asarray(np.random.default_rng(1).normal(size=(3, 4, 2)), jnp.float32)
    expected = [[float(of_state(x[t, k])) for k in range(4)] for t in range(3)]
    np.testing.assert_allclose(cost.of_particles(of_state)(x), expected, rtol=1e-6)


def test_mean_and_total_differ_by_the_horizon():
    np.testing.assert_allclose(cost.mean(COSTS), COSTS.mean(), rtol=1e-6)
    np.testing.assert_allclose(cost.total(COSTS), 6 * COSTS.mean(), rtol=1e-6)


@given(st.floats(0.05, 1))
def test_discount_weighs_each_step_against_the_one_before(discount):
    expected = sum(discount**t * COSTS[t].mean() for t in range(6))
    np.testing.assert_allclose(cost.discounted(discount, cost.total)(COSTS), expected, rtol=1e-5)
    np.testing.assert_allclose(cost.discounted(discount, cost.mean)(COSTS), expected / 6, rtol=1e-5)
