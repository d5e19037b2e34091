"""Config -> Experiment. The only place that matches on the kind of a setting."""

from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import optax

from pegasus_jax import angles, cost, dropout, episode, moments, scenarios, tasks, trial
from pegasus_jax import config as settings
from pegasus_jax.dynamics.bnn import HEADS, bnn
from pegasus_jax.fit import guarded
from pegasus_jax.policy.mlp import mlp
from pegasus_jax.policy.squash import SQUASHES, to_limits
from pegasus_jax.rollout import NoiseUse
from pegasus_jax.types import Array, Dropout, Dynamics, Experiment, Key, Period, Policy, Task

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
    search, explore = config.search, config.explore
    dynamics = dynamics or dynamics_of(config.model, task)
    policy = policy or policy_of(config.policy, task)
    low, high = (jnp.asarray(limit, jnp.float32) for limit in (task.control_low, task.control_high))
    if (search.match or search.balanced) and search.particles <= len(task.state_names):
        states, what = len(task.state_names), "moment matching" if search.match else "balanced draws"
        raise settings.SettingError(
            f"search.particles={search.particles} is too few: {what} of {states} dimensions needs at least {states + 1}"
        )
    clip = optax.identity() if search.clip is None else optax.clip_by_global_norm(search.clip)
    return trial.experiment(
        task=task,
        dynamics=dynamics,
        policy=policy,
        blocks=scenarios.blocks(
            dynamics=dynamics,
            policy=policy,
            start=partial(start, task=task),
            particles=search.particles,
            horizon=task.horizon,
            balanced=search.balanced,
        ),
        period=Period(**vars(search.period)),
        match=moments.match if search.match else moments.keep,
        cost=cost.of_particles(task.cost),
        aggregate=cost.discounted(search.discount, AGGREGATES[search.aggregate])
        if search.discount < 1
        else AGGREGATES[search.aggregate],
        noise=NoiseUse(search.policy_noise, search.state_noise, search.cost_noise),
        fit_optimizer=guarded(optax.adam(config.fit.learning_rate)),
        fit_steps=config.fit.steps,
        fit_batch=config.fit.batch,
        fit_reset=config.fit.reset,
        search_optimizer=guarded(optax.chain(clip, optax.adam(search.learning_rate))),
        search_steps=search.steps,
        search_reset=search.reset,
        search_restart=search.restart,
        explore=partial(EXPLORATIONS[explore.kind], low=low, high=high, horizon=task.horizon),
        explore_trials=explore.trials,
        mean_execution=config.policy.execution == "mean",
        capacity=config.trials * task.horizon,
    )


def start(key: Key, *, task: Task) -> Array:
    """A first state [D] of the task."""
    mean, std = jnp.asarray(task.start_mean, jnp.float32), jnp.asarray(task.start_std, jnp.float32)
    return mean + std * jax.random.normal(key, mean.shape)


def dynamics_of(config: settings.BNN, task: Task) -> Dynamics:
    """The configured model of a task's dynamics."""
    noise = dropout_of(config)
    return bnn(
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
    low, high = jnp.asarray(task.control_low, jnp.float32), jnp.asarray(task.control_high, jnp.float32)
    return mlp(
        encode=partial(angles.encode, angles=task.angles),
        features=len(task.state_names) + len(task.angles),
        controls=len(task.control_names),
        hidden=config.hidden,
        dropout=dropout.binary(config.dropout) if config.dropout > 0 else dropout.none(),
        saturate=to_limits(SQUASHES[config.squash], low, high),
        initialiser=config.initialiser,
        output_scale=config.output_scale,
    )
