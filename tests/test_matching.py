"""Moment matching: a Gaussian of the same moments where there is one, else the particles themselves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pegasus_jax.imagine import costs, matching
from pegasus_jax.math.linalg import standardize
from pegasus_jax.types import Cost

K, ANGLES = 50, (1,)
seeds = st.integers(0, 2**16)


def cloud(seed, spread):
    """Particles [K, 2] whose second entry, an angle, has the standard deviation `spread`, and their match noise."""
    x, z = (np.random.default_rng((seed, part)).normal(size=(K, 2)) for part in (0, 1))
    x = (x - x.mean(0)) / x.std(0) * np.array([0.3, spread]) + np.array([1.0, 2.0])
    return jnp.asarray(x, jnp.float32), standardize(jnp.asarray(z, jnp.float32)[None])[0]


@given(seeds, st.floats(0.01, 0.99))
def test_a_narrow_cloud_is_matched(seed, spread):
    x, z = cloud(seed, spread)
    found = matching.narrow(ANGLES)(x, z)
    assert np.array_equal(found, matching.match(x, z))
    np.testing.assert_allclose(found.mean(0), x.mean(0), atol=1e-4)
    np.testing.assert_allclose(np.cov(found.T), np.cov(x.T), atol=2e-2 * (0.1 + spread**2))


@given(seeds, st.floats(1.01, 6.0))
def test_a_cloud_around_the_circle_is_left_as_it_is(seed, spread):
    x, z = cloud(seed, spread)
    assert np.array_equal(matching.narrow(ANGLES)(x, z), x)


@given(seeds, st.floats(1.01, 1e3))
def test_an_entry_that_is_no_angle_may_spread(seed, spread):
    x, z = cloud(seed, spread)
    assert np.array_equal(matching.narrow(())(x, z), matching.match(x, z))
    assert np.array_equal(matching.narrow((0,))(x, z), matching.match(x, z))


def test_particles_on_the_whole_circle_are_wide_and_on_its_half_are_not():
    turns = jnp.linspace(-1, 1, 1001)[:, None]
    assert bool(matching.wide(np.pi * turns, (0,)))
    assert not bool(matching.wide(np.pi / 2 * turns, (0,)))
    assert matching.wide(jnp.stack([np.pi * turns, turns]), (0,)).tolist() == [True, False]  # time by time


def test_the_gradient_goes_through_each_particle_of_a_wide_cloud_alone():
    x, z = cloud(0, 2.0)
    jacobian = jax.jacobian(lambda x: matching.narrow(ANGLES)(x, z))(x)
    assert np.array_equal(jacobian.reshape(2 * K, 2 * K), np.eye(2 * K))


def test_a_particle_that_has_diverged_spoils_no_gradient():
    x, z = cloud(0, 2.0)
    far = x.at[3].set(1e25)
    cost = Cost(lambda x: 1 - jnp.exp(-jnp.sum(x**2)))
    moved = jax.grad(lambda x: jnp.sum(jnp.tanh(matching.narrow(ANGLES)(x, z))))(far)
    costly = jax.grad(lambda x: jnp.sum(costs.of_narrow(cost, ANGLES)(x[None])))(far)
    assert np.isfinite(moved).all()
    assert np.isfinite(costly).all()


def quadratic(x):
    return 0.01 * jnp.sum(x**2)


@pytest.mark.parametrize("spread", [0.5, 2.0])
def test_a_cost_is_of_the_gaussian_or_of_the_particles(spread):
    """Told apart by an expectation that is none of this cost."""
    cost = Cost(quadratic, lambda mean, cov: jnp.float32(0.7))
    x, _ = cloud(0, spread)
    found = costs.of_narrow(cost, ANGLES)(x[None])
    expected = [0.7] * K if spread < 1 else [quadratic(row) for row in x]
    np.testing.assert_allclose(found, [expected], rtol=1e-5)


def test_one_particle_has_no_covariance():
    for made in (matching.match, matching.narrow((0,))):
        with pytest.raises(
            ValueError, match=r"x of shape \(1, 2\) is 1 particles; a covariance, as of moment matching, needs 2"
        ):
            made(jnp.zeros((1, 2)), jnp.zeros((1, 2)))
