"""Policy search: follow the gradient of the imagined cost under held scenarios (Alg. 3)."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from pegasus_jax import cost as costs
from pegasus_jax.course import Course
from pegasus_jax.fit import guarded, skipped
from pegasus_jax.rollout import NoiseUse, rollout
from pegasus_jax.scenarios import Blocks, draw, redraw
from pegasus_jax.types import Array, Begin, Dynamics, Key, Learner, Params, Period, Policy, Scenarios, Searcher


class Remembering(NamedTuple):
    """State of an optimiser that remembers the best parameters it has seen."""

    inner_state: optax.OptState
    best_value: Array  # [] the lowest objective so far
    best_params: Params  # that had it


def remembering(optimizer: optax.GradientTransformation) -> optax.GradientTransformationExtraArgs:
    """The optimiser, which also remembers the parameters with the lowest `value`; see `keeping_best`."""
    optimizer = optax.with_extra_args_support(optimizer)

    def init(params: Params) -> Remembering:
        return Remembering(optimizer.init(params), jnp.full((), jnp.inf), params)

    def update(updates: Params, state: Any, params: Params = None, *, value: Array, **extra: Any) -> tuple[Params, Any]:
        updates, inner = optimizer.update(updates, state.inner_state, params, value=value, **extra)
        better = value < state.best_value
        kept = jax.tree.map(partial(jnp.where, better), params, state.best_params)
        return updates, Remembering(inner, jnp.where(better, value, state.best_value), kept)

    return optax.GradientTransformationExtraArgs(init, update)  # type: ignore[arg-type]


class SearchInfo(NamedTuple):
    """How a search went, iteration by iteration."""

    objective: Array  # [steps]; of an iteration after which it turned, that of the policy it went on with
    gradient_norm: Array  # [steps] before clipping
    skipped: Array  # [] updates skipped because a gradient was not finite


def objective(
    policy_params: Params,
    belief: Params,
    scenarios: Scenarios,
    *,
    dynamics: Dynamics,
    policy: Policy,
    match: Callable[[Array, Array], Array],
    cost: Callable[[Array], Array],
    aggregate: Callable[[Array], Array] = costs.mean,
    noise: NoiseUse = NoiseUse(),
    truncate: int | None = None,
    limit: Array | float | None = None,
) -> Array:
    """J(theta) (Alg. 3 line 15): cost [H, K, D] -> [H, K] of the rollout's states, made one number by `aggregate`."""
    imagined = rollout(
        policy_params,
        belief,
        scenarios,
        dynamics=dynamics,
        policy=policy,
        match=match,
        noise=noise,
        truncate=truncate,
        limit=limit,
    )
    return aggregate(cost(imagined.seen))


class Started(NamedTuple):
    """State of an optimiser that remembers where it started, and whether that led anywhere."""

    inner_state: optax.OptState
    start: Params
    stale: Array  # [] whether the search went back to where it had started when it first turned


def started(optimizer: optax.GradientTransformation) -> optax.GradientTransformationExtraArgs:
    """The optimiser, which also keeps the parameters that a search, or its part after a turn, started from."""
    optimizer = optax.with_extra_args_support(optimizer)

    def update(updates: Params, state: Any, params: Params = None, **extra: Any) -> tuple[Params, Any]:
        updates, inner = optimizer.update(updates, state.inner_state, params, **extra)
        return updates, state._replace(inner_state=inner)

    def init(params: Params) -> Started:
        return Started(optimizer.init(params), params, jnp.zeros((), bool))

    return optax.GradientTransformationExtraArgs(init, update)  # type: ignore[arg-type]


