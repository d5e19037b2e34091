"""A race: a fresh policy and the one that a search is given are each searched for a while, and the better goes on."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from pegasus_jax.learn.schedule import LEADER, OTHER, STEP, SearchTable
from pegasus_jax.types import Array, Params, TrainState


class Leader(NamedTuple):
    """The policy that ran first, as it was when the other one began."""

    params: Params
    optimizer: Any
    widening: Array  # []


def leader_of(table: SearchTable, params: Params, moments: Any) -> Leader | None:
    """A `Leader` for a table's search to begin with, replaced when its race begins; None for one without a race."""
    return Leader(params, moments, jnp.ones((), float)) if LEADER in table.candidate else None


def candidate(row: SearchTable, learner: TrainState, fresh: Params | None) -> Params:
    """The parameters that a row visits; `fresh` are two untrained policies [2, ...], or None.

    The second policy of a race is the given one. It is the second fresh one where the given one works already, or where
    the last search found nothing better than it: then the race is to find another policy.
    """
    own, state = learner
    first, second = (own, own) if fresh is None else (jax.tree.map(lambda leaf, i=i: leaf[i], fresh) for i in range(2))
    other = before = own
    if state.leader is not None:
        other = optax.tree.where((state.worked > 0) | state.no_improvement, second, state.start)
        before = state.leader.params
    choose = partial(jax.lax.select_n, row.candidate)
    return jax.tree.map(choose, own, first, other, before, state.start, state.start)


def entered(row: SearchTable, learner: TrainState, optimizer: optax.GradientTransformation) -> TrainState:
    """The learner at the start of a row: where a race's second policy begins, the first is stored as the leader."""
    params, state = learner
    if state.leader is None:
        return learner
    begins, own = (row.candidate == OTHER) & (row.action == STEP), (state.optimizer, state.widening)
    moments, widening = optax.tree.where(begins, (optimizer.init(params), jnp.ones_like(state.widening)), own)
    leader = optax.tree.where(begins, Leader(params, *own), state.leader)
    return TrainState(params, state._replace(optimizer=moments, widening=widening, leader=leader))


def returned(row: SearchTable, taken: Array, state: Any) -> Any:
    """The state with the leader's optimizer state and widening, where the leader's policy is taken."""
    if state.leader is None:
        return state
    won, own = (row.candidate == LEADER) & taken, (state.optimizer, state.widening)
    moments, widening = optax.tree.where(won, (state.leader.optimizer, state.leader.widening), own)
    return state._replace(optimizer=moments, widening=widening)
