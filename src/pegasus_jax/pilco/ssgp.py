"""Sparse-spectrum Gaussian-process dynamics: Bayesian linear regression on trained waves, the paper's PILCO."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax.math import gaussian
from pegasus_jax.math.normalize import unwhiten, whiten
from pegasus_jax.pilco import kernels
from pegasus_jax.pilco.kernels import Rows, Scaling
from pegasus_jax.types import Array, Batch, Dataset, Dynamics, Key, Params, Prediction


class Weights(NamedTuple):
    """The weights of E outputs given their data: Gaussian with this mean, and covariance root @ root.T."""

    mean: Array  # [E, 2m]
    root: Array  # [E, 2m, 2m] upper triangular


class Posterior(NamedTuple):
    """The model given its data, in scaled units."""

    frequencies: Array  # [E, m, F] rad per unit of scaled input
    weights: Weights
    cov: Array  # [E, 2m, 2m] of the weights
    noise: Array  # [E]
    scaling: Scaling


def ssgp(*, states: int, controls: int, angles: tuple[int, ...], points: int = 100) -> Dynamics:
    """A sparse-spectrum Gaussian process over (encoded state, control) [F + U] for each change of state [D].

    Each output is a weighted sum of the cosines and sines of `points` phases; the weights have independent Gaussian
    priors of variance signal^2 / points, and frequencies, length scales, signal and noise maximize the evidence
    (Lazaro-Gredilla et al. 2010, eq. 5 to 9). As in the authors' code (docs/reference.md 6), the spectral points are
    standard normal before length scales divide them, and their mean square is penalized: in likelihood units 2 / points
    of a standard normal prior, which holds back the frequencies that overfit. A draw is a vector of weights.
    """
    width = states + len(angles) + controls

    def init(key: Key) -> Params:
        return kernels.start(states, width) | {"points": jax.random.normal(key, (states, points, width))}

    def frequencies_of(params: Params) -> Array:
        return params["points"] / kernels.hyper(params).lengthscale[:, None]

    def loss(params: Params, key: Key, batch: Batch, rows: Rows) -> Array:
        """-(log evidence of the scaled targets) and both penalties [nats a row]."""
        del key, batch
        h = kernels.hyper(params)
        evidence = jax.vmap(log_evidence, (0, 0, 0, 0, None))(frequencies_of(params), h.signal, h.noise, rows.y, rows)
        high = jnp.sum(jnp.mean(jnp.sum(params["points"] ** 2, -1), -1))
        return (kernels.penalty(h) + high - jnp.sum(evidence)) / rows.size

    def posterior(params: Params, data: Dataset) -> Posterior:
        h, rows, frequencies = kernels.hyper(params), kernels.rows_of(data, angles), frequencies_of(params)
        weights = jax.vmap(weights_of, (0, 0, 0, 0, None))(frequencies, h.signal, h.noise, rows.y, rows)
        cov = weights.root @ jnp.swapaxes(weights.root, 1, 2)
        return Posterior(frequencies, weights, cov, h.noise, rows.scaling)

    def sample(key: Key, posterior: Posterior) -> Array:
        """Weights [E, 2m] of one function."""
        mean, root = posterior.weights
        return mean + jnp.einsum("eij,ej->ei", root, jax.random.normal(key, mean.shape, mean.dtype))

    def apply(posterior: Posterior, draw: Array, x: Array, u: Array) -> Prediction:
        inputs, targets = posterior.scaling
        z = whiten(inputs, kernels.inputs_of(x, u, angles))
        change = jnp.sum(kernels.waves(posterior.frequencies @ z) * draw, -1)
        return Prediction(unwhiten(targets, change), posterior.noise * jnp.diagonal(targets.root))

    def moments(posterior: Posterior, mean: Array, cov: Array) -> gaussian.Image:
        process = partial(
            gaussian.ssgp_moments,
            frequencies=posterior.frequencies,
            weight_mean=posterior.weights.mean,
            weight_cov=posterior.cov,
        )
        return kernels.in_raw_units(process, posterior.scaling)(mean, cov)

    whole = Dynamics(init, lambda data: kernels.rows_of(data, angles), loss, posterior, sample, apply, moments)
    return kernels.precise(whole)


def design(frequencies: Array, signal: Array, noise: Array, rows: Rows) -> tuple[Array, Array]:
    """Features [N, 2m] of standard normal weights in units of the noise, and the weights' posterior precision.

    The precision, I + features' features, has no eigenvalue below 1.
    """
    scale = signal / noise / frequencies.shape[0] ** 0.5
    features = jnp.where(rows.used[:, None], scale * kernels.waves(rows.x @ frequencies.T), 0)
    return features, features.T @ features + jnp.eye(features.shape[1], dtype=features.dtype)


def weights_of(frequencies: Array, signal: Array, noise: Array, y: Array, rows: Rows) -> Weights:
    """The weights of one output, of frequencies [m, F] and targets y [N]."""
    features, precision = design(frequencies, signal, noise, rows)
    scale = signal / frequencies.shape[0] ** 0.5
    root = kernels.inverse_root(precision)
    return Weights(scale * (root.T @ (root @ (features.T @ (y / noise)))), scale * root.T)


def log_evidence(frequencies: Array, signal: Array, noise: Array, y: Array, rows: Rows) -> Array:
    """log p(y | x) of one output (Lazaro-Gredilla et al. 2010, eq. 8).

    The quadratic form y' (noise^2 I + features features')^-1 y is taken as the least penalized square error: a sum of
    squares, where the usual difference cancels all digits when the noise is low. At its minimum the weights' own
    dependence on the hyperparameters is of no account, so no gradient need flow through their solution; and that of
    the determinant is written down, carried by a product that is zero.
    """
    features, precision = design(frequencies, signal, noise, rows)
    held = jax.lax.stop_gradient(precision)
    root = kernels.inverse_root(held)
    white = y / noise
    weights = jax.lax.stop_gradient(root.T @ (root @ (features.T @ white)))
    quadratic = jnp.sum((white - features @ weights) ** 2) + jnp.sum(weights**2)
    log_det = jnp.sum((root.T @ root) * (precision - held)) - 2 * jnp.sum(jnp.log(jnp.diagonal(root)))
    return -0.5 * (quadratic + log_det + rows.size * jnp.log(2 * np.pi * noise**2))
