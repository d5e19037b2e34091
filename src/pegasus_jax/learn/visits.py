"""What a row of a search's table makes of the parameters that it visits: their cost and gradient, then the next ones.

Where there is a constraint its multiplier ascends beside the policy's descent.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from pegasus_jax.imagine.limits import FIRST
from pegasus_jax.learn.race import leader_of, returned
from pegasus_jax.learn.rounds import Progress, after_row, unrefined
from pegasus_jax.learn.schedule import FRESH, LEADER, START, STEP, SearchTable
from pegasus_jax.learn.updates import is_finite, update_if
from pegasus_jax.learn.widening import after_step, widened
from pegasus_jax.types import Array, Params, TrainState


class SearchState(NamedTuple):
    """What a search knows beyond its parameters: with it, it goes on at any row of its table."""

    optimizer: Any  # the state of the problem's optimizer
    start: Params  # what the search, or its refinement, started from
    last: Array  # [] the objective at the row before
    no_improvement: Array  # [] whether the last search found nothing better than what it was given, before it refined
    worked: Array  # [] how many searches in a row, this one included, were given a policy that works
    progress: Progress  # of the rounds of its refinement
    widening: Array  # [] how much wider than the table says the cost is: learn/widening.py
    leader: Any = None  # a `Leader` of a race; None: the table has none
    multiplier: Any = None  # [] of a constraint's penalty, kept from search to search; None: there is no constraint


# (multiplier, probability that an episode breaks the constraint) -> multiplier after a step; None: no constraint
Ascend = Callable[[Array, Array], Array] | None


def initial(problem: Any, params: Params) -> SearchState:
    """What is known before a problem's first search."""
    none = jnp.asarray(jnp.inf, float), jnp.zeros((), bool), jnp.int32(0), unrefined(), jnp.ones((), float)
    moments = problem.optimizer.init(params)
    multiplier = None if problem.ascend is None else jnp.asarray(FIRST, float)
    return SearchState(moments, params, *none, leader_of(problem.table, params, moments), multiplier)


def renewed(problem: Any, learner: TrainState) -> TrainState:
    """The learner of a search that begins: it forgets what belonged to the one before."""
    params, state = learner
    optimizer = problem.optimizer.init(params) if problem.reset_optimizer else state.optimizer
    count = state.worked + 1
    # What took its place has just failed on the plant: this search only refines, and whole ones are rarer from now on.
    count = jnp.where(jnp.asarray(problem.works) > 1, 2 * count + 1, count)
    worked = jnp.where(problem.works, count, 0)
    new = dict(optimizer=optimizer, start=params, worked=worked, progress=unrefined(), widening=jnp.ones((), float))
    return TrainState(params, state._replace(**new))


def only_refines(table: SearchTable, worked: Array) -> Array:
    """Whether a search skips what comes before its refinement, where `worked` [] in a row were given what works.

    Of a table that compares with a fresh policy, or races with one, the 1st, 2nd, 4th, 8th, ... of them do all of it,
    from that: one that works may be far from the best, and then a refinement does not find that (docs/decisions.md
    0035).
    """
    compares = ((table.candidate == FRESH) & (table.action != STEP) | (table.candidate == LEADER)).any()
    return worked & (worked - 1) != 0 if compares else worked > 0


def valued(problem: Any, state: Any, *given: Any) -> tuple[Array, Params, Array | None]:
    """A problem's objective, its gradient with respect to the first of `given`, and the multiplier after a step.

    The last of `given` is the row.
    """
    given, multiplier = (*given[:-1], widened(given[-1], state.widening)), state.multiplier
    if problem.ascend is None:
        return *jax.value_and_grad(problem.objective)(*given), None
    (value, chance), gradient = jax.value_and_grad(problem.objective, has_aux=True)(*given, multiplier)
    return value, gradient, problem.ascend(multiplier, chance)


def after(
    row: SearchTable,
    learner: TrainState,
    visited: Params,
    value: Array,
    gradient: Params,
    multiplier: Array | None,
    problem: Any,
) -> tuple[TrainState, Array, Array]:
    """What a row makes of the cost and gradient of what it visited -> (learner, cost of its parameters, skipped)."""
    (params, state), finite, steps_now = learner, is_finite((value, gradient)), row.action == STEP
    # Which policy is taken says `SearchTable.candidate`. A tie leaves CURRENT: where a cost is flat nothing else does.
    # What is not a number, because a particle went to infinity, loses.
    lost = jnp.isnan(state.last)
    older, less = (value <= state.last) | lost, (value < state.last) | lost
    # A fresh policy is also where a search begins that is to find another than the given one.
    fresh = older | (state.no_improvement | (state.worked > 0)) & ~jnp.isnan(value)
    taken = jnp.stack([True, fresh, True, less, older, older])[row.candidate] | steps_now
    params, state = optax.tree.where(taken, visited, params), returned(row, taken, state)
    now = TrainState(params, state.optimizer)
    updates, moved = update_if(steps_now & finite, problem.optimizer, gradient, now, value=value)
    found = state._replace(
        optimizer=moved,
        start=optax.tree.where(row.candidate >= START, params, state.start),
        last=value,
        progress=after_row(state.progress, row, value),
        widening=after_step(state.widening, row, value),
        no_improvement=jnp.where(row.candidate == START, taken, state.no_improvement),
        # After a step only: what rows compare is weighed alike.
        multiplier=None if multiplier is None else jnp.where(steps_now, multiplier, state.multiplier),
    )
    params = optax.apply_updates(params, optax.tree.scale(row.step_size, updates))
    return TrainState(params, found), jnp.where(taken, value, state.last), steps_now & ~finite


def of_search(table: SearchTable, earlier: Array | int) -> SearchTable:
    """The table [R] of the search after `earlier` others. Its numbers are data: no search compiles another program."""
    # Where all are alike there is no choice to make: of searches vmapped over `earlier` each would have its own.
    number = jnp.minimum(earlier, most) if (most := len(table.limit) - 1) else 0
    return SearchTable(*map(jnp.asarray, table[:-3]), *(jnp.asarray(column)[number] for column in table[-3:]))


def first_rows(table: SearchTable) -> np.ndarray:
    """[N+1] the row with which each iteration begins, and the number of rows."""
    return np.searchsorted(table.iteration, np.arange(table.iteration.max(initial=-1) + 2)).astype(np.int32)
