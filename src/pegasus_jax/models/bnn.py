"""Bayesian neural network dynamics: a network with multiplicative noise on its units (paper, sections IV-A and V-C)."""

from typing import Any, NamedTuple

import jax.numpy as jnp

from pegasus_jax.math.angles import encode
from pegasus_jax.math.normalize import Whitener, unwhiten, varied, whitener
from pegasus_jax.models.networks import HEADS, Head, Masks, nll, noisy
from pegasus_jax.types import Array, Batch, Dataset, Dynamics, Key, Params, Prediction


class Scaling(NamedTuple):
    """What the network needs to know of the data as a whole."""

    inputs: Whitener  # of (encoded state, control) [F + U]
    targets: Whitener  # of the change of state [D]
    size: Array  # [] rows the statistics come from


class Posterior(NamedTuple):
    """A fitted network whose outer layers contain the scaling, so that a rollout does not repeat it at each step."""

    network: Params  # centered inputs -> change of state [D], raw std [D]
    raw_std: Array | None  # [D], of a network that does not predict it
    noise: Params
    scaling: Scaling


def bnn(
    *,
    states: int,
    controls: int,
    angles: tuple[int, ...],
    hidden: tuple[int, ...],
    heteroscedastic: bool,
    head: Head = HEADS["sigmoid"],
    **noise: Any,
) -> Dynamics:
    """A BNN over (encoded state, control) -> change of state [D], with its noise std [D].

    With `heteroscedastic` the noise std is a function of the input, otherwise one vector of parameters. `hidden`
    and `noise` describe the network, as `noisy` has them.
    """
    features = states + len(angles) + controls
    outputs = states * (2 if heteroscedastic else 1)
    network = noisy(features=features, hidden=hidden, outputs=outputs, **noise)

    def init(key: Key) -> Params:
        return network.init(key) | ({} if heteroscedastic else {"raw_std": jnp.zeros(states)})

    def inputs_of(x: Array, u: Array) -> Array:
        return jnp.concatenate([encode(x, angles), u], -1)

    def prepare(data: Dataset) -> Scaling:
        inputs = whitener(inputs_of(data.x, data.u), data.size)
        # An input that has never varied is ignored: scaled by rounding errors, a small change of it would be thousands.
        inputs = inputs._replace(inverse=jnp.where(varied(inputs), inputs.inverse, 0))
        return Scaling(inputs, whitener(data.y, data.size), data.size)

    def believe(params: Params, scaling: Scaling) -> Posterior:
        layers = dict(params["network"]["params"])
        layers["layer_0"] = {**layers["layer_0"], "kernel": scaling.inputs.inverse.T @ layers["layer_0"]["kernel"]}
        last, targets = layers[f"layer_{len(hidden)}"], scaling.targets
        kernel, bias = last["kernel"], last["bias"]
        layers[f"layer_{len(hidden)}"] = {
            "kernel": jnp.concatenate([kernel[:, :states] @ targets.root.T, kernel[:, states:]], 1),
            "bias": jnp.concatenate([unwhiten(targets, bias[:states]), bias[states:]]),
        }
        return Posterior({"params": layers}, params.get("raw_std"), params["noise"], scaling)

    def predict(posterior: Posterior, masks: Masks, x: Array, u: Array) -> Prediction:
        inputs, scaling = inputs_of(x, u), posterior.scaling
        out = network.apply(posterior.network, inputs - scaling.inputs.mean, masks)
        mean, raw = out[..., :states], out[..., states:]
        if posterior.raw_std is not None:
            raw = jnp.broadcast_to(posterior.raw_std, mean.shape)
        return Prediction(mean, head(raw) * jnp.diagonal(scaling.targets.root))

    def loss(params: Params, key: Key, batch: Batch, scaling: Scaling) -> Array:
        """Eq. 2 divided by N, with fresh noise for every row."""
        masks = network.sample(key, params["noise"], batch.x.shape[0])
        predicted = predict(believe(params, scaling), masks, batch.x, batch.u)
        return nll(predicted, batch.y) + network.penalty(params) / scaling.size

    return Dynamics(
        init=init,
        prepare=prepare,
        loss=loss,
        posterior=lambda params, data: believe(params, prepare(data)),
        # The masks of one particle, w^(k) = g_2(w, z_w^(k)) (Alg. 3 line 9): all that differs between particles.
        sample=lambda key, posterior: network.sample(key, posterior.noise),
        apply=predict,
        penalty=network.penalty,
    )
