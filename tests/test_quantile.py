"""The draws and the quantile of the noise on units: against scipy, and statistics of many draws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

from pegasus_jax.math.quantile import erf_inv, uniforms

MANY = 100_000


def test_uniforms_are_uniform_and_never_at_an_end():
    """A Kolmogorov-Smirnov test of all, and of each half of the bits, whose neighbors do not depend on each other."""
    draws = np.asarray(uniforms(jax.random.key(0), MANY))
    assert draws.shape == (MANY,)
    assert 0 < draws.min() < 1e-4
    assert 1 - 1e-4 < draws.max() < 1
    first, second = np.split(draws, 2)  # the upper and the lower halves of the same bits
    for part in (draws, first, second):
        assert stats.kstest(part, "uniform").pvalue > 0.01
    for a, b in ((first, second), (first[1:], first[:-1]), (second[1:], second[:-1])):
        assert abs(np.corrcoef(a, b)[0, 1]) < 4 / np.sqrt(MANY / 2)


@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_as_many_uniforms_as_asked(count):
    assert uniforms(jax.random.key(1), count).shape == (count,)


def test_what_rounding_takes_from_a_normal_draw():
    """The docstring's bound: all 2^16 values that a draw can have, as a normal's quantiles, have nearly variance 1."""
    every = (np.arange(2**16) + 0.5) / 2**16
    assert 1 - 2.1e-5 < np.mean(stats.norm.ppf(every) ** 2) < 1


@pytest.mark.parametrize(("x64", "tolerance"), [(False, 6e-6), (True, 1e-12)])
def test_erf_inv_and_its_derivative_against_scipy(x64, tolerance):
    """From 1e-7 to within 1e-5 of 1, where the noise of a unit can be, on both sides."""
    with jax.enable_x64(x64):
        near = np.geomspace(1e-7, 0.5, 400)
        x = np.concatenate([near, 1 - np.geomspace(1e-5, 0.5, 400)]).astype(np.float64 if x64 else np.float32)
        x = np.concatenate([x, -x])
        y, slope = jax.vmap(jax.value_and_grad(erf_inv))(jnp.asarray(x))
        expected = special.erfinv(x.astype(np.float64))
        np.testing.assert_allclose(y, expected, rtol=tolerance)
        np.testing.assert_allclose(slope, np.sqrt(np.pi) / 2 * np.exp(expected**2), rtol=20 * tolerance)
