"""Model learning: minimise a model's loss over minibatches of all data (eq. 2, Alg. 1 line 5)."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from pegasus_jax.learn.data import minibatch
from pegasus_jax.types import Array, Batch, Dataset, Dynamics, Fitter, Key, Learner, Params


class FitInfo(NamedTuple):
    """How a fit went."""

    loss: Array  # [] mean over the last tenth of the steps [nats a row]
    first: Array  # [] the same over the first tenth
    skipped: Array  # [] updates skipped because a gradient was not finite


def guarded(optimizer: optax.GradientTransformation) -> optax.GradientTransformation:
    """The optimiser, except that a gradient with a non-finite entry changes nothing and is counted."""
    return optax.apply_if_finite(optimizer, max_consecutive_errors=2**31 - 1)


def skipped(state: optax.OptState) -> Array:
    """Updates a `guarded` optimiser has skipped so far."""
    return state.total_notfinite  # type: ignore[union-attr]


def fit(
    key: Key,
    learner: Learner,
    data: Dataset,
    *,
    prepare: Callable[[Dataset], Params],
    loss: Callable[[Params, Key, Batch, Params], Array],
    optimizer: optax.GradientTransformation,
    steps: int,
    batch: int,
) -> tuple[Learner, FitInfo]:
    """`steps` updates of the model's parameters, each on `batch` rows and fresh noise."""
    context = prepare(data)
    before = skipped(learner.optimizer)

    def step(learner: Learner, key: Key) -> tuple[Learner, Array]:
        row_key, noise_key = jax.random.split(key)
        rows = minibatch(row_key, data, batch)
        value, gradient = jax.value_and_grad(loss)(learner.params, noise_key, rows, context)
        updates, state = optimizer.update(gradient, learner.optimizer, learner.params)
        return Learner(optax.apply_updates(learner.params, updates), state), value

    learner, losses = jax.lax.scan(step, learner, jax.random.split(key, steps))
    tenth = max(steps // 10, 1)
    return learner, FitInfo(jnp.mean(losses[-tenth:]), jnp.mean(losses[:tenth]), skipped(learner.optimizer) - before)


def falling(rate: float, decay: float, steps: int) -> float | optax.Schedule:
    """A step size that falls from `rate` to `decay` of it over `steps` updates, as half a cosine, and begins again."""
    if decay == 1:
        return rate
    fall = optax.cosine_decay_schedule(rate, steps, alpha=decay)
    return lambda count: fall(jnp.asarray(count) % steps)


def minibatches(dynamics: Dynamics, optimizer: optax.GradientTransformation, *, batch: int) -> Fitter:
    """The fitter that takes `optimizer`'s steps on minibatches; each fit goes on with the moments of the one before."""
    guarded_optimizer = guarded(optimizer)

    def run(key: Key, learner: Learner, data: Dataset, steps: int) -> tuple[Learner, FitInfo]:
        return fit(
            key,
            learner,
            data,
            prepare=dynamics.prepare,
            loss=dynamics.loss,
            optimizer=guarded_optimizer,
            steps=steps,
            batch=batch,
        )

    return Fitter(guarded_optimizer.init, run)
