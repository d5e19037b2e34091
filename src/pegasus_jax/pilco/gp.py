"""Exact Gaussian-process dynamics, one process for each dimension of the change of state (PILCO's model)."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax.math import gaussian
from pegasus_jax.math.normalize import unwhiten, whiten
from pegasus_jax.pilco import kernels
from pegasus_jax.pilco.kernels import Hyper, Rows, Scaling
from pegasus_jax.types import Array, Batch, Dataset, Dynamics, Key, Params, Prediction


class Posterior(NamedTuple):
    """The processes given their data, in scaled units."""

    hyper: Hyper
    x: Array  # [N, F]
    y: Array  # [E, N]
    used: Array  # [N] bool
    root: Array  # [E, N, N] inverse of the lower Cholesky factor of the kernel matrix with noise
    beta: Array  # [E, N] inverse @ y
    inverse: Array  # [E, N, N] of the kernel matrix with noise; zero where a row is not in use
    scaling: Scaling


class Draw(NamedTuple):
    """One function: a sum of waves, drawn from the prior, plus the kernel functions that correct it to the data."""

    frequencies: Array  # [E, m, F] rad per unit of scaled input
    weights: Array  # [E, 2m] cosines first
    correction: Array  # [E, N]


def gp(*, states: int, controls: int, angles: tuple[int, ...], features: int = 200) -> Dynamics:
    """A Gaussian process over (encoded state, control) [F + U] for each dimension of the change of state [D].

    ARD squared exponential kernels; hyperparameters and noise by marginal likelihood (Rasmussen & Williams 2006, ch. 2
    and 5). A draw is a function, by pathwise conditioning (Wilson et al. 2020, eq. 13): a prior sample from random
    Fourier features (Rahimi & Recht 2008), `features` sines and cosines in all, plus its exact update by the data.
    The frequencies are drawn anew for every function, so mean and covariance of the draws are the posterior's whatever
    the number of features; only the draws' shape, a mixture of Gaussians, approaches a Gaussian as it grows.
    """
    width = states + len(angles) + controls
    half = features // 2

    def init(key: Key) -> Params:
        """The authors' start, its length scales spread so that the best of several starts is worth having."""
        params = kernels.start(states, width)
        return params | {"log_lengthscale": 0.5 * jax.random.normal(key, (states, width)) + np.log(2)}

    def loss(params: Params, key: Key, batch: Batch, rows: Rows) -> Array:
        """-(log marginal likelihood of the scaled targets) and the hyperparameters' penalty [nats a row]."""
        del key, batch
        h = kernels.hyper(params)
        return (kernels.penalty(h) - jnp.sum(log_evidence(h, rows))) / rows.size

    def posterior(params: Params, data: Dataset) -> Posterior:
        h, rows = kernels.hyper(params), kernels.rows_of(data, angles)
        root = jax.vmap(kernels.inverse_root)(gram(h, rows.x, rows.used))
        inverse = jnp.where(rows.used[:, None] & rows.used, jnp.swapaxes(root, 1, 2) @ root, 0)
        return Posterior(h, rows.x, rows.y, rows.used, root, solve(root, rows.y), inverse, rows.scaling)

    def sample(key: Key, posterior: Posterior) -> Draw:
        h, dtype = posterior.hyper, posterior.x.dtype
        wave_key, weight_key, noise_key = jax.random.split(key, 3)
        frequencies = jax.random.normal(wave_key, (states, half, width), dtype) / h.lengthscale[:, None]
        weights = h.signal[:, None] / half**0.5 * jax.random.normal(weight_key, (states, 2 * half), dtype)
        noise = h.noise[:, None] * jax.random.normal(noise_key, posterior.y.shape, dtype)
        # One output after the other: with many particles the features of all rows at once would fill the memory.
        prior = jax.lax.map(lambda wave: kernels.waves(posterior.x @ wave[0].T) @ wave[1], (frequencies, weights))
        residual = jnp.where(posterior.used, posterior.y - prior - noise, 0)
        return Draw(frequencies, weights, solve(posterior.root, residual))

    def apply(posterior: Posterior, draw: Draw, x: Array, u: Array) -> Prediction:
        h, scaling = posterior.hyper, posterior.scaling
        z = whiten(scaling.inputs, kernels.inputs_of(x, u, angles))
        prior = jnp.einsum("em,em->e", kernels.waves(draw.frequencies @ z), draw.weights)
        # Not a product and a sum: of 200 rows and more, jaxlib 0.10 compiles those two into wrong numbers on a CPU.
        update = jnp.einsum("en,en->e", cross(h, z, posterior.x), draw.correction)
        return Prediction(unwhiten(scaling.targets, prior + update), h.noise * jnp.diagonal(scaling.targets.root))

    def moments(posterior: Posterior, mean: Array, cov: Array) -> gaussian.Image:
        """PILCO's analytic moments. In float32 the means are good; the variances are not, and stop at 0."""
        h = posterior.hyper
        process = partial(
            gaussian.rbf_moments,
            inputs=posterior.x,
            beta=posterior.beta,
            inverse_gram=posterior.inverse,
            lengthscales=h.lengthscale,
            variance=h.signal**2,
        )
        image = kernels.in_raw_units(process, posterior.scaling)(mean, cov)
        return image._replace(cov=image.cov + jnp.diag(jnp.maximum(-jnp.diagonal(image.cov), 0)))

    whole = Dynamics(init, lambda data: kernels.rows_of(data, angles), loss, posterior, sample, apply, moments)
    return kernels.precise(whole)


