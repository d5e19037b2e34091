"""Policy search: follow the gradient of the imagined cost under held scenarios (Alg. 3)."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from pegasus_jax.imagine import scenarios as drawing
from pegasus_jax.learn.schedule import FRESH, START, STEP, SearchTable, first_rows
from pegasus_jax.learn.updates import is_finite, update_if
from pegasus_jax.types import Array, Key, Learner, Params, Period, Scenarios, Searcher


class Sampler(NamedTuple):
    """Where the scenarios of a search come from."""

    draw: Callable[[Key, Array, Params], Scenarios]  # (key, iteration, posterior)
    redraw: Callable[[Key, Array, Scenarios, Params], Scenarios]  # (key, iteration, those before it, posterior)


def sampler(blocks: drawing.Blocks, period: Period) -> Sampler:
    """Scenarios drawn from `blocks`, each held for its `period` of iterations."""
    return Sampler(*(partial(function, blocks=blocks, period=period) for function in (drawing.draw, drawing.redraw)))


class SearchInfo(NamedTuple):
    """How a search went, iteration by iteration."""

    objective: Array  # [steps]; where an iteration ends with a comparison, that of the policy that goes on
    gradient_norm: Array  # [steps] before clipping
    skipped: Array  # [] updates skipped because a gradient was not finite


class SearchState(NamedTuple):
    """What a search knows beyond its parameters: with it, it goes on at any row of its table."""

    optimizer: Any  # the state of the problem's optimizer
    start: Params  # what the search, or its refinement, started from
    last: Array  # [] the objective at the row before
    no_improvement: Array  # [] whether the last search found nothing better than what it was given, before it refined


class Problem(NamedTuple):
    """What a search minimizes, and how."""

    objective: Callable[..., Array]  # (policy parameters, posterior, scenarios, row of the table) -> []
    sampler: Sampler
    optimizer: optax.GradientTransformation  # any of optax
    table: SearchTable
    reset: bool = True  # whether each search starts with a new optimizer state


def gradient_search(
    key: Key,
    learner: Learner,
    posterior: Params,
    *,
    objective: Callable[[Params, Params, Scenarios], Array],
    sampler: Sampler,
    optimizer: optax.GradientTransformation,
    steps: int,
) -> tuple[Learner, SearchInfo]:
    """Alg. 3 as printed: `steps` updates along the gradient of `objective` under the scenarios of each iteration.

    The learner is policy parameters and `optimizer.init` of them. A gradient with a non-finite entry changes nothing.
    """

    def step(carry: tuple[Learner, Scenarios], i: Array) -> tuple[tuple[Learner, Scenarios], SearchInfo]:
        learner, scenarios = carry
        value, gradient = jax.value_and_grad(objective)(learner.params, posterior, scenarios)
        finite = is_finite(gradient)
        updates, state = update_if(finite, optimizer, gradient, learner, value=value)
        learner = Learner(optax.apply_updates(learner.params, updates), state)
        info = SearchInfo(value, optax.tree.norm(gradient), ~finite)
        return (learner, sampler.redraw(key, i + 1, scenarios, posterior)), info

    begun = learner, sampler.draw(key, jnp.int32(0), posterior)
    (learner, _), info = jax.lax.scan(step, begun, jnp.arange(steps))
    return learner, info._replace(skipped=jnp.sum(info.skipped))


def searcher(problem: Problem) -> Searcher:
    """The searcher of a problem: its `run` is `search`, its learner's optimizer a `SearchState`."""

    def init(params: Params) -> SearchState:
        return SearchState(problem.optimizer.init(params), params, jnp.asarray(jnp.inf, float), jnp.zeros((), bool))

    return Searcher(init, partial(search, problem=problem))


