"""Moment matching: replacing particles by fresh ones from the Gaussian with their mean and covariance."""

import jax.numpy as jnp

from pegasus_jax.types import Array


def cholesky(cov: Array) -> Array:
    """Lower Cholesky factor of cov [D, D], unrolled over columns.

    For the few dimensions of a robot's state this is plain arithmetic that XLA fuses, forward and backward, where a
    library call would cost more than the networks around it. Pivots are floored at 1e-7 of their variance, so a
    degenerate covariance gives a degenerate factor and finite gradients, never NaN.
    """
    size = cov.shape[0]
    floor = 1e-7 * jnp.diagonal(cov) + jnp.finfo(cov.dtype).tiny ** 0.5
    rest, columns = cov, []
    for j in range(size):
        column = rest[:, j] / jnp.sqrt(jnp.maximum(rest[j, j], floor[j]))
        column = jnp.where(jnp.arange(size) >= j, column, 0)
        rest = rest - jnp.outer(column, column)
        columns.append(column)
    return jnp.stack(columns, axis=1)


def mean_and_cov(x: Array) -> tuple[Array, Array]:
    """Mean [D] and unbiased covariance [D, D] of particles x [K, D]."""
    mean = jnp.mean(x, 0)
    centred = x - mean
    return mean, centred.T @ centred / (x.shape[0] - 1)


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


def standardise(z: Array) -> Array:
    """Draws z [..., K, D] with their sample mean made exactly 0 and sample covariance exactly I, over K."""
    centred = z - jnp.mean(z, -2, keepdims=True)
    cov = jnp.swapaxes(centred, -1, -2) @ centred / (z.shape[-2] - 1)
    root = jnp.linalg.cholesky(cov)
    return jnp.swapaxes(jnp.linalg.solve(root, jnp.swapaxes(centred, -1, -2)), -1, -2)
