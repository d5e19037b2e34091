"""A radial basis function controller: the mean of a Gaussian process through trainable points, as in PILCO."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp

from pegasus_jax.math.gaussian import Image, Map, chain, rbf_moments
from pegasus_jax.policies.scaled import of_data
from pegasus_jax.types import Array, Dataset, Key, Params, Policy

# Variance of the targets' noise, for a signal of variance 1; both fixed. The originals' .01 is a standard deviation
# (docs/reference.md 5.1), which makes weights of thousands that cancel: more than float32 can hold, and no better.
NOISE = 0.01


def rbf(
    *,
    encode: Callable[[Array], Array],
    start: Callable[[Key], Array],
    waves: int,
    controls: int,
    num_centers: int,
    saturate: Callable[[Array], Array],
    saturate_moments: Map | None,
) -> Policy:
    """u [U] = saturate(k(encode(x [D]), centres) beta), beta = (K + noise I)^-1 targets (docs/reference.md 5.1).

    Every control has targets and length scales of its own; the centres are shared. `start` draws the states at which
    the centres begin, the last `waves` features of `encode` are sines and cosines. `saturate_moments` is the moment
    form of `saturate`, or None where there is none: then the policy has no `moments`.
    """

    def init(key: Key) -> Params:
        centre_key, target_key = jax.random.split(key)
        centres = jax.vmap(lambda k: encode(start(k)))(jax.random.split(centre_key, num_centers))
        features = centres.shape[1]
        lengthscales = jnp.where(jnp.arange(features) < features - waves, 1.0, 0.7).astype(centres.dtype)
        return {
            "centres": centres,  # [n, F]
            "targets": 0.1**0.5 * jax.random.normal(target_key, (controls, num_centers), centres.dtype),  # [U, n]
            "lengthscales": jnp.tile(jnp.log(jnp.expm1(lengthscales)), (controls, 1)),  # [U, F], before softplus
        }

    def apply(params: Params, noise: tuple, x: Array) -> Array:
        del noise
        lengthscales, beta = regress(params)
        return saturate(jnp.sum(kernel(encode(x), params["centres"], lengthscales) * beta, -1))

    def adapt(params: Params, data: Dataset) -> Params:
        scale = of_data(encode(data.x), data.size, waves=waves).scale
        before = scale + jnp.log(-jnp.expm1(-scale))  # a length scale of the data's own size, before softplus
        return params | {"lengthscales": jnp.where(scale == 1, params["lengthscales"], before)}

    def moments(params: Params, mean: Array, cov: Array) -> Image:
        lengthscales, beta = regress(params)
        mixture = partial(
            rbf_moments,
            inputs=params["centres"],
            beta=beta,
            inverse_gram=None,
            lengthscales=lengthscales,
            variance=jnp.ones(controls, mean.dtype),
        )
        assert saturate_moments is not None
        return chain(mixture, saturate_moments)(mean, cov)

    return Policy(init, lambda key: (), apply, moments if saturate_moments else None, adapt)


def regress(params: Params) -> tuple[Array, Array]:
    """Length scales [U, F] and the weights beta [U, n] of the functions through (centres, targets)."""
    centres, targets = params["centres"], params["targets"]
    lengthscales = jax.nn.softplus(params["lengthscales"])
    gram = kernel(centres, centres, lengthscales)  # [n, U, n]
    noisy = jnp.moveaxis(gram, 1, 0) + NOISE * jnp.eye(centres.shape[0], dtype=centres.dtype)
    solve = jax.vmap(partial(jax.scipy.linalg.solve, assume_a="pos"))
    return lengthscales, solve(noisy, targets)


def kernel(point: Array, centres: Array, lengthscales: Array) -> Array:
    """ARD squared exponential of unit variance: point [..., F], centres [n, F], lengthscales [U, F] -> [..., U, n]."""
    scaled = (point[..., None, None, :] - centres) / lengthscales[:, None, :]
    return jnp.exp(-0.5 * jnp.sum(scaled**2, -1))
