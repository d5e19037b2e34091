"""Config -> Experiment: the pieces that the settings name, or your own, composed."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from pegasus_jax import config as settings
from pegasus_jax import episode, tasks
from pegasus_jax.assembly.agreement import agree
from pegasus_jax.assembly.own_pieces import try_dynamics, try_policy, try_task
from pegasus_jax.assembly.pieces import dynamics_of, fit_of, policy_of
from pegasus_jax.assembly.searchers import fresh_policies, limits, refines_successes, search_of
from pegasus_jax.checks import ConfigError
from pegasus_jax.config_used import check_config
from pegasus_jax.experiment import Experiment, experiment
from pegasus_jax.imagine import visited
from pegasus_jax.learn.data import room
from pegasus_jax.models.residual import on_differences, residual
from pegasus_jax.policies.rate_limited import rate_limited
from pegasus_jax.sharding import over_particles
from pegasus_jax.task import Task, checked, known
from pegasus_jax.tasks.cost_check import traced
from pegasus_jax.tasks.remembered import remembering
from pegasus_jax.types import (
    Array,
    Cost,
    Dynamics,
    Key,
    ModelLearner,
    Policy,
    PolicyOptimizer,
)

EXPLORATIONS = {"uniform": episode.uniform, "walk": episode.random_walk}


def build(config: settings.Config, mesh: Mesh | None = None, logged: int = 0) -> Experiment:
    """The experiment of a config, with room for `logged` rows of data besides those of the trials.

    Cached: the same config, with any seed, gives the same functions, which compile once, and the same environment,
    which is opened once. Its functions have JAX's precision when they run: x64=True needs `jax_enable_x64`, which
    `train` and the commands set. Raises ConfigError for what is no config, and for a setting that its task does not
    use.
    """
    if not isinstance(config, settings.Config):
        raise ConfigError(f"build takes a Config, not a {type(config).__name__}; compose(config, task) takes both")
    check_config(config)
    return _built(replace(config, seed=0), mesh, logged)  # the seed is in the key that its functions are given


@lru_cache(maxsize=64)
def _built(config: settings.Config, mesh: Mesh | None, logged: int) -> Experiment:
    with tasks.outside():  # what is kept for other callers is of no program that is traced around this
        return assembled(config, _posed(config), mesh, logged)


@lru_cache(maxsize=64)
def _posed(config: settings.Config) -> Task:
    return tasks.of_config(config)


def compose(
    config: settings.Config,
    task: Task,
    *,
    dynamics: Dynamics | None = None,
    policy: Policy | None = None,
    fitter: ModelLearner | None = None,
    searcher: PolicyOptimizer | None = None,
    cost: Cost | Callable[..., Array] | None = None,
    mesh: Mesh | None = None,
    logged: int = 0,
) -> Experiment:
    """The experiment of a config on any task, with pieces of your own in place of the configured or the task's ones.

    A `cost` may be a function of one state x [D] and, by these names, of u, previous_u, t, reference, goal. A
    `searcher` improves the policy for `config.search.steps` steps; what is imagined after a search is as
    configured. There is room for `logged` rows of data besides those of the trials. Controls of a policy of your
    own beyond the task's limits are cut off at them, in imagination as on the plant. With a `mesh` (sharding.py)
    the particles of a search are spread over its devices. With x64=True set `jax_enable_x64`, as `train` does, before
    its functions run. Raises ConfigError for what is no piece, a task whose fields do not agree, a setting of what the
    task is that it is not, as another horizon, a constraint or sensors, and a piece that does not suit the
    config: moment matching, for example, needs more particles than states. A plant of your own that is late says so:
    `task._replace(late=2)` goes with `sensors.delay=2`.
    """
    _of_kinds(config=config, task=task, dynamics=dynamics, policy=policy, fitter=fitter, searcher=searcher)
    agree(config, task)
    pieces: dict[str, Any] = dict(dynamics=dynamics, policy=policy, fitter=fitter, searcher=searcher, cost=cost)
    made = assembled(config, task, mesh, logged, **pieces)
    if searcher is None:  # another may have no use for a gradient
        size = len(made.task.state_names) + len(made.task.memory.names)
        traced(made.task.cost.of_state, size, made.task.observed, "the cost")
    return made


def assembled(config: settings.Config, task: Task, mesh: Mesh | None, logged: int, **pieces: Any) -> Experiment:
    """`compose` with a task that may know less than its config, as that of a run's folder does."""
    names = ("dynamics", "policy", "fitter", "searcher", "cost")
    dynamics, policy, fitter, searcher, cost = (pieces.get(name) for name in names)
    task = checked(task._replace(cost=as_cost(task.cost)))
    try_task(task)
    task = remembering(config, task)
    task = tasks.augmented(task, None if cost is None else as_cost(cost))
    if dynamics is not None:
        try_dynamics(dynamics, task, capacity(config, task, logged), fits=fitter is None)
    if policy is not None:
        try_policy(policy, task, follows=searcher is None)
    dynamics = dynamics or dynamics_of(config.model, task)
    fitter = fitter or fit_of(config.fit, dynamics)
    if task.prior is not None:  # then all of that is of what the simulator gets wrong
        fitter = on_differences(fitter, task.prior, task.angles)
        dynamics = residual(dynamics, task.prior, angles=task.angles)
    visits, plain = bool(config.search.visited_starts) and searcher is None, dynamics
    dynamics = visited.remembering(dynamics) if visits else dynamics
    policy = policy_of(config.policy, task) if policy is None else within(policy, task)
    policy = rate_limited(policy._replace(memory=task.memory) if task.memory.names else policy, task)
    searching = search_of(config.search, task, dynamics, policy, over_particles(mesh))
    made = experiment(
        task=task,
        dynamics=dynamics,
        policy=policy,
        fit=fitter,
        fit_steps=config.fit.steps,
        search=searcher or searching.searcher,
        search_steps=config.search.steps,
        imagine=searching.imagine,
        expect=searching.expect if visits else None,
        remember=partial(visited.remember, angles=task.angles, varies=known(task, "start_std") > 0) if visits else None,
        explore=explore_of(config.explore, task),
        explore_trials=config.explore.trials,
        first_search=settings.first_search(config) if task.prior is None else config.explore.trials,
        num_fresh=fresh_policies(config.search) if searcher is None else 2,
        refine_successes=searcher is None and refines_successes(config.search),
        begun=settings.begins_with(config, "policy"),
        compare=config.successor == "better",
        capacity=capacity(config, task, logged),
    )
    return made._replace(dynamics=plain)  # for others to use: with `visits` the search has another posterior


