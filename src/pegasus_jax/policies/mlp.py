"""A ReLU network controller, with multiplicative noise on its hidden units or without."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from pegasus_jax.models.networks import MLP
from pegasus_jax.policies.scaled import in_units, of_data, scaled
from pegasus_jax.types import Array, Dataset, Dropout, Key, Params, Policy


def mlp(
    *,
    encode: Callable[[Array], Array],
    features: int,
    controls: int,
    hidden: tuple[int, ...],
    dropout: Dropout,
    saturate: Callable[[Array], Array],
    initializer: str,
    waves: int = 0,
    input_scale: Array | float = 1.0,
    units: Array | float = 1.0,
    find_units: bool = False,
    output_scale: float = 1.0,
) -> Policy:
    """u [U] = saturate(network(encode(x [D]) * input_scale)); noise on hidden layers' outputs (docs/reference.md 5.1).

    A fresh network divides each input by its unit [F], and what the data have large or small is standardized, but for
    the last `waves`, which are sines and cosines; with `find_units` the units of all are found in the data: see
    `scaled`. They are kept with the parameters. The outgoing weights begin `output_scale` times as large as usual: a
    small one begins with controls near the middle of their range.
    """
    network = MLP(hidden, controls, initializer)

    def init(key: Key) -> Params:
        net_key, *keys = jax.random.split(key, 1 + len(hidden))
        net: Any = network.init(net_key, jnp.zeros(features), [None] * (len(hidden) + 1))
        if output_scale != 1:
            last = f"layer_{len(hidden)}"
            net["params"][last]["kernel"] *= output_scale
        noise = tuple(dropout.init(k, w) for k, w in zip(keys, hidden, strict=True))
        return {"network": net, "noise": noise, "input": in_units(jnp.ones(features) * units)}

    def adapt(params: Params, data: Dataset) -> Params:
        return params | {"input": of_data(encode(data.x) * input_scale, data.size, units, find_units, waves)}

    def sample(key: Key) -> tuple[Array, ...]:
        keys = jax.random.split(key, len(hidden))
        return tuple(dropout.sample(k, w) for k, w in zip(keys, hidden, strict=True))

    def apply(params: Params, noise: tuple[Array, ...] | None, x: Array) -> Array:
        """u [U]; noise None is the mean policy, every unit at its expected size."""
        if noise is None:
            masks = [dropout.retain(p) for p in params["noise"]]
        else:
            masks = [dropout.mask(p, z) for p, z in zip(params["noise"], noise, strict=True)]
        inputs = scaled(params["input"], encode(x) * input_scale)
        out: Any = network.apply(params["network"], inputs, [None, *masks])
        return saturate(out)

    return Policy(init, sample, apply, adapt=adapt)
