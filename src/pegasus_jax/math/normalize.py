"""Scaling of a model's inputs and targets, from the rows in use of a fixed-capacity data set."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from pegasus_jax.types import Array


class Whitener(NamedTuple):
    """Affine map between raw rows v and white rows w: v = mean + w @ root.T, w = (v - mean) @ inverse.T."""

    mean: Array  # [F]
    root: Array  # [F, F] lower triangular
    inverse: Array  # [F, F] root's inverse


def whitener(rows: Array, size: Array, *, full: bool = True) -> Whitener:
    """The whitener of the first `size` rows of rows [N, F] (docs/reference.md 4.6).

    With `full`, the root is the Cholesky factor of the rows' covariance; otherwise it is diagonal. The covariance is
    that of the rows and of one more row whose columns are uncorrelated: a few rows, such as an episode that ends after
    seven steps, cannot tell a correlation of 1 from one of nearly 1, and whitening enlarges the difference. A millionth
    of each column's variance keeps columns that hardly vary (an angle before it has moved) invertible. A column that
    those before it determine is scaled alone, see `independent`.
    """
    used = (jnp.arange(rows.shape[0]) < size)[:, None]
    count = jnp.maximum(size, 1).astype(rows.dtype)
    mean = jnp.sum(jnp.where(used, rows, 0), 0) / count
    centered = jnp.where(used, rows - mean, 0)
    variance = jnp.maximum(jnp.sum(centered**2, 0) / count, 1e-12)
    scale = jnp.sqrt(variance)
    if not full:
        return Whitener(mean, jnp.diag(scale), jnp.diag(1 / scale))
    # The factor is taken of the correlation matrix, whose entries are all of order one.
    identity = jnp.eye(rows.shape[1], dtype=rows.dtype)
    products = (centered / scale).T @ (centered / scale)
    free = independent(products / count)
    correlation = (products + identity) / (count + 1)
    correlation = jnp.where(free[:, None] & free, correlation, identity)
    root = jnp.linalg.cholesky(correlation + 1e-6 * identity)
    inverse = jnp.linalg.inv(root)
    return Whitener(mean, scale[:, None] * root, inverse / scale)


def independent(correlation: Array) -> Array:
    """Whether less than all of each column [F] follows linearly from the columns before it, given their correlation.

    What does not follow, the pivot of an elimination, is a fraction of the column's variance. Whitening would enlarge
    it to all of it: 1e-4 a hundred times. Imagined states leave the data's plane and are enlarged like that at each
    step, until nothing is finite. What depends exactly leaves 1e-6 in single precision; a random episode of our own
    plants leaves 0.04 and more, so that they are whitened as if this were not here.
    """

    def eliminate(j: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        rest, free = carry
        pivot = rest[j, j]
        kept = pivot >= 1e-4
        column = jnp.where(kept, rest[:, j], 0)
        return rest - jnp.outer(column, column) / jnp.where(kept, pivot, 1), free.at[j].set(kept)

    start = (correlation, jnp.ones(correlation.shape[0], bool))
    return jax.lax.fori_loop(0, correlation.shape[0], eliminate, start)[1]


def varied(w: Whitener) -> Array:
    """Whether each column [F] has varied, by more than rounding; the scale of one that has not is not known."""
    rounding = 16 * jnp.finfo(w.root.dtype).eps * jnp.abs(w.mean)
    return jnp.linalg.norm(w.root, axis=1) > jnp.maximum(rounding, 1.01e-6)  # 1e-6: the floor of `whitener`


def whiten(w: Whitener, rows: Array) -> Array:
    """White rows [..., F] of raw rows [..., F]."""
    return (rows - w.mean) @ w.inverse.T


def unwhiten(w: Whitener, rows: Array) -> Array:
    """Raw rows [..., F] of white rows [..., F]."""
    return w.mean + rows @ w.root.T