def capacity(config: settings.Config, task: Task, logged: int = 0) -> int:
    """Rows that the data set of a config's run has room for: at least those of all trials, and `logged` ones."""
    rows = config.trials * task.horizon + logged
    # A fit of all rows, or a Gaussian process, takes longer for each row that it has room for: it has none too many.
    every = isinstance(config.fit, settings.LBFGS) or isinstance(config.model, settings.GP | settings.SSGP)
    return rows if every else room(rows)


def explore_of(explore: settings.Explore, task: Task) -> Callable[[Key], Array]:
    """The controls [H, U] of an exploring episode of a key; beside a task's `guide` those that are added to its own."""
    low, high = limits(task)
    plan = partial(EXPLORATIONS[explore.kind], low=low, high=high, horizon=task.horizon)
    amplitude = explore.amplitude
    if task.guide is not None:
        return lambda key: episode.gently(plan(key), amplitude or 0.0, low, high) - jnp.clip(0.0, low, high)
    return plan if amplitude is None else lambda key: episode.gently(plan(key), amplitude, low, high)


PIECES = {
    "config": settings.Config,
    "task": Task,
    "dynamics": Dynamics,
    "policy": Policy,
    "fitter": ModelLearner,
    "searcher": PolicyOptimizer,
}
HELPS = {"config": "; preset(NAME) makes one", "task": "; tasks.make(NAME) makes one"} | {
    "fitter": "; minibatches(dynamics, optimizer, batch_size=) makes one",
    "policy": "; of_pair makes one",
}


def _of_kinds(**pieces: Any) -> None:
    """Raises ConfigError for a piece of another kind: one of optax, for example, has an `init`, too."""
    for name, piece in pieces.items():
        needed = name in ("config", "task")
        if (needed or piece is not None) and not isinstance(piece, kind := PIECES[name]):
            fields = "" if needed else f"({', '.join(kind._fields)})"
            expected = f"pegasus_jax.{kind.__name__}{fields}{HELPS.get(name, '')}"
            raise ConfigError(f"{name}={type(piece).__name__} is no {kind.__name__}; expected {expected}")


def within(policy: Policy, task: Task) -> Policy:
    """The policy, whose controls are cut off at the task's limits."""
    low, high = limits(task)

    def apply(*given: Any) -> Array:
        u = policy.apply(*given)
        return jnp.clip(u, low, high) if jnp.shape(u) == low.shape else u  # else who asked for it names the shape

    return policy._replace(apply=apply)


def as_cost(cost: Cost | Callable[..., Array]) -> Cost:
    """The cost itself, or that of a function of one state x [D]. Raises ConfigError for what is neither."""
    if not isinstance(cost, Cost) and not callable(cost):
        raise ConfigError(f"cost={cost!r} is no Cost; expected one, or a function of one state x [D]")
    return cost if isinstance(cost, Cost) else Cost(cost)


def set_precision(config: settings.Config) -> None:
    """Make the configured precision JAX's own, for everything in this process from now on.

    That of products too, unless JAX was told: a GPU's usual 10 bits are too few for gradients of a whole rollout.
    """
    jax.config.update("jax_enable_x64", config.x64)
    if jax.default_backend() == "gpu" and jax.config.jax_default_matmul_precision is None:  # pyright: ignore[reportAttributeAccessIssue]
        jax.config.update("jax_default_matmul_precision", "float32")
