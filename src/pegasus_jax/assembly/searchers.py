"""How a search's settings become a searcher, and fresh imagined rollouts of the same kind."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from pegasus_jax import config as settings
from pegasus_jax import tasks
from pegasus_jax.assembly.schedules import at_starts, init_of, scale_for, table_of, width_of
from pegasus_jax.checks import ConfigError
from pegasus_jax.imagine import costs, matching, scenarios
from pegasus_jax.imagine import limits as constraints
from pegasus_jax.imagine.matching import either
from pegasus_jax.imagine.objective import objective
from pegasus_jax.imagine.rollout import NoiseUse, rollout
from pegasus_jax.imagine.visited import beside_visited, longest, started
from pegasus_jax.learn.multistart import best_of
from pegasus_jax.learn.schedule import SearchTable, search_table
from pegasus_jax.learn.search import Problem, searcher
from pegasus_jax.memory import begin, steps
from pegasus_jax.pilco import search as pilco
from pegasus_jax.sharding import Spread, together
from pegasus_jax.task import Task
from pegasus_jax.tasks.starts import start
from pegasus_jax.types import (
    Array,
    Cost,
    Dynamics,
    Key,
    Params,
    Period,
    Policy,
    PolicyOptimizer,
    Rollout,
    Scenarios,
    TrainState,
)


class Matching(NamedTuple):
    """What search.matching names, for the angles of a task."""

    particles: Callable[[tuple[int, ...]], matching.Match]  # what becomes of the particles of each step
    cost: Callable[[Cost, tuple[int, ...]], Callable[[Array], Array]]  # -> costs [H, K] or [H, 1] of x [H, K, D]


MATCHINGS = {
    "always": Matching(lambda _: matching.match, lambda of, _: costs.of_matched(of)),
    "narrow": Matching(matching.narrow, costs.of_narrow),
    "never": Matching(lambda _: matching.keep, lambda of, _: costs.of_matched(of)),
}

# What an episode keeps, such as a goal, is not to be redrawn, nor averaged over before the cost is.
UNMATCHED = Matching(lambda _: matching.keep, lambda of, _: costs.of_particles(of))

# (key, policy parameters, posterior) -> (rollout, cost [H, K])
Imagine = Callable[[Key, Params, Params], tuple[Rollout, Array]]


class Searching(NamedTuple):
    """What a search's settings say."""

    searcher: PolicyOptimizer
    imagine: Imagine  # fresh rollouts from the task's starts
    # (key, policy parameters, posterior) -> cost a step [] where the search's rollouts start; None: as `imagine`
    expect: Callable[[Key, Params, Params], Array] | None = None


