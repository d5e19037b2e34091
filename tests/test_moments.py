"""Moment matching: the requested moments, an honest Cholesky factor, and gradients that stay finite."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pegasus_jax.imagine.matching import keep, match
from pegasus_jax.math.linalg import cholesky, mean_and_cov, standardize

seeds = st.integers(0, 2**16)
sizes = pytest.mark.parametrize("size", [1, 4, 7])


def covariance(seed, size):
    a = np.random.default_rng(seed).normal(size=(size, size + 2))
    return a @ a.T + 0.1 * np.eye(size)


@sizes
def test_cholesky_in_value_and_gradient(size, x64):
    """Against the library's, along random directions. A symmetric matrix's two halves share a gradient differently
    from library to library, so gradients are compared along symmetric directions."""

    @jax.jit
    @jax.vmap
    def compare(cov, direction, weight):
        def gradient(f):
            whole = jax.grad(lambda c: jnp.sum(weight * f(c)))(cov)
            return whole + whole.T

        return [(f(cov), jax.jvp(f, (cov,), (direction,))[1], gradient(f)) for f in (cholesky, jnp.linalg.cholesky)]

    covs, directions = (jnp.stack([covariance(seed + first, size) for seed in range(3)]) for first in (0, 100))
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(3, size, size)))
    for ours, theirs in zip(*compare(covs, directions, weights), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-10)


DEGENERATE = {
    "zero": np.zeros((3, 3)),
    "zero column": np.diag([1.0, 0.0, 2.0]),
    "rank one": np.outer([1.0, -2.0, 0.5], [1.0, -2.0, 0.5]),
    "tiny": 1e-12 * np.eye(3),
    "mixed scales": np.diag([1e-12, 1.0, 1e6]),
    "negative by rounding": np.array([[1.0, 1.0, 0.0], [1.0, 1.0 - 1e-6, 0.0], [0.0, 0.0, 1.0]]),
}


@pytest.fixture(scope="module")
def factor_and_gradient():
    return jax.jit(lambda c: (cholesky(c), jax.grad(lambda c: jnp.sum(jnp.sin(cholesky(c))))(c)))


def eliminated(cov):
    """The factor by elimination, whose derivative jax takes step by step."""
    rest, columns = cov, []
    for j in range(cov.shape[0]):
        column = rest[:, j] / jnp.sqrt(jnp.maximum(rest[j, j], 1e-7 * cov[j, j] + jnp.finfo(cov.dtype).tiny ** 0.5))
        columns.append(jnp.where(jnp.arange(cov.shape[0]) >= j, column, 0))
        rest = rest - jnp.outer(columns[-1], columns[-1])
    return jnp.stack(columns, 1)


@jax.jit
def both_gradients(cov, weight):
    return [jax.grad(lambda c, f=f: jnp.sum(weight * f((c + c.T) / 2)))(cov) for f in (cholesky, eliminated)]


@given(seed=seeds)
def test_a_floored_pivot_counts_as_a_constant_in_the_gradient(seed):
    """The last of three dimensions is a combination of the others, to 1e-6 of its size: particles on a plane."""
    noise = np.random.default_rng(seed)
    points = noise.normal(size=(3, 3)) * np.array([[1.0], [1.0], [1e-6]])
    root = np.array([[1, 0, 0], [0.5, 1, 0], [-0.3, 0.7, 1]]) @ points
    with jax.enable_x64(True):
        weight = jnp.asarray(noise.normal(size=(3, 3)))
        ours, theirs = both_gradients(jnp.asarray(root @ root.T), weight)
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5 * np.abs(theirs).max())


@pytest.mark.parametrize("name", DEGENERATE)
def test_a_degenerate_covariance_gives_finite_factor_and_gradient(name, factor_and_gradient):
    cov = jnp.asarray(DEGENERATE[name], jnp.float32)
    factor, gradient = factor_and_gradient(cov)
    assert np.all(np.isfinite(factor))
    assert np.all(np.isfinite(gradient))
    np.testing.assert_allclose(factor @ factor.T, cov, atol=2e-3 * float(jnp.max(jnp.abs(cov))) + 1e-6)


def test_what_does_not_vary_yet_has_no_part_in_the_gradient():
    """As a control that waits since the start: the other columns' slopes are what they are without it."""

    def total(x, weight):
        return jnp.sum(weight * cholesky(mean_and_cov(x)[1]))

    noise = np.random.default_rng(4)
    others, weight = jnp.asarray(noise.normal(size=(20, 2)), jnp.float32), jnp.asarray(noise.normal(size=(3, 3)))
    still = jnp.insert(others, 1, 0.3, axis=1)
    found = jax.grad(total)(still, weight)
    without = jax.grad(total)(others, weight[jnp.array([0, 2])][:, jnp.array([0, 2])])
    np.testing.assert_allclose(found[:, jnp.array([0, 2])], without, rtol=1e-4, atol=1e-5)
    assert jnp.abs(found[:, 1]).max() < 10


