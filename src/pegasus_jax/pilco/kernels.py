"""What the Gaussian-process models share: scaled data with unused rows masked, hyperparameters, and their penalty.

Everything here is in scaled units: inputs and targets have zero mean and unit variance over the rows in use, so a
length scale of 1 is the standard deviation of the data.
"""

from collections.abc import Callable
from functools import partial, wraps
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jax.scipy.linalg import solve_triangular

from pegasus_jax.math import gaussian
from pegasus_jax.math.angles import encode
from pegasus_jax.math.normalize import Whitener, varied, whiten, whitener
from pegasus_jax.types import Array, Dataset, Dynamics, Params

LEAST_NOISE = 1e-5  # in standard deviations of the targets


class Scaling(NamedTuple):
    """The maps between raw and scaled units; both are diagonal."""

    inputs: Whitener  # of (encoded state, control) [F]
    targets: Whitener  # of the change of state [E]


class Rows(NamedTuple):
    """A data set in scaled units; the rows not in use are zero."""

    x: Array  # [N, F] encoded state and control
    y: Array  # [E, N] change of state
    used: Array  # [N] bool
    size: Array  # [] rows in use, at least 1
    scaling: Scaling


class Hyper(NamedTuple):
    """Hyperparameters of E independent Gaussian processes."""

    lengthscale: Array  # [E, F]
    signal: Array  # [E] standard deviation of the function
    noise: Array  # [E] standard deviation of the observations around it


def inputs_of(x: Array, u: Array, angles: tuple[int, ...]) -> Array:
    """What the models regress on, [..., F]: the encoded state, then the control."""
    return jnp.concatenate([encode(x, angles), u], -1)


def rows_of(data: Dataset, angles: tuple[int, ...]) -> Rows:
    """The data set in scaled units. An input that has never varied is centered only: its scale is not known."""
    raw = inputs_of(data.x, data.u, angles)
    inputs, targets = (whitener(rows, data.size, full=False) for rows in (raw, data.y))
    scale = jnp.where(varied(inputs), jnp.diagonal(inputs.root), 1)
    inputs = Whitener(inputs.mean, jnp.diag(scale), jnp.diag(1 / scale))
    used = jnp.arange(raw.shape[0]) < data.size
    return Rows(
        jnp.where(used[:, None], whiten(inputs, raw), 0),
        jnp.where(used[:, None], whiten(targets, data.y), 0).T,
        used,
        jnp.maximum(data.size, 1).astype(raw.dtype),
        Scaling(inputs, targets),
    )


def start(outputs: int, features: int) -> dict[str, Array]:
    """The logarithms of the hyperparameters of the authors' start (docs/reference.md 6): 1, 1 and .1 of the data's
    standard deviations."""
    return {
        "log_lengthscale": jnp.zeros((outputs, features)),
        "log_signal": jnp.zeros(outputs),
        "log_noise": jnp.full(outputs, np.log(0.1)),
    }


def hyper(params: Params) -> Hyper:
    """The hyperparameters. The noise variance is bounded below by what the arithmetic can tell from zero.

    The bound, 100 machine epsilons of the signal's variance, keeps a kernel matrix of nearly equal rows positive
    definite: a signal-to-noise ratio of 290 in float32; in float64 it never matters beside the penalty. Where all
    targets are equal nothing else bounds signal and noise: the noise stays at LEAST_NOISE, and the penalty keeps the
    signal near it, before their squares underflow.
    """
    signal = jnp.exp(params["log_signal"])
    bound = 100 * jnp.finfo(signal.dtype).eps * signal**2
    noise = jnp.sqrt(jnp.maximum(jnp.exp(2 * params["log_noise"]) + bound, LEAST_NOISE**2))
    return Hyper(jnp.exp(params["log_lengthscale"]), signal, noise)


def penalty(h: Hyper) -> Array:
    """A wall around hyperparameters that no data justify (docs/reference.md 6), summed over outputs.

    Signal-to-noise ratios beyond 1000 or 1 / 1000, and length scales beyond 100 or 1 / 100 standard deviations of the
    data; nothing of it is felt inside.
    """
    noise = (jnp.log(h.signal / h.noise) / np.log(1000)) ** 30
    length = (jnp.log(h.lengthscale) / np.log(100)) ** 30
    return jnp.sum(noise) + jnp.sum(length)


def squared_distance(a: Array, b: Array) -> Array:
    """|a_i - b_j|^2 [N, M] of rows a [N, F] and b [M, F], by differences: float32 has no digits to cancel."""
    return sum((a[:, f, None] - b[None, :, f]) ** 2 for f in range(a.shape[1]))  # type: ignore[return-value]


def waves(phase: Array) -> Array:
    """Trigonometric features [..., 2m] of phases [..., m]: all cosines, then all sines."""
    return jnp.concatenate([jnp.cos(phase), jnp.sin(phase)], -1)


@custom_vmap
def inverse_root(matrix: Array) -> Array:
    """The inverse of the lower Cholesky factor of a positive definite matrix [N, N]; NaN if it is not.

    Many matrices are taken one after the other on a CPU: jaxlib 0.10 spreads a batch over the threads that run the
    program, waits for them in one of them, and now and then waits for ever. Not to be differentiated: the evidences
    know their gradients.
    """
    factor = jnp.linalg.cholesky(matrix)
    return solve_triangular(factor, jnp.eye(matrix.shape[0], dtype=matrix.dtype), lower=True)


@inverse_root.def_vmap
def _(axis_size: int, in_batched: list[bool], matrices: Array) -> tuple[Array, bool]:
    del axis_size, in_batched
    whole = jax.vmap(inverse_root.fun)
    return jax.lax.platform_dependent(matrices, cpu=partial(jax.lax.map, inverse_root), default=whole), True


def precise(dynamics: Dynamics) -> Dynamics:
    """A model that has moments, with products in full precision: a GPU's usual 10 bits are too few here."""

    def exact(function: Any) -> Callable[..., Any]:
        @wraps(function)
        def call(*arguments: Any) -> Any:
            with jax.default_matmul_precision("highest"):
                return function(*arguments)

        return call

    return dynamics._replace(**{name: exact(function) for name, function in dynamics._asdict().items() if function})


def in_raw_units(process: gaussian.Map, scaling: Scaling) -> gaussian.Map:
    """Moments of a model of scaled data as a map from raw inputs to raw changes of state."""
    inputs, targets = scaling
    return gaussian.chain(
        partial(gaussian.affine, matrix=inputs.inverse, offset=-inputs.inverse @ inputs.mean),
        process,
        partial(gaussian.affine, matrix=targets.root, offset=targets.mean),
    )
