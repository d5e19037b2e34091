"""The one network: an MLP, with multiplicative noise on its units, and what eq. 2 charges for weights and noise."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from pegasus_jax.checks import choice
from pegasus_jax.types import Array, Dropout, Key, Params, Prediction


def orthogonal(key: Key, shape: tuple[int, int], dtype: Any = jnp.float32) -> Array:
    """A matrix with orthonormal columns, or rows where there are fewer of these, uniformly distributed.

    That of jax.nn.initializers.orthogonal up to rounding, by Gram-Schmidt, twice for each column. In JAX 0.10 LAPACK's
    QR of a batch waits for threads that wait themselves, for ever where a CPU has two (as in jax-ml/jax#24219).
    """
    long, short = max(shape), min(shape)

    def add(basis: Array, column: tuple[Array, Array]) -> tuple[Array, None]:
        index, v = column
        for _ in range(2):
            v = v - basis @ (basis.T @ v)  # columns to come are zero
        return basis.at[:, index].set(v / jnp.linalg.norm(v)), None

    columns = jax.random.normal(key, (long, short), dtype).T
    basis, _ = jax.lax.scan(add, jnp.zeros((long, short), dtype), (jnp.arange(short), columns))
    return basis if shape[0] >= shape[1] else basis.T


INITIALIZERS: dict[str, Callable] = {"glorot": nn.initializers.glorot_normal(), "orthogonal": orthogonal}


@jax.custom_jvp
def silu(x: Array) -> Array:
    """x sigmoid(x). Differentiated, it leaves one array for the way back, its slope, where jax.nn.silu leaves three."""
    return nn.silu(x)


@silu.defjvp
def _silu_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (x,), (dx,) = primals, tangents
    s = nn.sigmoid(x)
    y = x * s
    return y, (s + y * (1 - s)) * dx


ACTIVATIONS: dict[str, Callable[[Array], Array]] = {"relu": nn.relu, "silu": silu, "tanh": nn.tanh}


def _small_uniform(key: jax.Array, shape: Sequence[int], dtype: object = None) -> Array:
    return jax.random.uniform(key, shape, minval=-0.01, maxval=0.01)  # as the authors' (docs/reference.md 4.1)


class MLP(nn.Module):
    """Dense layers with a nonlinearity between them; layer i sees its input times masks[i] (None: as it is)."""

    hidden: tuple[int, ...]
    outputs: int
    initializer: str = "glorot"
    activation: str = "relu"

    @nn.compact
    def __call__(self, x: Array, masks: Sequence[Array | None]) -> Array:
        """Outputs [..., outputs] for inputs x [..., F]; masks[i] broadcasts against layer i's input."""
        choice("initializer", self.initializer, INITIALIZERS)
        choice("activation", self.activation, ACTIVATIONS)
        kernel_init = INITIALIZERS[self.initializer]
        for i, width in enumerate((*self.hidden, self.outputs)):
            mask = masks[i]
            x = x if mask is None else x * mask
            kind: dict[str, Any] = dict(param_dtype=jnp.result_type(float), name=f"layer_{i}")
            x = nn.Dense(width, kernel_init=kernel_init, bias_init=_small_uniform, **kind)(x)
            if i < len(self.hidden):
                x = ACTIVATIONS[self.activation](x)
        return x


Masks = list[Array | None]  # what multiplies each layer's inputs [width]; None: nothing does

Head = Callable[[Array], Array]  # raw output [D] -> noise std as a fraction of the target's scale

HEADS: dict[str, Head] = {
    # At most a tenth of the target's scale, as in the authors' final code (docs/reference.md 4.5).
    "sigmoid": lambda raw: 0.1 * jax.nn.sigmoid(raw) + 1e-6,
    "softplus": lambda raw: jax.nn.softplus(raw) + 1e-6,
}


class Noisy(NamedTuple):
    """A distribution over networks; its parameters are {"network": weights, "noise": one entry a layer}."""

    init: Callable[[Key], dict[str, Params]]
    apply: Callable[[Params, Array, Masks], Any]  # (weights, inputs [..., F], masks) -> outputs [..., O]
    # (key, noise) -> masks [width] of one network; (key, noise, M) -> masks [M, width] of one a row
    sample: Callable[..., Masks]
    penalty: Callable[[dict[str, Params]], Array]  # KL of the noise + weight prior (docs/reference.md 4.4) [nats]


def noisy(
    *,
    features: int,
    hidden: tuple[int, ...],
    outputs: int,
    dropout: Dropout,
    kl_weight: float = 1.0,
    weight_decay: float = 1.0,
    activation: str = "relu",
    initializer: str = "glorot",
) -> Noisy:
    """Each layer but the first multiplies its input by noise of `dropout`; the network's own inputs carry none.

    `kl_weight` and `weight_decay` scale the KL of the noise and the Gaussian weight prior.
    """
    network = MLP(hidden, outputs, initializer, activation)
    kinds = (None, *(dropout for _ in hidden))
    widths = (features, *hidden)

    def init(key: Key) -> dict[str, Params]:
        net_key, *keys = jax.random.split(key, 1 + len(kinds))
        noise = tuple(k.init(kk, w) if k else {} for k, kk, w in zip(kinds, keys, widths, strict=True))
        return {"network": network.init(net_key, jnp.zeros(features), [None] * len(kinds)), "noise": noise}

    def sample(key: Key, params: Params, *rows: int) -> Masks:
        keys = jax.random.split(key, len(kinds))

        def mask(kind: Dropout | None, params: Params, key: Key, width: int) -> Array | None:
            # Base noise is independent over units, so that of M rows is that of one layer M times as wide.
            return kind.mask(params, kind.sample(key, math.prod(rows) * width).reshape(*rows, width)) if kind else None

        return [mask(*layer) for layer in zip(kinds, params, keys, widths, strict=True)]

    def penalty(params: dict[str, Params]) -> Array:
        kl = sum(k.kl(p) for k, p in zip(kinds, params["noise"], strict=True) if k)
        prior = jnp.zeros(())
        for i, (kind, noise) in enumerate(zip(kinds, params["noise"], strict=True)):
            layer = params["network"]["params"][f"layer_{i}"]
            retained = kind.decay(noise) if kind else jnp.ones(widths[i])
            prior += 0.5 * jnp.sum(retained * jnp.sum(layer["kernel"] ** 2, 1)) + 0.5 * jnp.sum(layer["bias"] ** 2)
        return kl_weight * kl + weight_decay * prior

    return Noisy(init, network.apply, sample, penalty)


def nll(predicted: Prediction, y: Array) -> Array:
    """-log likelihood a row of changes y [M, D], in raw units, without its 2 pi: the first term of eq. 2 by N."""
    return jnp.mean(jnp.sum(0.5 * ((y - predicted.mean) / predicted.std) ** 2 + jnp.log(predicted.std), -1))
