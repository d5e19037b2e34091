"""Imagined rollouts that start where the plant has been, so that a policy holds beyond the horizon it is searched over.

From the task's own starts alone a search sees the first H periods of an episode and no more: a cart that creeps away
costs next to nothing in them, and falls off the rail's end later. From a state late in an episode it sees H periods on.
A policy that has not succeeded yet has nothing to hold, and would learn its task later for it.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax.imagine.scenarios import Block
from pegasus_jax.math.angles import difference
from pegasus_jax.memory import join, split
from pegasus_jax.types import Array, Dynamics, Key, Params, Prediction, RunState, Scenarios
from pegasus_jax.vectorized import Vectorized, for_particles

STATES = 512  # that a posterior carries: as many for any number of trials, so that a search compiles once
STEEPEST = 10.0  # docs/decisions.md 0038
_VISITED = 2**31 - 1  # what the key of the start block is folded with; fold_in(key, 1) is split(key)[1]


class Visited(NamedTuple):
    """A posterior, and states of the data that it was learned from."""

    posterior: Any
    states: Array  # [512, D + M]
    spread: Array  # [D + M] the standard deviations of the states
    succeeded: Array  # [] bool, whether the newest episode did
    goal: Array  # [] bool, whether an entry of x stays as it is through each episode, and differs between them


def remember(posterior: Any, state: RunState, *, angles: tuple[int, ...], varies: np.ndarray) -> Visited:
    """The posterior with rows evenly spaced in a run's data, repeated where it has few.

    `varies` [D] bool are the entries of x that differ between the starts of episodes.
    """
    i, (each, rest) = jnp.arange(STATES), jnp.divmod(state.data.size, STATES)
    rows = i * each + i * rest // STATES  # i size / STATES, and no product too large for 32 bits
    states = join(state.data.x, state.data.memory)[rows]
    spread = jnp.std(difference(states, states[0], angles), 0)
    stays = jnp.all(state.data.y == 0, 0) & (state.data.size > 0)  # rows that are not in use are 0
    return Visited(posterior, states, spread, state.succeeded, jnp.any(stays & varies))


def longest(given: Visited, particles: int) -> Array:
    """How long [D + M] the gradient of one of so many particles with respect to its state may be.

    To move a particle by the states' spread changes its cost, which is in [0, 1], by 1 at most. Where a gradient says
    `STEEPEST` times that, its particle is chaotic there.
    """
    return STEEPEST / (particles * given.spread)


def remembering(dynamics: Dynamics) -> Dynamics:
    """The same model, whose draws and predictions are those of a `Visited`."""

    def one(given: Visited, draw: Params, x: Array, u: Array) -> Prediction:
        return dynamics.apply(given.posterior, draw, x, u)

    def many(given: Visited, draws: Params, x: Array, u: Array) -> Prediction:
        return for_particles(dynamics.apply)(given.posterior, draws, x, u)

    deal = dynamics.deal
    return dynamics._replace(
        sample=lambda key, given: dynamics.sample(key, given.posterior),
        apply=Vectorized(one, many),
        deal=None if deal is None else lambda keys, given: deal(keys, given.posterior),
    )


class Starts(NamedTuple):
    """Two first states of each particle: the scenarios of a search have one of them, by what it does."""

    own: Array  # [K, D + M] as the task's episodes begin
    mixed: Array  # [K, D + M] the same, of some particles one that the plant has visited


def beside_visited(start: Block, share: float, angles: tuple[int, ...], around: Array) -> Block:
    """`Starts` as `start` draws them, mixed with probability `share` with states of a `Visited` that has succeeded.

    Their `angles` are those less than half a turn from `around` [D], whatever turns the plant has made.
    """

    def block(key: Key, given: Visited) -> Starts:
        own = start(key, given)
        chosen, row = jax.random.split(jax.random.fold_in(key, _VISITED))
        states = given.states[jax.random.randint(row, own.shape[:1], 0, STATES)]
        x, m = split(states, around.shape[0])
        near = join((around + difference(x, around, angles)).astype(own.dtype), m)
        elsewhere = jax.random.bernoulli(chosen, share, (len(own), 1)) & given.succeeded
        return Starts(own, jnp.where(elsewhere, near, own))

    return block


def started(given: Scenarios, refining: Array) -> Scenarios:
    """The scenarios of `Starts` that hold for a visit: a search that refines also begins where the plant has been."""
    own, mixed = given.start
    return given._replace(start=jnp.where(refining, mixed, own))
