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
    draws: int,
) -> tuple[Array, Array]:
    """Errors of the model's mean along an episode, and the variances that it predicts for them: each [H, D].

    The predictive variance is that of the draws' means, what the model does not know, and the mean square of their
    noise.
    """

    def along(function: Params) -> tuple[Array, Array]:
        predicted = jax.vmap(partial(dynamics.apply, posterior, function))(trajectory.x[:-1], trajectory.u)
        return predicted.mean, predicted.std**2

    mean, variance = over_draws(along, key, posterior, dynamics=dynamics, draws=draws)
    return difference(difference(trajectory.x[1:], trajectory.x[:-1], angles), mean, angles), variance


def filtered_errors(
    key: Key,
    posterior: Params,
    trajectory: Trajectory,
    *,
    dynamics: Dynamics,
    angles: tuple[int, ...],
    rates: tuple[int, ...],
    dt: float,
    draws: int,
) -> tuple[Array, Array]:
    """As `one_step_errors`, where only the positions [n] were measured, and `rates` computed from them: each [H, n].

    A model predicts a position from all those before it, through a filter. Computed rates have errors of their own,
    which are not the model's.
    """
    x, u = trajectory.x, trajectory.u
    spread = jnp.var(x[:-1, np.array(rates)], 0, where=ran(trajectory)[:, None]) + 1e-12
    rows, begins = Batch(x[:-1], u, difference(x[1:], x[:-1], angles)), jnp.zeros(len(u), bool)

    def along(function: Params) -> tuple[Array, Array]:
        predict = partial(dynamics.apply, posterior, function)
        found = filtered(predict, rows, begins, spread, rates=rates, angles=angles, dt=dt)
        return found.error, found.variance

    return over_draws(along, key, posterior, dynamics=dynamics, draws=draws)


def over_draws(
    along: Callable[[Params], tuple[Array, Array]], key: Key, posterior: Params, *, dynamics: Dynamics, draws: int
) -> tuple[Array, Array]:
    """Mean and variance over draws of the model, of each of which `along` tells a mean and a variance."""
    functions = jax.vmap(dynamics.sample, (0, None))(jax.random.split(key, draws), posterior)
    mean, variance = jax.vmap(along)(functions)
    return jnp.mean(mean, 0), jnp.var(mean, axis=0, ddof=1) + jnp.mean(variance, axis=0)


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
