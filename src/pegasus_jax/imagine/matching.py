"""Moment matching: replacing particles by fresh ones from the Gaussian with their mean and covariance."""

from pegasus_jax.math.linalg import cholesky, mean_and_cov
from pegasus_jax.types import Array

__all__ = ["keep", "match"]


def match(x: Array, z: Array) -> Array:
    """Particles [K, D] redrawn as mean + L z from the Gaussian fitted to x [K, D]; z [K, D] is standard normal.

    Alg. 3 line 14, whose Sigma z is a slip of notation for L z with L L' = Sigma.
    """
    mean, cov = mean_and_cov(x)
    return mean + z @ cholesky(cov).T


def keep(x: Array, z: Array) -> Array:
    """No moment matching: every particle goes on along its own trajectory."""
    del z
    return x