def optimise(
    key: Key,
    learner: Learner,
    belief: Params,
    *,
    draw: Callable[[Key, Array, Params], Scenarios],
    redraw: Callable[[Key, Array, Scenarios, Params], Scenarios],
    objective: Callable[..., Array],
    optimizer: optax.GradientTransformation,
    steps: int,
    first: Array | int = 0,
    earlier: Array | int = 0,
    course: Course = Course(),
    begin: Begin | None = None,
) -> tuple[Learner, SearchInfo]:
    """Iterations first .. first + steps - 1 of a search (Alg. 3 lines 4 to 19).

    One call of n steps and two calls of n/2, the second with first=n/2, do the same. With a stage in the `course`, the
    objective takes one more argument, the stage of the iteration; a course with turns needs a `started` optimiser.
    The course counts from `earlier`: the iterations of the searches before this one, where it goes on with theirs.
    """
    first = jnp.asarray(first, jnp.int32)
    optimizer = optax.with_extra_args_support(optimizer)

    def step(carry: tuple[Learner, Scenarios], i: Array) -> tuple[tuple[Learner, Scenarios], tuple[Array, Array]]:
        learner, scenarios = carry[0], unpacked(carry[1], like=drawn)
        value, gradient = jax.value_and_grad(objective)(learner.params, belief, scenarios, *course.at(earlier + i))
        # A wider cost is a lower one: its value says nothing about which parameters are best.
        known = jnp.where(i < course.settled, jnp.inf, value) if course.settled else value
        updates, state = optimizer.update(gradient, learner.optimizer, learner.params, value=known)
        if course.pace is not None:
            updates = optax.tree.scale(course.pace(earlier + i), updates)
        learner = Learner(optax.apply_updates(learner.params, updates), state)
        scenarios = redraw(key, i + 1, scenarios, belief)
        if course.turns:
            turns = jnp.any(i + 1 == jnp.asarray(course.turns))
            onwards = lambda learner, value, *_: (learner, value)  # noqa: E731
            learner, value = jax.lax.cond(turns, better, onwards, learner, value, scenarios, i + 1)
        return (learner, packed(scenarios)), (value, optax.tree.norm(gradient))

    def better(learner: Learner, _: Array, scenarios: Scenarios, i: Array) -> tuple[Learner, Array]:
        """The learner at its parameters, or at those it was given or had at the turn before, and what it costs.

        A tie, or NaN, goes to the older ones.
        """
        old = optax.tree.get(learner.optimizer, "start")
        both = jax.tree.map(lambda *leaves: jnp.stack(leaves), old, learner.params)
        of_old, of_new = jax.lax.map(lambda params: objective(params, belief, scenarios, *course.at(i)), both)
        kept = jax.tree.map(partial(jnp.where, of_new < of_old), learner.params, old)
        stale = jnp.where(i == course.turns[0], ~(of_new < of_old), optax.tree.get(learner.optimizer, "stale"))
        optimizer = optax.tree.set(learner.optimizer, start=kept, stale=stale)
        return Learner(kept, optimizer), jnp.where(of_new < of_old, of_new, of_old)

    drawn = draw(key, first, belief)
    given = learner.params
    if begin is not None:
        stage = course.at(earlier)
        learner = at_first(first, begin, learner, lambda params: objective(params, belief, drawn, *stage))
    if course.turns:
        kept = jax.tree.map(partial(jnp.where, first == 0), given, optax.tree.get(learner.optimizer, "start"))
        learner = learner._replace(optimizer=optax.tree.set(learner.optimizer, start=kept))
    before = skipped(learner.optimizer)
    (learner, _), (values, norms) = jax.lax.scan(step, (learner, packed(drawn)), first + jnp.arange(steps))
    return learner, SearchInfo(values, norms, skipped(learner.optimizer) - before)


def packed(scenarios: Params) -> Params:
    """As one iteration hands them to the next: noise [H, K, D] as [H, K D].

    A processor's compiler draws an array in the shape it is kept in, and rows of six dimensions take it five times as
    long as rows of hundreds.
    """
    return jax.tree.map(lambda leaf: leaf.reshape(len(leaf), -1) if leaf.ndim > 2 else leaf, scenarios)


def unpacked(packed: Params, like: Params) -> Params:
    """The scenarios that were packed, in the shapes of `like`."""
    return jax.tree.map(lambda leaf, shaped: leaf.reshape(shaped.shape), packed, like)


def at_first(first: Array | int, begin: Begin, learner: Learner, value: Callable[[Params], Array]) -> Learner:
    """What a search that goes on from iteration `first` starts from: of iteration 0, what `begin` makes of the learner.

    `value` is the objective of iteration 0. `begin` also hears whether the search before was stale.
    """
    stale = optax.tree.get(learner.optimizer, "stale", jnp.zeros((), bool))
    return jax.lax.cond(jnp.asarray(first) == 0, lambda old: begin(old, value, stale), lambda old: old, learner)


def particles(
    objective: Callable[..., Array],
    optimizer: optax.GradientTransformation,
    *,
    blocks: Blocks,
    period: Period,
    course: Course = Course(),
) -> Searcher:
    """The searcher that follows the gradient of `objective` under scenarios drawn from `blocks`, held for `period`."""
    optimizer = guarded(started(optimizer) if course.turns else optimizer)
    pieces: dict[str, Any] = dict(
        draw=partial(draw, blocks=blocks, period=period),
        redraw=partial(redraw, blocks=blocks, period=period),
        objective=objective,
        optimizer=optimizer,
        course=course,
    )
    return Searcher(init=optimizer.init, run=partial(optimise, **pieces))


def keeping_best(searcher: Searcher, last: int) -> Searcher:
    """The searcher that ends a trial's search of `last` iterations with the best parameters it met, not the last.

    Its optimiser must be `remembering`. Values are compared as they are, like the authors' option to return the best:
    with redrawn scenarios each is noisy, so the lowest is partly luck, and not as good as it looks.
    """

    def run(
        key: Key, learner: Learner, belief: Params, *, first: Array | int, steps: int, **more: Any
    ) -> tuple[Learner, Any]:
        known = optax.tree.get(learner.optimizer, "best_value")
        known = jnp.where(jnp.asarray(first) == 0, jnp.inf, known)  # what an older model thought does not count
        learner = learner._replace(optimizer=optax.tree.set(learner.optimizer, best_value=known))
        learner, info = searcher.run(key, learner, belief, first=first, steps=steps, **more)
        best = optax.tree.get(learner.optimizer, "best_params")
        kept = jax.tree.map(partial(jnp.where, first + steps >= last), best, learner.params)
        return learner._replace(params=kept), info

    return searcher._replace(run=run)