def gram(h: Hyper, x: Array, used: Array) -> Array:
    """Kernel matrices with noise [E, N, N] of rows x [N, F]; a row not in use is one of the identity."""
    own = jnp.eye(x.shape[0], dtype=bool)

    def one(lengthscale: Array, signal: Array, noise: Array) -> Array:
        scaled = x / lengthscale
        k = signal**2 * jnp.exp(-0.5 * kernels.squared_distance(scaled, scaled))
        return jnp.where(used[:, None] & used, k + noise**2 * own, own)

    return jax.vmap(one)(*h)


def cross(h: Hyper, z: Array, x: Array) -> Array:
    """Kernel values [E, N] between one input z [F] and rows x [N, F]."""

    def one(lengthscale: Array, signal: Array) -> Array:
        return signal**2 * jnp.exp(-0.5 * kernels.squared_distance((z / lengthscale)[None], x / lengthscale)[0])

    return jax.vmap(one)(h.lengthscale, h.signal)


def solve(root: Array, y: Array) -> Array:
    """(root' root) y for each output: root [E, N, N], y [E, N]."""
    return jnp.einsum("eji,ej->ei", root, jnp.einsum("eij,ej->ei", root, y))


def log_evidence(h: Hyper, rows: Rows) -> Array:
    """log p(y | x) of the scaled targets of each output [E] (Rasmussen & Williams 2006, eq. 2.30).

    Its derivative by the kernel matrix (eq. 5.9) is written down, not left to the derivative of a Cholesky factor: a
    product that is zero carries it.
    """
    k = gram(h, rows.x, rows.used)
    held = jax.lax.stop_gradient(k)
    root = jax.vmap(kernels.inverse_root)(held)
    white = jnp.einsum("eij,ej->ei", root, rows.y)
    beta = jnp.einsum("eji,ej->ei", root, white)
    half_log_det = -jnp.sum(jnp.log(jnp.diagonal(root, axis1=1, axis2=2)), -1)
    slope = 0.5 * (beta[:, :, None] * beta[:, None, :] - jnp.swapaxes(root, 1, 2) @ root)
    value = -0.5 * jnp.sum(white**2, -1) - half_log_det - 0.5 * rows.size * np.log(2 * np.pi)
    return value + jnp.sum(slope * (k - held), (1, 2))
