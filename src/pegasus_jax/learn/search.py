"""Policy search: follow the gradient of the imagined cost under held scenarios (Alg. 3)."""

from collections.abc import Callable
from functools import partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from pegasus_jax.imagine import costs
from pegasus_jax.imagine.rollout import NoiseUse, rollout
from pegasus_jax.imagine.scenarios import Blocks, draw, redraw
from pegasus_jax.learn.fit import guarded, skipped
from pegasus_jax.learn.schedule import Course
from pegasus_jax.types import Array, Dynamics, Key, Learner, Params, Period, Policy, Scenarios, Searcher


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
        kept = optax.tree.where(better, params, state.best_params)
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
        limit=limit,
    )
    return aggregate(cost(imagined.x[1:]))


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


class Walk(NamedTuple):
    """Where a search is. Where it weighs, an iteration is three visits: of the rival, of its own parameters, a step."""

    learner: Learner
    scenarios: Scenarios  # packed
    iteration: Array  # [] int32
    visit: Array  # [] RIVAL, OWN or STEP
    held: Array  # [] what the rival costs
    values: Array  # [steps]
    norms: Array  # [steps]


RIVAL, OWN, STEP = range(3)


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
    rival: Params | None = None,
    reset: bool = False,
) -> tuple[Learner, SearchInfo]:
    """Iterations first .. first + steps - 1 of a search (Alg. 3 lines 4 to 19).

    One call of n steps and two calls of n/2, the second with first=n/2, do the same. With a stage in the `course`, the
    objective takes one more argument, the stage of the iteration; a course with turns needs a `started` optimiser.
    The course counts from `earlier`: the iterations of the searches before this one, where it goes on with theirs.

    Iteration 0 goes on from the `rival`, if there is one, where that costs no more than the learner's parameters, where
    the search before was stale, or where the course says so; with `reset`, with a new optimiser. At a turn, the end
    among them, a search goes on from what it started from, or had at the turn before, unless what it has now costs
    less. NaN decides for the older ones. What is weighed visits the loop's own objective: another one would take as
    long again to compile.
    """
    optimizer = optax.with_extra_args_support(optimizer)
    weighs = bool(course.turns) or rival is not None
    stale = optax.tree.get(learner.optimizer, "stale", False)
    if reset:
        anew = lambda old: old._replace(optimizer=optimizer.init(old.params))  # noqa: E731
        learner = jax.lax.cond(first == 0, anew, lambda old: old, learner)
    if course.turns:
        start = optax.tree.where(first == 0, learner.params, optax.tree.get(learner.optimizer, "start"))
        learner = learner._replace(optimizer=optax.tree.set(learner.optimizer, start=start))

    def turns(i: Array) -> Array:
        # One by one: jaxlib 0.11 crashes on an array of no turns where seeds are shared out over devices.
        return reduce(jnp.logical_or, [i == turn for turn in course.turns], jnp.zeros((), bool))

    def other(learner: Learner, i: Array) -> Params:
        """What the learner's parameters are weighed against."""
        if not course.turns:
            return rival
        start = optax.tree.get(learner.optimizer, "start")
        return start if rival is None else optax.tree.where(i == 0, rival, start)

    def visit(_: Array, walk: Walk) -> Walk:
        learner, i = walk.learner, walk.iteration
        scenarios = unpacked(walk.scenarios, like=drawn)
        params = optax.tree.where(walk.visit == RIVAL, other(learner, i), learner.params) if weighs else learner.params
        value, gradient = jax.value_and_grad(objective)(params, belief, scenarios, *course.at(earlier + i))
        steps_now, after = walk.visit == STEP, stepped(learner, i, value, gradient)
        if weighs:
            after = optax.tree.where(
                steps_now, after, optax.tree.where(walk.visit == OWN, chosen(walk, value), learner)
            )
        # Of an iteration after which it turned, the cost of what it goes on from.
        settles = (walk.visit == OWN) & (i > 0)
        row = jnp.where(steps_now, i - first, jnp.where(settles, i - first - 1, steps))
        cost = jnp.where(settles & ~(value < walk.held), walk.held, value)
        reached = i + steps_now
        return Walk(
            after,
            packed(redraw(key, reached, scenarios, belief)),
            reached,
            jnp.where(steps_now, jnp.where(turns(reached), RIVAL, STEP), walk.visit + 1),
            value,
            walk.values.at[row].set(cost, mode="drop"),
            walk.norms.at[jnp.where(steps_now, row, steps)].set(optax.tree.norm(gradient), mode="drop"),
        )

    def stepped(learner: Learner, i: Array, value: Array, gradient: Params) -> Learner:
        # A wider cost is a lower one: its value says nothing about which parameters are best.
        known = jnp.where(i < course.settled, jnp.inf, value) if course.settled else value
        updates, state = optimizer.update(gradient, learner.optimizer, learner.params, value=known)
        if course.pace is not None:
            updates = optax.tree.scale(course.pace(earlier + i), updates)
        return Learner(optax.apply_updates(learner.params, updates), state)

    def chosen(walk: Walk, value: Array) -> Learner:
        """The learner at its own parameters, which cost `value`, or at the rival's."""
        learner, i = walk.learner, walk.iteration
        begins = i == 0
        yields = jnp.where(begins, (walk.held <= value) | stale | course.anew, ~(value < walk.held))
        kept = Learner(optax.tree.where(yields, other(learner, i), learner.params), learner.optimizer)
        if not course.turns:
            return kept
        was = optax.tree.get(learner.optimizer, "stale")
        now = dict(
            start=optax.tree.where(begins, optax.tree.get(learner.optimizer, "start"), kept.params),
            stale=jnp.where(~begins & (i == course.turns[0]), yields, was),
        )
        return kept._replace(optimizer=optax.tree.set(learner.optimizer, **now))

    begun, before = jnp.asarray(first, jnp.int32), skipped(learner.optimizer)
    drawn = draw(key, begun, belief)
    begins = rival is not None and first == 0
    weighings = begins + sum((first < turn) & (turn <= first + steps) for turn in {*course.turns})
    none = jnp.full(steps, jnp.nan)
    walk = Walk(learner, packed(drawn), begun, jnp.where(begins, RIVAL, STEP), none[0], none, none)
    learner, *_, values, norms = jax.lax.fori_loop(0, steps + 2 * weighings, visit, walk)
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
        kept = optax.tree.where(first + steps >= last, best, learner.params)
        return learner._replace(params=kept), info

    return searcher._replace(run=run)
