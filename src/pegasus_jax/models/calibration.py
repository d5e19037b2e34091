"""How well a model predicts the size of its errors, measured along an episode that it has not seen."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax.math.angles import difference
from pegasus_jax.models.innovations import filtered
from pegasus_jax.types import Array, Batch, Dynamics, Key, Params, Trajectory

DRAWS = 50  # of the model at every step
HALF = 0.6744897501960817  # half of a standard normal's draws are nearer to zero than this


def one_step_errors(
    key: Key,
    posterior: Params,
    trajectory: Trajectory,
    *,
    dynamics: Dynamics,
    angles: tuple[int, ...],
    draws: int = DRAWS,
) -> tuple[Array, Array]:
    """Errors of the model's mean along an episode, and the variances that it predicts for them: each [H, D].

    The predictive variance is that of the draws' means, what the model does not know, and the mean square of their
    noise.
    """
    functions = jax.vmap(dynamics.sample, (0, None))(jax.random.split(key, draws), posterior)
    along = jax.vmap(dynamics.apply, (None, None, 0, 0))
    predicted = jax.vmap(along, (None, 0, None, None))(posterior, functions, trajectory.x[:-1], trajectory.u)
    variance = jnp.var(predicted.mean, axis=0, ddof=1) + jnp.mean(predicted.std**2, axis=0)
    error = difference(difference(trajectory.x[1:], trajectory.x[:-1], angles), jnp.mean(predicted.mean, 0), angles)
    return error, variance


def filtered_errors(
    key: Key,
    posterior: Params,
    trajectory: Trajectory,
    *,
    dynamics: Dynamics,
    angles: tuple[int, ...],
    rates: tuple[int, ...],
    dt: float,
    draws: int = DRAWS,
) -> tuple[Array, Array]:
    """As `one_step_errors`, where only the positions [n] were measured, and `rates` computed from them: each [H, n].

    A model predicts a position from all those before it, through a filter. Computed rates have errors of their own,
    which are not the model's.
    """
    x, u = trajectory.x, trajectory.u
    functions = jax.vmap(dynamics.sample, (0, None))(jax.random.split(key, draws), posterior)
    spread = jnp.var(x[:-1, np.array(rates)], 0, where=ran(trajectory)[:, None]) + 1e-12
    rows, begins = Batch(x[:-1], u, difference(x[1:], x[:-1], angles)), jnp.zeros(len(u), bool)

    def along(function: Params) -> tuple[Array, Array]:
        predict = partial(dynamics.apply, posterior, function)
        found = filtered(predict, rows, begins, spread, rates=rates, angles=angles, dt=dt)
        return found.error, found.variance

    error, variance = jax.vmap(along)(functions)
    return jnp.mean(error, 0), jnp.var(error, axis=0, ddof=1) + jnp.mean(variance, axis=0)


def ran(trajectory: Trajectory) -> Array:
    """Which periods of an episode took place [H]."""
    periods = len(trajectory.u)
    return jnp.arange(periods) < (periods if trajectory.length is None else trajectory.length)


def calibration(
    key: Key,
    posterior: Params,
    trajectory: Trajectory,
    *,
    dynamics: Dynamics,
    angles: tuple[int, ...],
    draws: int = DRAWS,
    errors: Callable[..., tuple[Array, Array]] = one_step_errors,
) -> Array:
    """The model's one-step errors along an episode, in standard deviations that it predicted.

    `errors` is `one_step_errors`, or a function like it. 1 is calibrated; at 2 errors are twice as large as the model
    claims. The root of the median, over steps and dimensions, of squared error / predictive variance, divided by its
    value for Gaussian errors of the predicted size; the median, because a few steps outside the data would decide a
    mean.
    """
    error, variance = errors(key, posterior, trajectory, dynamics=dynamics, angles=angles, draws=draws)
    took_place = ran(trajectory)[:, None]
    ratio = error**2 / variance
    # A prediction of NaN gives NaN, while 0 / 0, of what is known exactly, is left out of the median like absent rows.
    known = ~jnp.any((jnp.isnan(error) | jnp.isnan(variance)) & took_place)
    return jnp.sqrt(jnp.nanmedian(jnp.where(took_place & known, ratio, jnp.nan))) / HALF
