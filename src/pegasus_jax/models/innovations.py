"""A model fitted where only positions were measured: each is to be likely, given those before it."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax.math.angles import difference
from pegasus_jax.models.lagrangian import DEGREES_OF_FREEDOM, coordinates_of
from pegasus_jax.types import Array, Batch, Dataset, Dynamics, Key, Params, Prediction

WINDOW = 25  # rows along which a filter runs


class Gaussian(NamedTuple):
    """What a filter knows of a state."""

    mean: Array  # [D]
    cov: Array  # [D, D]


class Innovations(NamedTuple):
    """What a filter says of the positions measured at the ends of W consecutive rows."""

    error: Array  # [W, n] the measured positions less the predicted ones
    variance: Array  # [W, n] predicted for these
    nats: Array  # [W] negative log likelihood of the row's positions, given those before


class Context(NamedTuple):
    """What the loss needs to know of the data set as a whole."""

    data: Dataset
    rate_variance: Array  # [n]


def innovations(
    model: Dynamics, *, rates: tuple[int, ...], angles: tuple[int, ...], inputs: int, dt: float
) -> Dynamics:
    """The model, fitted to the positions of data whose n `rates` were computed from them.

    This is a prediction error method (Ljung 1999, chapter 7). An extended Kalman filter runs along windows of the data,
    with one draw of the model for each. The loss is the negative log likelihood of its innovations [nats a row]: the
    measured positions less the predicted ones. A fit to the computed rates would learn their errors, which come from
    the sensors' noise and from the polynomial. From its batch the loss takes only the number of rows: it draws windows
    of as many rows from the data that `prepare` keeps.

    The data's controls [N, `inputs` + 1] end with whether an episode begins in a row. Raises ValueError for a model
    without a `penalty`.
    """
    if (penalty := model.penalty) is None:
        raise ValueError("the model has no penalty; expected one, to be added to the likelihood of innovations")

    def plain(data: Dataset) -> Dataset:
        return data._replace(u=data.u[:, :inputs])

    def prepare(data: Dataset) -> Context:
        used = jnp.arange(len(data.x))[:, None] < data.size
        return Context(data, jnp.var(data.x[:, np.array(rates)], 0, where=used) + 1e-12)

    def loss(params: Params, key: Key, batch: Batch, context: Context) -> Array:
        window_key, draw_key = jax.random.split(key)
        drawn = windows(window_key, context.data, len(batch.x))
        posterior = model.posterior(params, plain(context.data))
        draws = jax.vmap(model.sample, (0, None))(jax.random.split(draw_key, len(drawn.x)), posterior)

        def of_window(draw: Params, rows: Batch) -> Array:
            predict, begins = partial(model.apply, posterior, draw), rows.u[:, inputs] > 0.5
            rows = rows._replace(u=rows.u[:, :inputs])
            return filtered(predict, rows, begins, context.rate_variance, rates=rates, angles=angles, dt=dt).nats

        return jnp.mean(jax.vmap(of_window)(draws, drawn)) + penalty(params) / context.data.size

    return model._replace(
        prepare=prepare,
        loss=loss,
        posterior=lambda params, data: model.posterior(params, plain(data)),
        penalty=None,
    )


def integrated(model: Dynamics, *, rates: tuple[int, ...], dt: float) -> Dynamics:
    """The model, in which positions are integrated: they change by the mean of a period's first and last rates.

    A network that predicts positions on their own, and is fitted to positions only, may use the entries of the rates
    for any number that helps to predict.
    """
    place = np.array(rates)

    def apply(posterior: Params, draw: Params, x: Array, u: Array) -> Prediction:
        predicted = model.apply(posterior, draw, x, u)
        positions = coordinates_of(len(x), rates)
        change = dt * (x[place] + predicted.mean[place] / 2)
        return predicted._replace(mean=predicted.mean.at[positions].set(change))

    return model._replace(apply=apply)


def windows(key: Key, data: Dataset, rows: int) -> Batch:
    """At least so many of the rows in use, as windows of consecutive rows [M, WINDOW, ...].

    The first row, where an episode begins, follows the last one: every row is drawn with the same probability.
    """
    first = jax.random.randint(key, (-(-rows // WINDOW), 1), 0, data.size)
    index: Array = (first + jnp.arange(WINDOW)) % jnp.maximum(data.size, 1)
    return Batch(*(jnp.asarray(values)[index] for values in (data.x, data.u, data.y)))


def filtered(
    predict: Callable[[Array, Array], Prediction],
    rows: Batch,
    begins: Array,
    rate_variance: Array,
    *,
    rates: tuple[int, ...],
    angles: tuple[int, ...],
    dt: float,
) -> Innovations:
    """The innovations of an extended Kalman filter along W consecutive rows, with `predict(x, u)` as its model.

    Their likelihood is Student's t, without its constant. The filter starts in the first row, and where an episode
    `begins` [W], at the measured positions and the computed rates with `rate_variance` [n]. Half of the variance that
    `predict` has for a change of position is sensor noise, which is in both of its ends. No gradient flows through the
    Jacobian of the model: that would take three times as long.
    """
    states, n, place = rows.x.shape[1], len(rates), np.array(rates)
    positions = coordinates_of(states, rates)

    def row(before: Gaussian, given: tuple[Batch, Array]) -> tuple[Gaussian, Innovations]:
        (x, u, y), begins = given
        mean = jnp.where(begins, x, before.mean)
        change, std = predict(mean, u)
        jacobian = jax.jacfwd(lambda x: predict(x, u).mean)(jax.lax.stop_gradient(mean))
        transition = jnp.eye(states, dtype=x.dtype) + jax.lax.stop_gradient(jacobian)
        sensor = std[positions] ** 2 / 2
        # An unknown force changes the rates, and by half a period of that the positions.
        process = (std**2).at[positions].set((dt / 2 * std[place]) ** 2)
        start = jnp.diag(jnp.zeros_like(x).at[place].set(rate_variance).at[positions].set(sensor))
        cov = transition @ jnp.where(begins, start, before.cov) @ transition.T + jnp.diag(process)
        predicted = Gaussian(mean + change, cov)
        error = difference(x + y, predicted.mean, angles)[positions]
        after, nats = updated(predicted, error, sensor)
        return after, Innovations(error, jnp.diag(cov)[positions] + sensor, nats)

    def updated(predicted: Gaussian, innovation: Array, sensor: Array) -> tuple[Gaussian, Array]:
        """The belief after the measured positions, one after the other, and the negative log likelihood of these."""
        (mean, cov), squares, log_std = predicted, 0.0, 0.0
        for i, entry in enumerate(positions):
            variance, error = cov[entry, entry] + sensor[i], innovation[i] - (mean - predicted.mean)[entry]
            gain = cov[entry] / variance
            left = cov - gain[:, None] * cov[entry]  # (I - K H) P
            # Joseph's form: rounding leaves no negative variance.
            cov = left - left[:, entry][:, None] * gain + sensor[i] * gain[:, None] * gain
            mean = mean + gain * error
            squares, log_std = squares + error**2 / variance, log_std + jnp.log(variance) / 2
        nats = log_std + (DEGREES_OF_FREEDOM + n) / 2 * jnp.log1p(squares / DEGREES_OF_FREEDOM)
        return Gaussian(mean, cov), nats

    unknown = Gaussian(jnp.zeros_like(rows.x[0]), jnp.zeros((states, states), rows.x.dtype))
    return jax.lax.scan(row, unknown, (rows, begins.at[0].set(True)))[1]