of_matched = jax.jit(jax.value_and_grad(lambda x, z: jnp.sum(jnp.cos(match(x, z)))))


@given(st.sampled_from([0.0, 1e-20, 1e-12, 1e-6, 1e-3, 1.0, 1e3]))
def test_gradient_of_matched_particles_is_finite_however_little_they_spread(spread):
    """All particles in one place, or on a line: a certain model makes this happen."""
    noise = np.random.default_rng(0)
    x = jnp.asarray(1 + spread * noise.normal(size=(9, 1)) * np.array([1.0, 2.0, 0.0]), jnp.float32)
    z = jnp.asarray(noise.normal(size=(9, 3)), jnp.float32)
    value, gradient = of_matched(x, z)
    assert np.isfinite(value)
    assert np.all(np.isfinite(gradient))


@given(seeds, st.sampled_from([2, 12]))
def test_mean_and_cov_are_numpys(seed, particles):
    x = np.random.default_rng(seed).normal(size=(particles, 3)).astype(np.float32)
    mean, cov = mean_and_cov(jnp.asarray(x))
    np.testing.assert_allclose(mean, x.mean(0), atol=1e-6)
    np.testing.assert_allclose(cov, np.cov(x.T), atol=1e-5)


@jax.jit
def balanced_match(x, z):
    z = standardize(z)
    return z, match(x, z)


@given(seeds, st.sampled_from([4, 30]))
def test_balanced_draws_give_matched_particles_exactly_the_moments(seed, particles):
    """Four particles are the fewest that have a covariance in three dimensions."""
    noise = np.random.default_rng(seed)
    with jax.enable_x64(True):
        x = noise.exponential(size=(particles, 3)) @ covariance(seed, 3)
        z, matched = (np.asarray(v) for v in balanced_match(x, noise.normal(size=(particles, 3))))
    np.testing.assert_allclose(z.mean(0), 0, atol=1e-8)
    np.testing.assert_allclose(np.cov(z.T), np.eye(3), atol=1e-8)
    np.testing.assert_allclose(matched.mean(0), x.mean(0), atol=1e-7)
    np.testing.assert_allclose(np.cov(matched.T), np.cov(x.T), rtol=1e-7, atol=1e-6)


def test_random_draws_give_the_moments_as_particles_grow():
    noise = np.random.default_rng(0)
    x = noise.exponential(size=(50, 3)).astype(np.float32)
    # One set of particles, many draws: the Gaussian fitted to 50 particles, sampled 200 times.
    z = jnp.asarray(noise.normal(size=(200, 50, 3)), jnp.float32)
    matched = np.asarray(jax.vmap(match, (None, 0))(jnp.asarray(x), z)).reshape(-1, 3)
    np.testing.assert_allclose(matched.mean(0), x.mean(0), atol=0.06)
    np.testing.assert_allclose(np.cov(matched.T), np.cov(x.T), atol=0.1)


def test_matched_particles_forget_where_each_was():
    """Only mean and covariance pass: particles in another order, same draws, same result."""
    noise = np.random.default_rng(1)
    x, z = noise.normal(size=(2, 8, 3)).astype(np.float32)
    np.testing.assert_allclose(match(x, z), match(x[::-1], z), atol=1e-5)
    assert keep(x, z) is x


@pytest.mark.parametrize("particles", [1, 2, 3])
def test_standardize_refuses_fewer_particles_than_have_a_covariance(particles):
    """Three particles in three dimensions lie in a plane: across it their noise would silently be 0."""
    with pytest.raises(ValueError, match=f"{particles} particles are too few .* 3 dimensions; expected at least 4"):
        standardize(jnp.ones((2, particles, 3)))


def test_standardize_is_idempotent_and_works_on_every_time_step_alone():
    z = jnp.asarray(np.random.default_rng(2).normal(size=(4, 9, 3)) * 5 + 2, jnp.float32)
    once = standardize(z)
    np.testing.assert_allclose(standardize(once), once, atol=1e-4)
    np.testing.assert_allclose(standardize(z[2]), once[2], atol=1e-5)
