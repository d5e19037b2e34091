"""Bayesian neural network dynamics: a network with multiplicative noise on its units (paper, sections IV-A and V-C)."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from pegasus_jax.angles import encode
from pegasus_jax.network import MLP
from pegasus_jax.types import Array, Batch, Dataset, Dropout, Dynamics, Key, Params, Prediction
from pegasus_jax.whiten import Whitener, unwhiten, whiten, whitener


class Scaling(NamedTuple):
    """What the network needs to know of the data as a whole."""

    inputs: Whitener  # of (encoded state, control) [F + U]
    targets: Whitener  # of the change of state [D]
    size: Array  # [] rows the statistics come from


class Belief(NamedTuple):
    """A fitted network whose outer layers contain the scaling, so that a rollout does not repeat it at each step."""

    network: Params  # centred inputs (white ones, where they carry noise) -> change of state [D], raw std [D]
    raw_std: Array | None  # [D], of a network that does not predict it
    noise: Params
    scaling: Scaling


Head = Callable[[Array], Array]  # raw output [D] -> noise std as a fraction of the target's scale

HEADS: dict[str, Head] = {
    # At most a tenth of the target's scale, as in the authors' final code (docs/reference.md 4.5).
    "sigmoid": lambda raw: 0.1 * jax.nn.sigmoid(raw) + 1e-6,
    "softplus": lambda raw: jax.nn.softplus(raw) + 1e-6,
}


def bnn(
    *,
    states: int,
    controls: int,
    angles: tuple[int, ...],
    hidden: tuple[int, ...],
    dropout: Dropout,
    input_dropout: Dropout | None,
    head: Head,
    heteroscedastic: bool,
    full_whitening: bool,
    kl_weight: float = 1.0,
    weight_decay: float = 1.0,
    activation: str = "relu",
    initialiser: str = "glorot",
) -> Dynamics:
    """A BNN over (encoded state, control) -> change of state [D], with its noise std [D].

    Layer i multiplies its input by noise of `dropout`; the network's own inputs carry `input_dropout`, or none. With
    `heteroscedastic` the noise std is a function of the input, otherwise one vector of parameters. `kl_weight`
    and `weight_decay` scale the KL of the noise and the Gaussian weight prior (docs/reference.md 4.4).
    """
    features = states + len(angles) + controls
    network = MLP(hidden, states * (2 if heteroscedastic else 1), initialiser, activation)
    kinds = (input_dropout, *(dropout for _ in hidden))
    widths = (features, *hidden)

    def init(key: Key) -> Params:
        net_key, *keys = jax.random.split(key, 1 + len(kinds))
        noise = tuple(k.init(kk, w) if k else {} for k, kk, w in zip(kinds, keys, widths, strict=True))
        net = network.init(net_key, jnp.zeros(features), [None] * len(kinds))
        raw_std = {} if heteroscedastic else {"raw_std": jnp.zeros(states)}
        return {"network": net, "noise": noise, **raw_std}

    def inputs_of(x: Array, u: Array) -> Array:
        return jnp.concatenate([encode(x, angles), u], -1)

    def prepare(data: Dataset) -> Scaling:
        return Scaling(
            whitener(inputs_of(data.x, data.u), data.size, full=full_whitening),
            whitener(data.y, data.size, full=full_whitening),
            data.size,
        )

    def masks_of(params: tuple, noise: tuple) -> list[Array | None]:
        return [k.mask(p, z) if k else None for k, p, z in zip(kinds, params, noise, strict=True)]

    def believe(params: Params, scaling: Scaling) -> Belief:
        layers = dict(params["network"]["params"])
        if not input_dropout:
            layers["layer_0"] = {**layers["layer_0"], "kernel": scaling.inputs.inverse.T @ layers["layer_0"]["kernel"]}
        last, targets = layers[f"layer_{len(hidden)}"], scaling.targets
        kernel, bias = last["kernel"], last["bias"]
        layers[f"layer_{len(hidden)}"] = {
            "kernel": jnp.concatenate([kernel[:, :states] @ targets.root.T, kernel[:, states:]], 1),
            "bias": jnp.concatenate([unwhiten(targets, bias[:states]), bias[states:]]),
        }
        return Belief({"params": layers}, params.get("raw_std"), params["noise"], scaling)

    def predict(belief: Belief, masks: list[Array | None], x: Array, u: Array) -> Prediction:
        inputs, scaling = inputs_of(x, u), belief.scaling
        inputs = whiten(scaling.inputs, inputs) if input_dropout else inputs - scaling.inputs.mean
        out: Any = network.apply(belief.network, inputs, masks)
        mean, raw = out[..., :states], out[..., states:]
        if belief.raw_std is not None:
            raw = jnp.broadcast_to(belief.raw_std, mean.shape)
        return Prediction(mean, head(raw) * jnp.diagonal(scaling.targets.root))

    def loss(params: Params, key: Key, batch: Batch, scaling: Scaling) -> Array:
        """-log likelihood a row, in raw units, + (KL of the noise + weight prior) / N: eq. 2 divided by N."""
        rows = batch.x.shape[0]
        keys = jax.random.split(key, len(kinds))
        # Base noise is independent over units, so that of M rows is that of one layer M times as wide.
        noise = tuple(
            k.sample(kk, rows * w).reshape(rows, w) if k else None for k, kk, w in zip(kinds, keys, widths, strict=True)
        )
        mean, std = predict(believe(params, scaling), masks_of(params["noise"], noise), batch.x, batch.u)
        misfit = jnp.sum(0.5 * ((batch.y - mean) / std) ** 2 + jnp.log(std), -1)
        return jnp.mean(misfit) + penalty(params) / scaling.size

    def penalty(params: Params) -> Array:
        kl = sum(k.kl(p) for k, p in zip(kinds, params["noise"], strict=True) if k)
        prior = jnp.zeros(())
        for i, (kind, noise) in enumerate(zip(kinds, params["noise"], strict=True)):
            layer = params["network"]["params"][f"layer_{i}"]
            retained = kind.decay(noise) if kind else jnp.ones(widths[i])
            prior += 0.5 * jnp.sum(retained * jnp.sum(layer["kernel"] ** 2, 1)) + 0.5 * jnp.sum(layer["bias"] ** 2)
        return kl_weight * kl + weight_decay * prior

    def sample(key: Key, belief: Belief) -> list[Array | None]:
        """The masks of one particle, w^(k) = g_2(w, z_w^(k)) (Alg. 3 line 9): all that differs between particles."""
        keys = jax.random.split(key, len(kinds))
        noise = tuple(k.sample(kk, w) if k else None for k, kk, w in zip(kinds, keys, widths, strict=True))
        return masks_of(belief.noise, noise)

    return Dynamics(
        init=init,
        prepare=prepare,
        loss=loss,
        condition=lambda params, data: believe(params, prepare(data)),
        sample=sample,
        apply=predict,
    )
