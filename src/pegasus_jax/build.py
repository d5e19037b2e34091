"""Config -> Experiment. The only place that matches on the kind of a setting."""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import optax

from pegasus_jax import angles, cost, dropout, episode, moments, scenarios, tasks, trial
from pegasus_jax import config as settings
from pegasus_jax.dynamics.bnn import HEADS, bnn
from pegasus_jax.dynamics.ensemble import ensemble
from pegasus_jax.fit import minibatches
from pegasus_jax.policy.mlp import mlp
from pegasus_jax.policy.squash import SQUASHES, to_limits
from pegasus_jax.rollout import NoiseUse, rollout
from pegasus_jax.search import objective, particles
from pegasus_jax.types import (
    Array,
    Dropout,
    Dynamics,
    Experiment,
    Fitter,
    Key,
    Params,
    Period,
    Policy,
    Rollout,
    Searcher,
    Task,
)

AGGREGATES = {"mean": cost.mean, "total": cost.total}
EXPLORATIONS = {"uniform": episode.uniform, "walk": episode.random_walk}


@lru_cache(maxsize=64)
def build(config: settings.Config) -> Experiment:
    """The experiment of a config. Cached: the same config gives the same functions, which compile once."""
    return compose(config, tasks.of_config(config))


def compose(
    config: settings.Config, task: Task, dynamics: Dynamics | None = None, policy: Policy | None = None
) -> Experiment:
    """The experiment of a config on any task; a model or policy of your own takes the configured one's place."""
    dynamics = dynamics or dynamics_of(config.model, task)
    policy = policy or policy_of(config.policy, task)
    searcher, imagine = search_of(config.search, task, dynamics, policy)
    low, high = limits(task)
    explore = config.explore
    return trial.experiment(
        task=task,
        dynamics=dynamics,
        policy=policy,
        fit=fit_of(config.fit, dynamics),
        fit_steps=config.fit.steps,
        search=searcher,
        search_steps=config.search.steps,
        search_reset=config.search.reset,
        search_restart=config.search.restart,
        imagine=imagine,
        explore=partial(EXPLORATIONS[explore.kind], low=low, high=high, horizon=task.horizon),
        explore_trials=explore.trials,
        mean_execution=config.policy.execution == "mean",
        capacity=config.trials * task.horizon,
    )


def set_precision(config: settings.Config) -> None:
    """Make the configured precision JAX's own, for everything in this process from now on."""
    jax.config.update("jax_enable_x64", config.precision == "double")


def limits(task: Task) -> tuple[Array, Array]:
    """The lowest and the highest control [U]."""
    return jnp.asarray(task.control_low, float), jnp.asarray(task.control_high, float)


def fit_of(config: settings.Fit, dynamics: Dynamics) -> Fitter:
    """The configured way of fitting a model."""
    return minibatches(dynamics, optax.adam(config.learning_rate), batch=config.batch, reset=config.reset)


Imagine = Callable[[Key, Params, Params], tuple[Rollout, Array]]  # (key, policy parameters, belief) -> cost [H, K] too


def search_of(search: settings.Search, task: Task, dynamics: Dynamics, policy: Policy) -> tuple[Searcher, Imagine]:
    """The configured way of improving a policy, and fresh imagined rollouts of the same kind."""
    if (search.match or search.balanced) and search.particles <= len(task.state_names):
        states, what = len(task.state_names), "moment matching" if search.match else "balanced draws"
        raise settings.SettingError(
            f"search.particles={search.particles} is too few: {what} of {states} dimensions needs at least {states + 1}"
        )
    blocks = scenarios.blocks(
        dynamics=dynamics,
        policy=policy,
        start=partial(start, task=task),
        particles=search.particles,
        horizon=task.horizon,
        balanced=search.balanced,
    )
    pieces: dict[str, Any] = dict(
        dynamics=dynamics,
        policy=policy,
        match=moments.match if search.match else moments.keep,
        noise=NoiseUse(search.policy_noise, search.state_noise, search.cost_noise),
    )
    period, costs = Period(**vars(search.period)), cost.of_particles(task.cost)
    aggregate = AGGREGATES[search.aggregate]
    if search.discount < 1:
        aggregate = cost.discounted(search.discount, aggregate)
    clip = optax.identity() if search.clip is None else optax.clip_by_global_norm(search.clip)
    searcher = particles(
        partial(objective, **pieces, cost=costs, aggregate=aggregate),
        optax.chain(clip, optax.adam(search.learning_rate)),
        blocks=blocks,
        period=period,
    )

    def imagine(key: Key, params: Params, belief: Params) -> tuple[Rollout, Array]:
        fresh = scenarios.draw(key, 0, belief, blocks=blocks, period=period)
        imagined = rollout(params, belief, fresh, **pieces)
        return imagined, costs(imagined.seen)

    return searcher, imagine


def start(key: Key, *, task: Task) -> Array:
    """A first state [D] of the task."""
    mean, std = jnp.asarray(task.start_mean, float), jnp.asarray(task.start_std, float)
    return mean + std * jax.random.normal(key, mean.shape)


def dynamics_of(config: settings.BNN, task: Task) -> Dynamics:
    """The configured model of a task's dynamics."""
    noise = dropout_of(config)
    member = bnn(
        states=len(task.state_names),
        controls=len(task.control_names),
        angles=task.angles,
        hidden=config.hidden,
        dropout=noise,
        input_dropout=noise if config.input_noise else None,
        head=HEADS[config.head],
        heteroscedastic=config.heteroscedastic,
        full_whitening=config.whitening == "full",
        kl_weight=config.kl_weight,
        weight_decay=config.weight_decay,
        activation=config.activation,
        initialiser=config.initialiser,
    )
    return ensemble(member, config.members) if config.members > 1 else member


def dropout_of(config: settings.BNN) -> Dropout:
    """The configured noise on a model's units. Raises SettingError for parameters it cannot have."""
    try:
        return _dropout_of(config)
    except ValueError as error:
        raise settings.SettingError(f"model.dropout={config.dropout}: {error}") from error


def _dropout_of(config: settings.BNN) -> Dropout:
    match config.dropout:
        case "log_normal":
            return dropout.log_normal(config.low, config.high)
        case "binary":
            return dropout.binary(config.rate)
        case "concrete":
            return dropout.concrete(config.rate)
        case "gaussian":
            return dropout.gaussian()
        case "sparse":
            return dropout.sparse()
        case _:
            return dropout.none()


def policy_of(config: settings.MLP, task: Task) -> Policy:
    """The configured controller of a task."""
    return mlp(
        encode=partial(angles.encode, angles=task.angles),
        features=len(task.state_names) + len(task.angles),
        controls=len(task.control_names),
        hidden=config.hidden,
        dropout=dropout.binary(config.dropout) if config.dropout > 0 else dropout.none(),
        saturate=to_limits(SQUASHES[config.squash], *limits(task)),
        initialiser=config.initialiser,
        output_scale=config.output_scale,
    )