def search_of(
    search: settings.Search | settings.Analytic,
    task: Task,
    dynamics: Dynamics,
    policy: Policy,
    spread: Spread = together,
) -> Searching:
    """The configured way of improving a policy, and fresh imagined rollouts of the same kind.

    With `search.visited_starts` the posterior of `dynamics` is a `Visited`.
    """
    known = tasks.known_sensors(task) if search.observation_noise == "plant" else None
    noise = NoiseUse(search.policy_noise, search.state_noise, known)
    if isinstance(search, settings.Analytic):
        return analytic_search_of(search, task, dynamics, policy, noise)
    check_particles(search, task)
    blocks = blocks_of(
        search.particles, task, dynamics, policy, standardized_noise=search.standardized_noise, spread=spread
    )
    searched = blocks
    if search.visited_starts:
        around = jnp.asarray(task.start_mean, float)
        searched = blocks._replace(start=beside_visited(blocks.start, search.visited_starts, task.angles, around))
    pieces: dict[str, Any] = dict(policy=policy, noise=noise)
    pieces["dynamics"] = constraints.absorbing(dynamics, task.constraint, task.stop)
    # A particle's cost is 1 / K of the objective.
    limit = None if (most := search.particle_grad_limit) is None else most / search.particles
    objective_of, ascend = objective, None
    if (constraint := task.constraint) is not None:
        objective_of = partial(constraints.constrained, constraint=constraint)
        ascend = partial(constraints.ascend, bound=constraint.bound)
    match = matching_of(search, task).particles(task.angles)
    cost_for = costs_of(search, task)
    refines = search.refine_fraction > 0
    start_costs = cache(partial(at_starts, task))

    @cache
    def table() -> SearchTable:
        return table_of(search, width_of(search, start_costs))

    def value(params: Params, posterior: Params, given: Scenarios, row: SearchTable, *weight: Array) -> Any:
        # What no row asks for is not compiled.
        refining, widens = row.refine if refines else None, (table().cost_width != 1).any() or table().holds.any()
        longest_gradient = None if limit is None else limit * row.limit
        if search.visited_starts:
            given = started(given, row.refine)
            refining = refining | posterior.goal  # a goal is not to be redrawn either
            if limit is None:
                longest_gradient = scale_for(start_costs()) * longest(posterior, search.particles)
        return objective_of(
            params,
            posterior,
            given,
            *weight,
            **pieces,
            limit=longest_gradient,
            match=either(refining, matching.keep, match),  # a refinement uses neither matching nor an expected cost
            cost=cost_for(refining, row.cost_width if widens else None),
        )

    clip = optax.identity() if search.grad_clip is None else optax.clip_by_global_norm(search.grad_clip)
    optimizer = optax.chain(clip, optax.adam(search.learning_rate))
    draws = scenarios.sampler(searched, Period(**vars(search.period)))
    more: dict[str, Any] = dict(reset_optimizer=search.reset_optimizer, ascend=ascend)
    found = tabled(init_of(search), table, lambda rows: searcher(Problem(value, draws, optimizer, rows, **more)))
    # A refined policy is made for the particles themselves, not for their Gaussian.
    imagine = partial(imagined, **pieces, match=matching.keep if refines else match, task=task)
    if search.num_starts > 1:
        judge = None if constraint is None else partial(judged, imagine=partial(imagine, blocks=blocks), task=task)
        lasting = search.anneal_trials > 1  # one schedule over all searches: a later member would miss its start
        # A refinement may end with another policy than that of its last step.
        window = 1 if search.refine_fraction else max(1, search.steps // 20)
        found = best_of(found, num_starts=search.num_starts, window=window, lasting=lasting, judge=judge)
    if not search.visited_starts:
        return Searching(found, partial(imagine, blocks=blocks))
    mixed = blocks._replace(start=lambda *given: searched.start(*given).mixed)
    return Searching(found, partial(imagine, blocks=blocks), lambda *given: jnp.mean(imagine(*given, blocks=mixed)[1]))


def check_particles(search: settings.Search, task: Task) -> None:
    """Raises ConfigError where moment matching, or standardized noise, needs more particles."""
    matches = matching_of(search, task) not in (UNMATCHED, MATCHINGS["never"])
    states = len(task.state_names) + len(task.memory.names)
    if (matches or search.standardized_noise) and search.particles <= states:
        what = "moment matching" if matches else "standardized noise"
        raise ConfigError(
            f"search.particles={search.particles} is too few: {what} of {states} dimensions needs more particles than"
            f" dimensions; the nearest is search.particles={states + 1}"
        )


def judged(key: Key, members: Params, posterior: Params, *, imagine: Imagine, task: Task) -> Array:
    """Ranks [N] of policies with parameters `members` [N, ...] under the same fresh scenarios: the lowest is best."""
    constraint = task.constraint
    rolled, cost = jax.vmap(imagine, (None, 0, None))(key, members, posterior)
    chance = jax.vmap(partial(constraints.probability, constraint=constraint))(rolled.x)
    return constraints.ranked(jnp.mean(cost, (1, 2)), chance, bound=constraint.bound)


def matching_of(search: settings.Search, task: Task) -> Matching:
    """What search.matching names, where the task's memory can be matched, and no constraint asks for trajectories."""
    return MATCHINGS[search.matching] if task.memory.matched and task.constraint is None else UNMATCHED


def tabled(
    init: str, table: Callable[[], SearchTable], searches: Callable[[SearchTable], PolicyOptimizer]
) -> PolicyOptimizer:
    """The searcher of a table that is made when a search needs it: a controller alone has no cost to look at."""

    def run(*given: Any, **where: Any) -> tuple[TrainState, Any]:
        return searches(table()).run(*given, **where)

    like = search_table(8, init=init, refine=8)  # of another length, with a race where the real one has it
    return PolicyOptimizer(searches(like).init, run)


def fresh_policies(search: settings.Search | settings.Analytic) -> int:
    """How many untrained policies a search is given: two for a race, or all but the given one side by side."""
    return max(2, search.num_starts - 1) if isinstance(search, settings.Search) else 2


def refines_successes(search: settings.Search | settings.Analytic) -> bool:
    """Whether a search after an episode that succeeded may only refine: several policies need all of it."""
    return isinstance(search, settings.Search) and search.num_starts == 1 and search.refine_fraction > 0


def analytic_search_of(
    search: settings.Analytic,
    task: Task,
    dynamics: Dynamics,
    policy: Policy,
    noise: NoiseUse,
) -> Searching:
    """PILCO's search. Raises ConfigError where a piece has no moments."""
    if task.stop is not None:
        raise ConfigError("algorithm=pilco propagates a Gaussian, which cannot stop; leave out stop=")
    if task.memory.names:
        raise ConfigError(
            "algorithm=pilco propagates a Gaussian of the state alone; what is remembered beside it"
            f" ({', '.join(task.memory.names[:3])}, ...) needs another algorithm="
        )
    if task.constraint is not None:
        raise ConfigError("algorithm=pilco propagates a Gaussian, which has no trajectories; leave out constraint=")
    if dynamics.moments is None:
        raise ConfigError("algorithm=pilco needs a model with analytic moments: model=ssgp, model=gp")
    if policy.moments is None:
        raise ConfigError(
            "algorithm=pilco needs a policy with analytic moments, saturated by sines: policy=rbf, policy=linear"
        )
    low, high = limits(task)
    pieces: dict[str, Any] = dict(dynamics=dynamics, policy=policy)

    def begin() -> tuple[Array, Array]:  # in the precision of the program, not in that of who builds it
        return jnp.asarray(task.start_mean, float), jnp.diag(jnp.asarray(task.start_std, float) ** 2)

    def noise_std(key: Key, posterior: Params) -> Array:
        middle = (low + high) / 2
        return dynamics.apply(posterior, dynamics.sample(key, posterior), begin()[0], middle).std

    def value(params: Params, posterior: Params, std: Array) -> Array:
        return pilco.objective(
            params,
            posterior,
            begin(),
            std,
            **pieces,
            horizon=task.horizon,
            angles=task.angles,
            cost=task.cost,
            noise=noise,
        )

    blocks = blocks_of(search.particles, task, dynamics, policy)
    imagine = partial(imagined, **pieces, blocks=blocks, task=task, match=matching.keep, noise=noise)
    return Searching(pilco.analytic(value, noise_std, restart=search.init == "better"), imagine)


def costs_of(search: settings.Search, task: Task) -> Callable[[Array | None, Array | None], Callable[[Array], Array]]:
    """(whether this refines, a factor of the cost's width; None: never) -> costs [H, K] or [H, 1] of x [H, K, D]."""

    def cost_for(refining: Array | None, width: Array | None) -> Callable[[Array], Array]:
        now = task.cost if width is None else costs.widened(task.cost, width)
        if search.cost_estimator != "gaussian":
            return until_stop(task, costs.of_particles(now))
        matched = matching_of(search, task).cost(now, task.angles)
        return until_stop(task, either(refining, costs.of_particles(now), matched))

    return cost_for


def until_stop(task: Task, cost_of: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """The costs of particles that end where the task's episodes do."""
    if task.stop is None:
        return cost_of
    return lambda x: costs.until_stop(cost_of(x), x, task.stop, task.stop_cost)  # type: ignore[arg-type]


def blocks_of(
    particles: int,
    task: Task,
    dynamics: Dynamics,
    policy: Policy,
    standardized_noise: bool = False,
    spread: Spread = together,
) -> scenarios.Blocks:
    """How the scenarios of a task's imagined rollouts are drawn."""
    return scenarios.blocks(
        dynamics=dynamics,
        policy=policy,
        start=partial(start, task=task),
        particles=particles,
        horizon=task.horizon,
        standardized_noise=standardized_noise,
        spread=spread,
    )


def imagined(
    key: Key,
    params: Params,
    posterior: Params,
    *,
    blocks: scenarios.Blocks,
    task: Task,
    **pieces: Any,
) -> tuple[Rollout, Array]:
    """Rollouts under fresh scenarios and the cost of every particle [H, K]."""
    rolled = rollout(params, posterior, scenarios.draw(key, 0, posterior, blocks=blocks, period=Period()), **pieces)
    return rolled, until_stop(task, costs.of_particles(task.cost))(rolled.x[1:])


def first_seen(key: Key, *, task: Task) -> Array:
    """What the policy sees [P] first, in an episode of the task."""
    x, (see, *_) = start(key, task=task), steps(task.memory)
    return see(begin(task.memory, key, x), x)


def limits(task: Task) -> tuple[Array, Array]:
    """The lowest and the highest control [U]."""
    return jnp.asarray(task.control_low, float), jnp.asarray(task.control_high, float)
