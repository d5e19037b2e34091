"""Model learning: minimize a model's loss over minibatches of all data (eq. 2, Alg. 1 line 5)."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from pegasus_jax.checks import size
from pegasus_jax.learn.data import minibatch
from pegasus_jax.learn.updates import is_finite, update_if
from pegasus_jax.shapes import check_data
from pegasus_jax.types import Array, Batch, Dataset, Dynamics, Key, ModelLearner, Params, TrainState


class FitInfo(NamedTuple):
    """How a fit went."""

    loss: Array  # [] mean over the last tenth of the steps, without skipped ones [nats a row]; NaN: all were
    first: Array  # [] the same over the first tenth
    skipped: Array  # [] updates skipped because a loss or its gradient was not finite


def fit(
    key: Key,
    learner: TrainState,
    data: Dataset,
    *,
    prepare: Callable[[Dataset], Params],
    loss: Callable[[Params, Key, Batch, Params], Array],
    optimizer: optax.GradientTransformation,
    steps: int,
    batch_size: int,
) -> tuple[TrainState, FitInfo]:
    """`steps` updates of the model's parameters, each on `batch_size` rows of the [N, D] in use (Alg. 1 line 5).

    `optimizer` is any of optax, and `learner.optimizer` its state, `optimizer.init(params)`. An update is skipped where
    the loss or its gradient is not finite. A line search evaluates the loss of the same rows
    and noise. Raises ValueError for data of other shapes than a `Dataset` has, and for a batch of no rows.
    """
    size("batch_size", batch_size)
    check_data(data)
    context = prepare(data)

    def step(learner: TrainState, key: Key) -> tuple[TrainState, tuple[Array, Array]]:
        row_key, noise_key = jax.random.split(key)
        rows = minibatch(row_key, data, batch_size)

        def of_rows(params: Params) -> Array:
            return loss(params, noise_key, rows, context)

        value, gradient = jax.value_and_grad(of_rows)(learner.params)
        finite = is_finite((value, gradient))
        more = dict(value=value, grad=gradient, value_fn=of_rows)
        updates, state = update_if(finite, optimizer, gradient, learner, **more)
        return TrainState(optax.apply_updates(learner.params, updates), state), (value, finite)

    learner, (losses, finite) = jax.lax.scan(step, learner, jax.random.split(key, steps))
    tenth = max(steps // 10, 1)
    last, first = (jnp.mean(losses[part], where=finite[part]) for part in (slice(-tenth, None), slice(tenth)))
    return learner, FitInfo(last, first, jnp.sum(~finite))


def falling(rate: float, decay: float, steps: int) -> float | optax.Schedule:
    """A step size that falls from `rate` to `decay` of it over `steps` updates, as half a cosine, and begins again."""
    if decay == 1:
        return rate
    fall = optax.cosine_decay_schedule(rate, steps, alpha=decay)
    return lambda count: fall(jnp.asarray(count) % steps)


def minibatches(dynamics: Dynamics, optimizer: optax.GradientTransformation, *, batch_size: int) -> ModelLearner:
    """The fitter that steps `optimizer` on minibatches; each fit goes on with the optimizer state of the one before.

    Raises ConfigError for a `batch_size` [rows] below 1, or no whole number.
    """
    size("batch_size", batch_size)

    def run(key: Key, learner: TrainState, data: Dataset, steps: int) -> tuple[TrainState, FitInfo]:
        return fit(
            key,
            learner,
            data,
            prepare=dynamics.prepare,
            loss=dynamics.loss,
            optimizer=optimizer,
            steps=steps,
            batch_size=batch_size,
        )

    return ModelLearner(optimizer.init, run)