def search(
    key: Key,
    learner: Learner,
    posterior: Params,
    *,
    problem: Problem,
    steps: int,
    first: Array | int = 0,
    earlier: Array | int = 0,
    fresh: Params | None = None,
) -> tuple[Learner, SearchInfo]:
    """The rows of iterations first .. first + steps - 1 of the problem's table, in the search after `earlier` others.

    One call of n steps and two calls of n/2, the second with first=n/2, do the same. `fresh` is the policy that a table
    may have as a candidate. All rows visit one objective: a second one would take as long again to compile. Raises
    ValueError for more iterations than the table has, and where its fresh policy is missing.
    """
    table, draw, redraw = problem.table, problem.sampler.draw, problem.sampler.redraw
    check(table, steps, fresh)
    rows, begin = of_search(table, earlier), first_rows(table)
    following = jnp.append(rows.scenarios[1:], rows.scenarios[-1:] + 1)  # no key is drawn from twice

    def visit(r: Array, loop: Loop) -> Loop:
        (params, state), info = loop.learner, loop.info
        row: SearchTable = jax.tree.map(lambda column: column[r], rows)
        scenarios = unpacked(loop.scenarios, drawn)
        others = params if fresh is None else fresh, state.start, state.start
        visited = jax.tree.map(lambda *those: jax.lax.select_n(row.candidate, *those), params, *others)
        value, gradient = jax.value_and_grad(problem.objective)(visited, posterior, scenarios, row)
        learner, cost, skipped = after(row, loop.learner, visited, value, gradient, problem.optimizer)
        i = row.iteration - first
        norm_of = jnp.where(row.action == STEP, i, steps)
        info = SearchInfo(
            info.objective.at[i].set(cost),
            info.gradient_norm.at[norm_of].set(optax.tree.norm(gradient), mode="drop"),
            info.skipped + skipped,
        )
        return Loop(learner, packed(redraw(key, following[r], scenarios, posterior)), info)

    drawn = draw(key, jnp.asarray(first, jnp.int32), posterior)
    none = jnp.full(steps, jnp.nan)
    loop = Loop(begun(learner, first, problem), packed(drawn), SearchInfo(none, none, jnp.int32(0)))
    row, end = (jnp.asarray(begin)[i] for i in (first, first + steps))
    count = steps if len(table.action) == len(begin) - 1 else end - row  # a known number is quicker on a GPU
    loop = jax.lax.fori_loop(0, count, lambda k, loop: visit(row + k, loop), loop)
    return loop.learner, loop.info


class Loop(NamedTuple):
    """What one row of a search hands to the next."""

    learner: Learner  # its optimizer is a SearchState
    scenarios: Scenarios  # packed
    info: SearchInfo


def check(table: SearchTable, steps: int, fresh: Params | None) -> None:
    """Raise ValueError where a table lacks what it is asked for, or what it needs."""
    if steps > (most := len(first_rows(table)) - 1):
        raise ValueError(f"steps={steps}: the table of this search has {most}")
    if fresh is None and FRESH in table.candidate:
        raise ValueError("the table has a fresh policy as a candidate, and fresh= is None; expected its parameters")


def of_search(table: SearchTable, earlier: Array | int) -> SearchTable:
    """The table [R] of the search after `earlier` others. Its numbers are data: no search compiles another program."""
    searches = len(table.limit)
    # Where all are alike there is no choice to make: of searches vmapped over `earlier` each would have its own.
    number = jnp.minimum(earlier, searches - 1) if searches > 1 else 0
    return SearchTable(*map(jnp.asarray, table[:-3]), *(jnp.asarray(column)[number] for column in table[-3:]))


def begun(learner: Learner, first: Array | int, problem: Problem) -> Learner:
    """The learner as the search has it: new at its iteration 0, later as it is."""
    begins, state = jnp.asarray(first) == 0, learner.optimizer
    fresh = problem.optimizer.init(learner.params) if problem.reset else state.optimizer
    optimizer, start = optax.tree.where(begins, (fresh, learner.params), (state.optimizer, state.start))
    return Learner(learner.params, state._replace(optimizer=optimizer, start=start))


def after(
    row: SearchTable,
    learner: Learner,
    visited: Params,
    value: Array,
    gradient: Params,
    optimizer: optax.GradientTransformation,
) -> tuple[Learner, Array, Array]:
    """What a row makes of the cost and gradient of what it visited -> (learner, cost of its parameters, skipped)."""
    (params, state), finite = learner, is_finite(gradient)
    # NaN decides for the older policy, a tie for the other one: where the cost is flat, nothing else leads away.
    older = ~(state.last < value)
    taken = jnp.stack([True, (value <= state.last) | state.no_improvement, older, older])[row.candidate]
    steps_now = row.action == STEP
    taken |= steps_now
    params = optax.tree.where(taken, visited, params)
    updates, moved = update_if(steps_now & finite, optimizer, gradient, Learner(params, state.optimizer), value=value)
    start = optax.tree.where(row.candidate >= START, params, state.start)
    state = SearchState(moved, start, value, jnp.where(row.candidate == START, taken, state.no_improvement))
    params = optax.apply_updates(params, optax.tree.scale(row.step_size, updates))
    return Learner(params, state), jnp.where(taken, value, learner.optimizer.last), steps_now & ~finite


def packed(scenarios: Params) -> Params:
    """As one iteration hands them to the next: noise [H, K, D] as [H, K D].

    A CPU's compiler draws an array in the shape it is kept in, and rows of six dimensions take it five times as
    long as rows of hundreds.
    """
    return jax.tree.map(lambda leaf: leaf.reshape(len(leaf), -1) if leaf.ndim > 2 else leaf, scenarios)


def unpacked(packed: Params, like: Params) -> Params:
    """The scenarios that were packed, in the shapes of `like`."""
    return jax.tree.map(lambda leaf, shaped: leaf.reshape(shaped.shape), packed, like)
