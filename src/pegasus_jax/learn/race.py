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
    """What is in the leader's place before a race of the table; None for a table without a race."""
    return Leader(params, moments, jnp.ones((), float)) if LEADER in table.candidate else None


def candidate(row: SearchTable, learner: TrainState, fresh: Params | None) -> Params:
    """The parameters that a row visits; `fresh` are two policies [2, ...] that know nothing, or None.

    The second of a race is the fresh one, too, where the given one works, so that another is to be found, or where the
    last search found nothing better than it.
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
    """The learner with which a row begins: with the second policy of a race the first one is kept as its leader."""
    params, state = learner
    if state.leader is None:
        return learner
    begins, own = (row.candidate == OTHER) & (row.action == STEP), (state.optimizer, state.widening)
    moments, widening = optax.tree.where(begins, (optimizer.init(params), jnp.ones_like(state.widening)), own)
    leader = optax.tree.where(begins, Leader(params, *own), state.leader)
    return TrainState(params, state._replace(optimizer=moments, widening=widening, leader=leader))


def returned(row: SearchTable, taken: Array, state: Any) -> Any:
    """The state with the moments and the width of the leader, where its policy is taken."""
    if state.leader is None:
        return state
    won, own = (row.candidate == LEADER) & taken, (state.optimizer, state.widening)
    moments, widening = optax.tree.where(won, (state.leader.optimizer, state.leader.widening), own)
    return state._replace(optimizer=moments, widening=widening)
