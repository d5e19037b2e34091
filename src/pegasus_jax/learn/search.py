"""Policy search by a table: Alg. 3 with comparisons, a width, step sizes and a refinement, as one loop over rows."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from pegasus_jax.imagine.scenarios import Sampler
from pegasus_jax.learn.gradient import SearchInfo
from pegasus_jax.learn.race import candidate, entered
from pegasus_jax.learn.schedule import FRESH, STEP, SearchTable
from pegasus_jax.learn.visits import Ascend, after, first_rows, initial, of_search, only_refines, renewed, valued
from pegasus_jax.types import Array, Key, Params, PolicyOptimizer, TrainState


class Problem(NamedTuple):
    """What a search minimizes, and how."""

    objective: Callable[..., Array]  # (policy parameters, posterior, scenarios, row of the table) -> []
    sampler: Sampler
    optimizer: optax.GradientTransformation  # any of optax
    table: SearchTable
    works: Array | bool = False  # [] whether the given policy works; 2: the policy that replaced it has failed since
    reset_optimizer: bool = True  # whether each search starts with a new optimizer state
    # What a constraint makes of its multiplier; None: there is none. With it the objective's last argument is the
    # multiplier, and it returns (value, probability).
    ascend: Ascend = None


def searcher(problem: Problem) -> PolicyOptimizer:
    """The searcher of a problem: its `run` is `search`, its learner's optimizer a `SearchState`."""

    def run(*given: Any, works: Array | bool = False, **where: Any) -> tuple[TrainState, SearchInfo]:
        return search(*given, problem=problem._replace(works=works), **where)

    return PolicyOptimizer(partial(initial, problem), run)


def search(
    key: Key,
    learner: TrainState,
    posterior: Params,
    *,
    problem: Problem,
    steps: int,
    first: Array | int = 0,
    earlier: Array | int = 0,
    fresh: Params | None = None,
) -> tuple[TrainState, SearchInfo]:
    """The rows of iterations first .. first + steps - 1 of the problem's table, in the search after `earlier` others.

    A search that only refines (`only_refines`) begins at the first refining iteration and counts it as 0. A search ends
    early after a round of refinement that has gained nothing (learn/rounds.py): the info [n] is NaN where no iteration
    was done. One call of n steps and two of n/2, the second with first=n/2, do the same. `fresh` are untrained policies
    [2, ...], for a table that asks for them. Raises ValueError for too many iterations, or where `fresh` is missing.
    """
    table, sampler, begin = problem.table, problem.sampler, first_rows(problem.table)
    known = int(first) if isinstance(first, int | np.integer) else 0
    if known + steps > (most := len(begin) - 1):
        raise ValueError(f"first={known}, steps={steps}: the table of this search has {most} iterations")
    if (asks := FRESH in table.candidate) and fresh is None:
        raise ValueError("the table has a fresh policy as a candidate, and fresh= is None; expected its parameters")
    rows = of_search(table, earlier)
    learner = optax.tree.where(jnp.asarray(first) == 0, renewed(problem, learner), learner)
    # Without `works`, or without a refinement, nothing is skipped: seeds side by side then share one offset, and a loop
    # of one length.
    before = int(np.sum(~table.refine[begin[:-1]]))
    skips = problem.works is not False and before < most and only_refines(table, learner.optimizer.worked)
    offset = first + jnp.where(skips, jnp.int32(before), 0)
    row, end = (jnp.asarray(begin)[jnp.minimum(i, most)] for i in (offset, offset + steps))
    count = steps if len(table.action) == most else end - row  # a static length is quicker on a GPU

    def going(loop: tuple) -> Array:  # seeds side by side have one condition where no round ends a search
        return (loop[0] < count) & ~loop[1].optimizer.progress.over if table.ends.any() else loop[0] < count

    def visit(loop: tuple) -> tuple:
        k, learner, scenarios, info = loop
        now: SearchTable = jax.tree.map(lambda column: column[row + k], rows)
        learner, i = entered(now, learner, problem.optimizer), now.iteration - offset
        visited = candidate(now, learner, fresh if asks else None)
        scenarios = sampler.redraw(key, now.scenarios, scenarios, posterior, k == 0)
        seen = valued(problem, learner.optimizer, visited, posterior, scenarios, now)
        learner, cost, skipped = after(now, learner, seen, problem)
        norm, stepped = optax.tree.norm(seen.gradient), jnp.where(now.action == STEP, i, steps)
        norms = info.gradient_norm.at[stepped].set(norm, mode="drop")
        found = SearchInfo(info.objective.at[i].set(cost), norms, info.skipped + skipped, i + 1)
        return k + 1, learner, scenarios, found

    scenarios, none = sampler.begin(key, offset, posterior), jnp.full(steps, jnp.nan)
    begun = jnp.int32(0), learner, scenarios, SearchInfo(none, none, jnp.int32(0), jnp.int32(0))
    _, learner, _, info = jax.lax.while_loop(going, visit, begun)
    return learner, info
