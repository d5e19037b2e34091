"""How the settings of a model, a policy and a fit become those pieces."""

from collections.abc import Callable
from functools import partial
from typing import Any

import optax

from pegasus_jax import config as settings
from pegasus_jax import tasks
from pegasus_jax.assembly.searchers import first_seen, limits
from pegasus_jax.checks import ConfigError
from pegasus_jax.config_models import several, sized
from pegasus_jax.learn.fit import falling, minibatches
from pegasus_jax.math import angles, gaussian
from pegasus_jax.memory import given_size, seen_angles, seen_names
from pegasus_jax.models import dropout
from pegasus_jax.models.bnn import bnn
from pegasus_jax.models.ensemble import ensemble
from pegasus_jax.models.innovations import innovations, integrated
from pegasus_jax.models.lagrangian import lagrangian
from pegasus_jax.models.networks import HEADS
from pegasus_jax.pilco.gp import gp
from pegasus_jax.pilco.lbfgs import full_data
from pegasus_jax.pilco.rbf import rbf
from pegasus_jax.pilco.ssgp import ssgp
from pegasus_jax.policies.linear import linear
from pegasus_jax.policies.mlp import mlp
from pegasus_jax.policies.squash import SQUASHES, to_limits
from pegasus_jax.task import Task
from pegasus_jax.types import Dropout, Dynamics, ModelLearner, Policy

AT_REST = 0.05  # of the outgoing weights of a fresh network controller under a constraint

NOISES: dict[str, Callable[[settings.BNN | settings.Lagrangian], Dropout]] = {
    "log_normal": lambda config: dropout.log_normal(config.log_z_min),
    "binary": lambda _: dropout.binary(),
    "concrete": lambda _: dropout.concrete(),
    "gaussian": lambda _: dropout.gaussian(),
    "sparse": lambda _: dropout.sparse(),
    "none": lambda _: dropout.none(),
}


def fit_of(config: settings.Fit | settings.LBFGS, dynamics: Dynamics) -> ModelLearner:
    """The configured way of fitting a model."""
    if isinstance(config, settings.LBFGS):
        return full_data(dynamics, num_starts=config.num_starts)
    rate = falling(config.learning_rate, config.decay, config.steps)
    return minibatches(dynamics, optax.adam(rate), batch_size=config.batch_size)


def dynamics_of(config: settings.Model, task: Task) -> Dynamics:
    """The configured model of a task's dynamics. Raises ConfigError where the task does not suit it."""
    if not isinstance(config, settings.Model):
        raise ConfigError(
            f"dynamics_of takes a config's model, not a {type(config).__name__}; preset(NAME).model is one"
        )
    states, controls = len(task.state_names), given_size(task.memory, len(task.control_names))
    if task.prior is not None and (task.hindsight is not None or controls != len(task.control_names)):
        raise ConfigError(
            "prior= is a step from a whole state, and history= or sensors.velocity= stand for one that is not measured;"
            " leave out prior=, and begin with a run of the simulator instead: init=RUN"
        )
    told = states if task.prior is not None else 0  # what a `residual` is told beside the controls
    shape: dict[str, Any] = dict(states=states, controls=controls + told, angles=task.angles)
    if task.hindsight is not None and isinstance(config, settings.GP | settings.SSGP):
        raise ConfigError("sensors.velocity= needs a model=lagrangian or another network; the nearest is history=2")
    config = sized(config, states)
    match config:
        case settings.GP():
            return gp(**shape)
        case settings.SSGP():
            return ssgp(**shape)
        case settings.Lagrangian() if task.prior is not None:
            raise ConfigError(
                "model=lagrangian is a mechanism, and what prior= gets wrong is none; the nearest is model=log_normal"
            )
        case settings.Lagrangian():
            rates = tasks.rates_of(task)
            substeps = config.substeps or (1 if len(rates) <= 2 else 4)  # docs/decisions.md 0009
            member = lagrangian(**shape, **network_of(config), rates=rates, dt=task.dt, substeps=substeps)
        case settings.BNN():
            # What a good simulator gets wrong may be all noise.
            head = HEADS["sigmoid" if task.prior is None else "softplus"]
            member = bnn(**shape, **network_of(config), heteroscedastic=config.heteroscedastic, head=head)
            if task.hindsight is not None:
                member = integrated(member, rates=task.rates, dt=task.dt)
    if task.hindsight is not None:
        member = innovations(member, rates=task.rates, angles=task.angles, inputs=controls, dt=task.dt)
    size = several(config)
    return ensemble(member, size) if size > 1 else member


def network_of(config: settings.BNN | settings.Lagrangian) -> dict[str, Any]:
    """What describes the network of a model."""
    return dict(
        hidden=config.hidden,
        dropout=dropout_of(config),
        kl_weight=config.kl_weight,
        weight_decay=config.weight_decay,
        activation=config.activation,
        initializer=config.initializer,
    )


def dropout_of(config: settings.BNN | settings.Lagrangian) -> Dropout:
    """The configured noise on a model's units. Raises ConfigError for parameters it cannot have."""
    try:
        return NOISES[config.dropout](config)
    except ValueError as error:
        raise ConfigError(f"model.dropout={config.dropout} model.log_z_min={config.log_z_min:g}: {error}") from error


def policy_of(config: settings.MLP | settings.RBF | settings.Linear, task: Task) -> Policy:
    """The configured controller of a task."""
    low, high = limits(task)
    names, turning = seen_names(task), seen_angles(task)
    features = len(names) + len(turning)
    shared: dict[str, Any] = dict(
        encode=partial(angles.encode, angles=turning),
        controls=len(task.control_names),
        saturate=to_limits(SQUASHES[config.squash], low, high),
        waves=2 * len(turning),
    )
    # Of the saturations, only the sine has moments in closed form.
    saturate_moments = partial(gaussian.squash, low=low, high=high) if config.squash == "sine" else None
    match config:
        case settings.RBF():
            centers: dict[str, Any] = dict(start=partial(first_seen, task=task), num_centers=config.num_centers)
            return rbf(**shared, **centers, saturate_moments=saturate_moments)
        case settings.Linear():
            return linear(**shared, features=features, saturate_moments=saturate_moments)
        case settings.MLP():
            return mlp(
                **shared,
                features=features,
                hidden=config.hidden,
                dropout=dropout.binary(config.dropout) if config.dropout > 0 else dropout.none(),
                initializer=config.initializer,
                input_scale=tasks.input_scale(task, config.input_units),
                units=tasks.control_units(task),
                find_units=config.input_units is None,
                # Within a constraint a policy grows from one that hardly moves, and need not find its way back.
                output_scale=1.0 if task.constraint is None else AT_REST,
            )
