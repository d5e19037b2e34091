"""One row of a search's table: the cost and the gradient at the parameters that it visits, then the next parameters.

With a constraint, its multiplier ascends while the policy descends.
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
    # The policy that replaced it has just failed on the plant: this search only refines, and whole ones become rarer.
    count = jnp.where(jnp.asarray(problem.works) > 1, 2 * count + 1, count)
    worked = jnp.where(problem.works, count, 0)
    new = dict(optimizer=optimizer, start=params, worked=worked, progress=unrefined(), widening=jnp.ones((), float))
    return TrainState(params, state._replace(**new))


def only_refines(table: SearchTable, worked: Array) -> Array:
    """[] whether a search skips all that comes before its refinement; see `SearchState.worked` for `worked` [].

    Where the table also tries a fresh policy, the 1st, 2nd, 4th, 8th, ... of these searches do all of it: a policy that
    works may be far from the best, and a refinement alone does not find a better one (docs/decisions.md 0035).
    """
    compares = ((table.candidate == FRESH) & (table.action != STEP) | (table.candidate == LEADER)).any()
    return worked & (worked - 1) != 0 if compares else worked > 0


class Visit(NamedTuple):
    """What a row of the table finds at the parameters that it visits."""

    params: Params
    value: Array  # [] the objective there
    gradient: Params
    multiplier: Array | None  # [] of a constraint's penalty, after a step from there; None: there is no constraint
    objective: Callable[[Params], Array]  # under the row's scenarios, for an optimizer that evaluates it elsewhere


def valued(
    problem: Any, state: SearchState, params: Params, posterior: Params, scenarios: Params, row: SearchTable
) -> Visit:
    """A problem's objective at these parameters, and its gradient there, as a row of the table asks for it."""
    given, multiplier = (posterior, scenarios, widened(row, state.widening)), state.multiplier
    if problem.ascend is None:
        objective = lambda params: problem.objective(params, *given)  # noqa: E731
        return Visit(params, *jax.value_and_grad(objective)(params), None, objective)
    both = lambda params: problem.objective(params, *given, multiplier)  # noqa: E731
    (value, chance), gradient = jax.value_and_grad(both, has_aux=True)(params)
    return Visit(params, value, gradient, problem.ascend(multiplier, chance), lambda params: both(params)[0])


def after(row: SearchTable, learner: TrainState, visit: Visit, problem: Any) -> tuple[TrainState, Array, Array]:
    """What a row makes of its visit -> (learner, cost of the learner's parameters before a step, update skipped)."""
    value, gradient = visit.value, visit.gradient
    (params, state), finite, steps_now = learner, is_finite((value, gradient)), row.action == STEP
    # `SearchTable.candidate` says which policy is taken. On a tie it is not CURRENT: on a flat cost the search would
    # never leave that. A cost of NaN loses: one of its particles went to infinity.
    lost = jnp.isnan(state.last)
    older, less = (value <= state.last) | lost, (value < state.last) | lost
    # The fresh policy is also taken where the search is to find another policy than the given one.
    fresh = (older | state.no_improvement | (state.worked > 0)) & ~jnp.isnan(value)
    taken = jnp.stack([True, fresh, True, less, older, older])[row.candidate] | steps_now
    params, state = optax.tree.where(taken, visit.params, params), returned(row, taken, state)
    now, more = TrainState(params, state.optimizer), dict(value=value, grad=gradient, value_fn=visit.objective)
    updates, moments = update_if(steps_now & finite, problem.optimizer, gradient, now, **more)
    found = state._replace(
        optimizer=moments,
        start=optax.tree.where(row.candidate >= START, params, state.start),
        last=value,
        progress=after_row(state.progress, row, value),
        widening=after_step(state.widening, row, value),
        no_improvement=jnp.where(row.candidate == START, taken, state.no_improvement),
        # After a step only: rows that compare policies count the constraint by the same multiplier.
        multiplier=None if visit.multiplier is None else jnp.where(steps_now, visit.multiplier, state.multiplier),
    )
    params = optax.apply_updates(params, optax.tree.scale(row.step_size, updates))
    return TrainState(params, found), jnp.where(taken, value, state.last), steps_now & ~finite


def of_search(table: SearchTable, earlier: Array | int) -> SearchTable:
    """The table [R] of the search after `earlier` others, as arrays: every search runs the same compiled program."""
    # One row of factors serves all searches: indexing it by a vmapped `earlier` would copy it for each.
    number = jnp.minimum(earlier, most) if (most := len(table.limit) - 1) else 0
    return SearchTable(*map(jnp.asarray, table[:-3]), *(jnp.asarray(column)[number] for column in table[-3:]))


def first_rows(table: SearchTable) -> np.ndarray:
    """[N+1] the row with which each iteration begins, and the number of rows."""
    return np.searchsorted(table.iteration, np.arange(table.iteration.max(initial=-1) + 2)).astype(np.int32)
