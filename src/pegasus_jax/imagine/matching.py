"""Moment matching: replacing particles by fresh ones from the Gaussian with their mean and covariance."""

from pegasus_jax.math.linalg import cholesky, mean_and_cov
from pegasus_jax.sharding import alone_on_gpu
from pegasus_jax.types import Array

__all__ = ["keep", "match"]


def match(x: Array, z: Array) -> Array:
    """Particles [K, D] redrawn as mean + L z from the Gaussian fitted to x [K, D]; z [K, D] is standard normal.

    Alg. 3 line 14, whose Sigma z is a slip of notation for L z with L L' = Sigma. On a GPU it is a kernel of its own,
    which has a gradient but no forward derivative.
    """
    if alone_on_gpu(x):
        from pegasus_jax.imagine import _matching_pallas as kernel  # what it needs of JAX is for GPUs

        if kernel.suits(x):
            return kernel.fused(match_plain)(x, z)
    return match_plain(x, z)


def match_plain(x: Array, z: Array) -> Array:
    """`match` as JAX's compiler has it, on every platform."""
    mean, cov = mean_and_cov(x)
    return mean + z @ cholesky(cov).T


def keep(x: Array, z: Array) -> Array:
    """No moment matching: every particle goes on along its own trajectory."""
    del z
    return x
