"""The expected saturating cost of a Gaussian state: samples, the authors' form, finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pegasus_jax.math import gaussian
from test_gaussian import COV, MATRIX, MEAN, OFFSET, SAMPLES, D, random_cov, standard_normals

pytestmark = pytest.mark.usefixtures("x64")


def test_against_samples():
    deviation = standard_normals(D) @ np.linalg.cholesky(COV).T
    for width in (0.25, 1.0, 5.0):
        costs = 1 - np.exp(-0.5 * np.sum(((MEAN + deviation) @ MATRIX.T + OFFSET) ** 2, 1) / width**2)
        expected = gaussian.saturating_cost(jnp.array(MEAN), jnp.array(COV), MATRIX, OFFSET, width)
        assert float(expected) == pytest.approx(costs.mean(), abs=5 * costs.std() / np.sqrt(SAMPLES))


def test_agrees_with_the_form_of_the_authors():
    """docs/reference.md 1.3: a quadratic form of all features, instead of the error's few dimensions."""
    target = np.linalg.lstsq(MATRIX, -OFFSET)[0]
    quadratic = MATRIX.T @ MATRIX / 0.7**2
    ratio = np.eye(D) + COV @ quadratic
    distance = (MEAN - target) @ quadratic @ np.linalg.inv(ratio) @ (MEAN - target)
    expected = 1 - np.exp(-0.5 * distance) / np.sqrt(np.linalg.det(ratio))
    assert float(gaussian.saturating_cost(MEAN, COV, MATRIX, OFFSET, 0.7)) == pytest.approx(expected, rel=1e-12)


def test_gradient_against_finite_differences():
    @jax.jit
    def value(mean, scale):
        return gaussian.saturating_cost(mean, scale * COV, MATRIX, OFFSET, 0.7)

    gradient, slope = jax.grad(value, (0, 1))(jnp.array(MEAN), 1.0)
    shift = 1e-5 * np.eye(D)
    differences = [(value(MEAN + s, 1.0) - value(MEAN - s, 1.0)) / 2e-5 for s in shift]
    np.testing.assert_allclose(gradient, differences, rtol=1e-6)
    np.testing.assert_allclose(slope, (value(MEAN, 1.0 + 1e-5) - value(MEAN, 1.0 - 1e-5)) / 2e-5, rtol=1e-6)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 1000), scale=st.floats(0.0, 100.0))
def test_is_between_zero_and_one(seed, scale):
    mean, cov = np.random.default_rng(seed).normal(size=D), random_cov(seed, D, scale)
    assert 0 <= float(jax.jit(gaussian.saturating_cost)(mean, cov, MATRIX, OFFSET, 0.25)) <= 1
