"""Scaling of a model's inputs and targets, from the rows in use of a fixed-capacity data set."""

from typing import NamedTuple

import jax.numpy as jnp

from pegasus_jax.types import Array


class Whitener(NamedTuple):
    """Affine map between raw rows v and white rows w: v = mean + w @ root.T, w = (v - mean) @ inverse.T."""

    mean: Array  # [F]
    root: Array  # [F, F] lower triangular
    inverse: Array  # [F, F] root's inverse


def whitener(rows: Array, size: Array, *, full: bool = True, jitter: float = 1e-6) -> Whitener:
    """The whitener of the first `size` rows of rows [N, F] (docs/reference.md 4.6).

    With `full`, the root is the Cholesky factor of the rows' covariance; otherwise it is diagonal. `jitter` is relative
    to each column's variance and keeps columns that hardly vary (an angle before it has moved) invertible.
    """
    used = (jnp.arange(rows.shape[0]) < size)[:, None]
    count = jnp.maximum(size, 1).astype(rows.dtype)
    mean = jnp.sum(jnp.where(used, rows, 0), 0) / count
    centred = jnp.where(used, rows - mean, 0)
    variance = jnp.maximum(jnp.sum(centred**2, 0) / count, 1e-12)
    scale = jnp.sqrt(variance)
    if not full:
        return Whitener(mean, jnp.diag(scale), jnp.diag(1 / scale))
    # The factor is taken of the correlation matrix, whose entries are all of order one.
    correlation = (centred / scale).T @ (centred / scale) / count
    root = jnp.linalg.cholesky(correlation + jitter * jnp.eye(rows.shape[1], dtype=rows.dtype))
    # An exactly dependent column in float32 can defeat the jitter: fall back to the diagonal, which always exists.
    root = jnp.where(jnp.all(jnp.isfinite(root)), root, jnp.eye(rows.shape[1], dtype=rows.dtype))
    inverse = jnp.linalg.inv(root)
    return Whitener(mean, scale[:, None] * root, inverse / scale)


def whiten(w: Whitener, rows: Array) -> Array:
    """White rows [..., F] of raw rows [..., F]."""
    return (rows - w.mean) @ w.inverse.T


def unwhiten(w: Whitener, rows: Array) -> Array:
    """Raw rows [..., F] of white rows [..., F]."""
    return w.mean + rows @ w.root.T
