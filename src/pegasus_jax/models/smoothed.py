"""A model fitted where only positions were measured: between its updates it draws the rates that explain them."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax.math.angles import difference
from pegasus_jax.types import Array, Batch, Dataset, Dynamics, Key, ModelLearner, Params

DRAWS = 4  # of the model, whose spread is part of what it does not know
ROUND = 50  # updates of the model from one draw of the rates to the next
WARM = 0.1  # part of a fit that takes the rates as they are: a model that knows nothing explains nothing
FARTHEST = 3.0  # deviations of all rates, by which a rate is corrected at most
JITTER = 1e-5  # of a correlation matrix


class Gaussian(NamedTuple):
    """A belief about a state, as a deviation from the present estimate."""

    mean: Array  # [..., D]
    cov: Array  # [..., D, D]


def corrected(model: Dynamics, *, rates: tuple[int, ...], inputs: int) -> Dynamics:
    """The model for data whose controls [N, inputs + 1] have one more column: 1 where an episode begins.

    In a fit, corrections of the rates follow behind it, [N, 2 n]: at a row's beginning and at its end.
    """
    place, n = np.array(rates), len(rates)

    def plain(data: Dataset) -> Dataset:
        return data._replace(u=data.u[:, :inputs])

    def loss(params: Params, key: Key, batch: Batch, context: Any) -> Array:
        u, _, begun, ended = jnp.split(batch.u, [inputs, inputs + 1, inputs + 1 + n], 1)
        x, y = batch.x.at[:, place].add(begun), batch.y.at[:, place].add(ended - begun)
        return model.loss(params, key, Batch(x, u, y), context)

    return model._replace(
        prepare=lambda data: model.prepare(plain(data)),
        loss=loss,
        posterior=lambda params, data: model.posterior(params, plain(data)),
    )


def alternating(fitter: ModelLearner, draw: Callable[[Key, Params, Dataset, Array], Array], size: int) -> ModelLearner:
    """The fitter of a `corrected` model, whose corrections [N, `size`] are drawn again every `ROUND` updates or so.

    That is stochastic expectation maximization (Celeux and Diebolt, 1985): states are drawn as the model and what was
    measured have them, and the model is fitted to the states, so that its noise stays that of the plant.
    """

    def run(key: Key, learner: Any, data: Dataset, steps: int) -> tuple[Any, Any]:
        rounds = max(1, steps // ROUND)
        each, left = divmod(steps, rounds)

        def one(carry: tuple[Any, Array], given: tuple[Array, Key], steps: int = each) -> tuple[tuple[Any, Array], Any]:
            learner, before = carry
            number, key = given
            draw_key, fit_key = jax.random.split(key)
            now = jnp.where(number < WARM * rounds, 0.0, draw(draw_key, learner.params, data, before))
            learner, info = fitter.run(fit_key, learner, data._replace(u=jnp.concatenate([data.u, now], 1)), steps)
            return (learner, now), info

        numbers, keys = jnp.arange(rounds + 1), jax.random.split(key, rounds + 1)
        begun = learner, jnp.zeros((len(data.x), size), data.x.dtype)
        carry, infos = jax.lax.scan(one, begun, (numbers[:-1], keys[:-1]))
        skipped = jnp.sum(infos.skipped)
        if left:
            carry, last = one(carry, (numbers[-1], keys[-1]), left)
            skipped += last.skipped
        tenth = max(1, rounds // 10)
        first, loss = jnp.mean(infos.first[:tenth]), jnp.mean(infos.loss[-tenth:])
        return carry[0], infos._replace(loss=loss, first=first, skipped=skipped)

    return ModelLearner(fitter.init, run)


def draw_rates(
    key: Key,
    params: Params,
    data: Dataset,
    before: Array,
    *,
    dynamics: Dynamics,
    rates: tuple[int, ...],
    angles: tuple[int, ...],
    inputs: int,
    dt: float,
) -> Array:
    """Corrections [N, 2 n] of the rates in the data: to rates drawn given the model and the measured positions.

    An extended Kalman filter along each episode, linear around the rates corrected as `before`, and a draw of its
    states from the last one to the first (Rauch, Tung and Striebel). Half of the variance that the model has for a
    change of position is the sensor's, at either end. Rates begin as the data have them, with the spread of all.
    """
    place, n, states = np.array(rates), len(rates), data.x.shape[1]
    measured = np.array([i for i in range(states) if i not in rates])
    used = jnp.arange(len(data.x)) < data.size
    first = (data.u[:, inputs] > 0.5) | ~used
    last = jnp.concatenate([first[1:], jnp.ones(1, bool)])
    begun, ended = before[:, :n], before[:, n:]
    model_key, begin_key, end_key = jax.random.split(key, 3)

    posterior = dynamics.posterior(params, data)
    draws = jax.vmap(dynamics.sample, (0, None))(jax.random.split(model_key, DRAWS), posterior)

    def change(x: Array, u: Array) -> tuple[Array, tuple[Array, Array]]:
        predicted = jax.vmap(dynamics.apply, (None, 0, None, None))(posterior, draws, x, u)
        noise = jnp.mean(predicted.std**2, 0)
        return jnp.mean(predicted.mean, 0), (noise, noise + jnp.var(predicted.mean, 0, ddof=1))

    x, y = data.x.at[:, place].add(begun), data.y.at[:, place].add(ended - begun)
    changes = jax.vmap(lambda x, u: change(x, u)[0])(x, data.u[:, :inputs])
    slopes, (noise, unknown) = jax.vmap(jax.jacfwd(change, has_aux=True))(x, data.u[:, :inputs])
    transition, offset = jnp.eye(states) + slopes, difference(changes, y, angles)
    sensor = noise[:, measured] / 2
    # Variances of the process noise. An unknown force moves the rates, and by half a period of it the positions.
    process = unknown.at[:, measured].set((dt / 2) ** 2 * unknown[:, place])

    mean = jnp.sum(jnp.where(used[:, None], data.x[:, place], 0), 0) / jnp.maximum(data.size, 1)
    spread = jnp.sum(jnp.where(used[:, None], (data.x[:, place] - mean) ** 2, 0), 0) / jnp.maximum(data.size, 1)
    start = Gaussian(
        jnp.zeros_like(x).at[:, place].set(-begun),
        jax.vmap(jnp.diag)(jnp.zeros_like(x).at[:, place].set(spread + 1e-12).at[:, measured].set(sensor)),
    )
    filtered, predicted, after = forward(start, first, transition, offset, process, sensor, measured)

    back = jax.vmap(lambda a, p, c: jnp.linalg.solve(c, a @ p).T)(transition, filtered.cov, predicted.cov)
    rest = filtered.cov - back @ predicted.cov @ jnp.swapaxes(back, 1, 2)
    drawn = filtered.mean + deviation(begin_key, rest)
    alone = after.mean + deviation(end_key, after.cov)

    def earlier(later: Array, row: tuple[Array, ...]) -> tuple[Array, tuple[Array, Array]]:
        is_last, alone, drawn, back, expected = row
        end = jnp.where(is_last, alone, later)
        begin = drawn + back @ (end - expected)
        return begin, (begin, end)

    rows = (last, alone, drawn, back, predicted.mean)
    _, (begin, end) = jax.lax.scan(earlier, jnp.zeros(states, x.dtype), rows, reverse=True)
    found = before + jnp.concatenate([begin[:, place], end[:, place]], 1)
    most = FARTHEST * jnp.sqrt(jnp.concatenate([spread, spread]))
    return jnp.where(used[:, None] & jnp.isfinite(found), jnp.clip(found, -most, most), 0.0)


def forward(
    start: Gaussian, first: Array, transition: Array, offset: Array, process: Array, sensor: Array, measured: np.ndarray
) -> tuple[Gaussian, Gaussian, Gaussian]:
    """The filter's beliefs about each row: at its beginning, its end as predicted, its end once measured: [N, ...]."""

    def row(known: Gaussian, given: Any) -> tuple[Gaussian, tuple[Gaussian, Gaussian, Gaussian]]:
        start, first, a, offset, process, sensor = given
        begun = jax.tree.map(partial(jnp.where, first), start, known)
        expected = Gaussian(offset + a @ begun.mean, a @ begun.cov @ a.T + jnp.diag(process))
        seen = expected.cov[measured]
        gain = jnp.linalg.solve(seen[:, measured] + jnp.diag(sensor), seen).T
        after = Gaussian(expected.mean - gain @ expected.mean[measured], expected.cov - gain @ seen)
        return after, (begun, expected, after)

    none = jax.tree.map(lambda leaf: leaf[0], start)
    return jax.lax.scan(row, none, (start, first, transition, offset, process, sensor))[1]


def deviation(key: Key, cov: Array) -> Array:
    """A draw [N, D] for each covariance [N, D, D]."""
    scale = jnp.sqrt(jnp.maximum(jnp.diagonal(cov, axis1=1, axis2=2), 1e-20))
    correlation = cov / scale[:, :, None] / scale[:, None, :] + JITTER * jnp.eye(cov.shape[-1])
    root = jnp.linalg.cholesky((correlation + jnp.swapaxes(correlation, 1, 2)) / 2)
    drawn = jnp.einsum("nij,nj->ni", root, jax.random.normal(key, scale.shape, cov.dtype)) * scale
    return jnp.where(jnp.isfinite(drawn), drawn, 0.0)
