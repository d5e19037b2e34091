"""Linear algebra of the few dimensions of a robot's state, for particles."""

import jax
import jax.numpy as jnp

from pegasus_jax.types import Array


@jax.custom_jvp
def cholesky(cov: Array) -> Array:
    """Lower Cholesky factor of cov [D, D], unrolled over columns.

    For the few dimensions of a robot's state, a library call would cost more than the networks around it. Pivots are
    floored at 1e-7 of their variance, so a degenerate covariance gives a degenerate factor and finite gradients, never
    NaN.
    """
    return _factor(cov)[0]


@cholesky.defjvp
def _cholesky_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    """dL = L phi(L^-1 dS L^-T), where phi keeps the lower half and half of the diagonal (Murray 2016, eq. 8).

    In closed form, because the derivative of the elimination below, step by step, takes twice as long to compile. A
    floored pivot is a constant: its column is then linear in S, and phi keeps all of its place on the diagonal. What
    does not vary at all, as a control that waits since the start, has no slope there: it would be 1 / 0.
    """
    (cov,), (change,) = primals, tangents
    lower, inverse = _factor(cov)
    pivots = 1 / jnp.diagonal(inverse)
    floored = jnp.diagonal(lower) < pivots * (1 - 1e-5)
    keep = jnp.tril(jnp.ones_like(cov), -1) + jnp.diag(jnp.where(floored, 1.0, 0.5).astype(cov.dtype))
    keep = jnp.where(jnp.diagonal(cov) > 0, keep, 0)  # of columns
    return lower, (jnp.tril(lower, -1) + jnp.diag(pivots)) @ (keep * (inverse @ change @ inverse.T))


def _factor(cov: Array) -> tuple[Array, Array]:
    """The factor L and the inverse of L with its pivots: elimination turns the rows of (S, I) into (L', inverse)."""
    size = cov.shape[0]
    floor = 1e-7 * jnp.diagonal(cov) + jnp.finfo(cov.dtype).tiny ** 0.5
    rest, rows = jnp.concatenate([cov, jnp.eye(size, dtype=cov.dtype)], 1), []
    for j in range(size):  # rest holds row j and those after it
        row = rest[0] / jnp.sqrt(jnp.maximum(rest[0, j], floor[j]))
        rest = rest[1:] - row[j + 1 : size, None] * row
        rows.append(row)
    both = jnp.stack(rows)
    return jnp.triu(both[:, :size]).T, both[:, size:]


def mean_and_cov(x: Array) -> tuple[Array, Array]:
    """Mean [D] and unbiased covariance [D, D] of particles x [K, D]. Raises ValueError for fewer than 2."""
    if len(x) < 2:
        raise ValueError(f"x of shape {x.shape} is {len(x)} particles; a covariance, as of moment matching, needs 2")
    first = jax.lax.stop_gradient(x[0])  # so that what does not vary has a variance of 0, and none of rounding
    mean = first + jnp.mean(x - first, 0)
    centered = x - mean
    return mean, centered.T @ centered / (x.shape[0] - 1)


def standardize(z: Array) -> Array:
    """Draws z [..., K, D] with their sample mean made exactly 0 and sample covariance exactly I, over K.

    Raises ValueError where K <= D: so few draws have a singular covariance, and some directions would get no noise.
    """
    if z.shape[-2] <= z.shape[-1]:
        raise ValueError(
            f"{z.shape[-2]} particles are too few for standardized noise of {z.shape[-1]} dimensions; expected at least"
            f" {z.shape[-1] + 1}"
        )

    def one(z: Array) -> Array:
        mean, cov = mean_and_cov(z)
        return (z - mean) @ _factor(cov)[1].T

    return jnp.vectorize(one, signature="(k,d)->(k,d)")(z)
