"""A linear controller of the encoded state, saturated."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp

from pegasus_jax.math.gaussian import Image, Map, affine, chain
from pegasus_jax.policies.scaled import of_data
from pegasus_jax.types import Array, Dataset, Key, Params, Policy


def linear(
    *,
    encode: Callable[[Array], Array],
    features: int,
    controls: int,
    saturate: Callable[[Array], Array],
    saturate_moments: Map | None,
    waves: int = 0,
    scale: float = 0.1,
) -> Policy:
    """u [U] = saturate(weights [U, F] @ encode(x [D]) + bias [U]) (Deisenroth 2010, sec. 3.5.2).

    Initial weights are normal with standard deviation `scale`. `saturate_moments` is the moment form of `saturate`, or
    None where there is none: then the policy has no `moments`. The last `waves` features are sines and cosines.
    """

    def init(key: Key) -> Params:
        return {"weights": scale * jax.random.normal(key, (controls, features)), "bias": jnp.zeros(controls)}

    def apply(params: Params, noise: tuple, x: Array) -> Array:
        del noise
        return saturate(params["weights"] @ encode(x) + params["bias"])

    def adapt(params: Params, data: Dataset) -> Params:
        mean, scale = of_data(encode(data.x), data.size, waves=waves)
        weights = params["weights"] / scale
        return {"weights": weights, "bias": params["bias"] - weights @ mean}

    def moments(params: Params, mean: Array, cov: Array) -> Image:
        assert saturate_moments is not None
        return chain(partial(affine, matrix=params["weights"], offset=params["bias"]), saturate_moments)(mean, cov)

    return Policy(init, lambda key: (), apply, moments if saturate_moments else None, adapt)
