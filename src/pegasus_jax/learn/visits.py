"""What a row of a search's table makes of the parameters that it visits: their cost and gradient, then the next ones.

Where there is a constraint its multiplier ascends beside the policy's descent.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax

from pegasus_jax.imagine.limits import FIRST
from pegasus_jax.learn.rounds import after_row
from pegasus_jax.learn.schedule import START, STEP, SearchTable
from pegasus_jax.learn.updates import is_finite, update_if
from pegasus_jax.types import Array, Params, TrainState

# (multiplier, probability that an episode breaks the constraint) -> multiplier after a step; None: no constraint
Ascend = Callable[[Array, Array], Array] | None


def begun(ascend: Ascend) -> Array | None:
    """The first multiplier []; None without a constraint."""
    return None if ascend is None else jnp.asarray(FIRST, float)


def valued(problem: Any, multiplier: Any, *given: Any) -> tuple[Array, Params, Array | None]:
    """A problem's objective, its gradient with respect to the first of `given`, and the multiplier after a step."""
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
    (params, state), finite, steps_now = learner, is_finite(gradient), row.action == STEP
    # NaN decides for the older policy, a tie for the other one: where the cost is flat, nothing else leads away.
    older = ~(state.last < value)
    taken = jnp.stack([True, (value <= state.last) | state.no_improvement, older, older])[row.candidate] | steps_now
    params = optax.tree.where(taken, visited, params)
    now = TrainState(params, state.optimizer)
    updates, moved = update_if(steps_now & finite, problem.optimizer, gradient, now, value=value)
    found = state._replace(
        optimizer=moved,
        start=optax.tree.where(row.candidate >= START, params, state.start),
        last=value,
        progress=after_row(state.progress, row, value),
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
