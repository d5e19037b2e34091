"""A simulator, and a learned model of what it gets wrong: their sum is a distribution over functions like any other."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from pegasus_jax.math.angles import difference
from pegasus_jax.types import (
    Array,
    Batch,
    Dataset,
    Dynamics,
    Key,
    ModelLearner,
    Params,
    Prediction,
    TrainState,
)
from pegasus_jax.vectorized import Vectorized, for_particles

Simulate = Callable[[Array, Array], Array]  # (x [D], u [U]) -> x [D] one control period later
FURTHEST = 2.0  # the most that is added, as a factor of the largest difference in the data


class Posterior(NamedTuple):
    """What was learned of the difference to the plant."""

    learned: Any
    limit: Array  # [D] of what is added to the simulator's change of state


def residual(learned: Dynamics, simulate: Simulate, *, angles: tuple[int, ...]) -> Dynamics:
    """A model whose mean is the simulator's change of state plus what `learned` adds to it; its noise is `learned`'s.

    `learned` is a model of U + D controls: it is also given the simulator's change of state [D], so that it need not
    learn that again where the simulator is wrong by a factor. What it adds saturates smoothly at FURTHEST times the
    largest difference in the data, so it is nothing before there are data: else a network that extrapolates could send
    imagined states to where the simulator diverges. Gradients flow through both parts.
    """

    def simulated(x: Array, u: Array) -> tuple[Array, Array]:
        change = difference(simulate(x, u), x, angles)
        return change, jnp.concatenate([u, change])

    def loss(params: Params, key: Key, batch: Batch, context: Any) -> Array:
        return learned.loss(params, key, differences(batch, simulate, angles), context)

    def posterior(params: Params, data: Dataset) -> Posterior:
        rows = differences(data, simulate, angles)
        used = (jnp.arange(len(rows.y)) < data.size)[:, None]
        largest = jnp.max(jnp.where(used, jnp.abs(rows.y), 0), 0)
        return Posterior(learned.posterior(params, rows), jnp.maximum(FURTHEST * largest, 1e-6))

    def total(given: Posterior, change: Array, added: Prediction) -> Prediction:
        return Prediction(change + given.limit * jnp.tanh(added.mean / given.limit), added.std)

    def one(given: Posterior, draw: Params, x: Array, u: Array) -> Prediction:
        change, inputs = simulated(x, u)
        return total(given, change, learned.apply(given.learned, draw, x, inputs))

    def many(given: Posterior, draws: Params, x: Array, u: Array) -> Prediction:
        change, inputs = jax.vmap(simulated)(x, u)
        return total(given, change, for_particles(learned.apply)(given.learned, draws, x, inputs))

    deal = learned.deal
    return Dynamics(
        init=learned.init,
        prepare=lambda data: learned.prepare(differences(data, simulate, angles)),
        loss=loss,
        posterior=posterior,
        sample=lambda key, given: learned.sample(key, given.learned),
        apply=Vectorized(one, many),
        deal=None if deal is None else lambda keys, given: deal(keys, given.learned),
    )


def differences(rows: Any, simulate: Simulate, angles: tuple[int, ...]) -> Any:
    """The rows of a `Dataset` or a `Batch` as `learned` takes them: u [U + D] with the simulator's change of state.

    y [D] is the plant's change of state minus the simulator's.
    """
    change = difference(jax.vmap(simulate)(rows.x, rows.u), rows.x, angles)
    return rows._replace(u=jnp.concatenate([rows.u, change], -1), y=difference(rows.y, change, angles))


def on_differences(fitter: ModelLearner, simulate: Simulate, angles: tuple[int, ...]) -> ModelLearner:
    """What fits `learned` of a `residual`: the simulator runs once over all rows, not again in every update."""

    def run(key: Key, learner: TrainState, data: Dataset, steps: int) -> tuple[TrainState, Any]:
        return fitter.run(key, learner, differences(data, simulate, angles), steps)

    return ModelLearner(fitter.init, run)
