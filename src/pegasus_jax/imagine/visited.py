"""Imagined rollouts that start where the plant has been, so that a policy holds beyond the horizon it is searched over.

From the task's own starts alone a search sees the first H periods of an episode and no more: a cart that creeps away
costs next to nothing in them, and falls off the rail's end later. From a state late in an episode it sees H periods on.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from pegasus_jax.imagine.scenarios import Block
from pegasus_jax.math.angles import difference
from pegasus_jax.memory import join, split
from pegasus_jax.types import Array, Dataset, Dynamics, Key, Params, Prediction
from pegasus_jax.vectorized import Vectorized, for_particles

STATES = 512  # that a posterior carries: as many for any number of trials, so that a search compiles once
_VISITED = 1  # what the key of the start block is folded with


class Visited(NamedTuple):
    """A posterior, and states of the data that it was learned from."""

    posterior: Any
    states: Array  # [512, D + M]


def remembering(dynamics: Dynamics) -> Dynamics:
    """The same model, whose posterior is a `Visited`: rows evenly spaced in the data, repeated where it has few."""

    def posterior(params: Params, data: Dataset) -> Visited:
        rows = jnp.arange(STATES) * data.size // STATES
        return Visited(dynamics.posterior(params, data), join(data.x, data.memory)[rows])

    def one(given: Visited, draw: Params, x: Array, u: Array) -> Prediction:
        return dynamics.apply(given.posterior, draw, x, u)

    def many(given: Visited, draws: Params, x: Array, u: Array) -> Prediction:
        return for_particles(dynamics.apply)(given.posterior, draws, x, u)

    deal = dynamics.deal
    return dynamics._replace(
        posterior=posterior,
        sample=lambda key, given: dynamics.sample(key, given.posterior),
        apply=Vectorized(one, many),
        deal=None if deal is None else lambda keys, given: deal(keys, given.posterior),
    )


def or_visited(start: Block, share: float, angles: tuple[int, ...], around: Array) -> Block:
    """First states [K, D + M] as `start` draws them, each with probability `share` one of a `Visited` in its place.

    Its `angles` are those less than half a turn from `around` [D], whatever turns the plant has made.
    """

    def block(key: Key, given: Visited) -> Array:
        own = start(key, given)
        chosen, row = jax.random.split(jax.random.fold_in(key, _VISITED))
        states = given.states[jax.random.randint(row, own.shape[:1], 0, STATES)]
        x, m = split(states, around.shape[0])
        near = join((around + difference(x, around, angles)).astype(own.dtype), m)
        return jnp.where(jax.random.bernoulli(chosen, share, (len(own), 1)), near, own)

    return block
