"""The settings of the models, and how a setting is declared; see config.py, which has them all."""

import math
from dataclasses import dataclass, field, replace
from typing import Any

from pegasus_jax import checks


def setting(default: Any, text: str, of: tuple[str, ...] = ()) -> Any:
    """A field with its help text, and of a plant's own the names of the tasks that use it, maybe with a *."""
    some = of and "*" not in of
    return field(default=default, metadata={"help": f"{text} (task={'|'.join(of)})" if some else text, "of": of})


DROPOUTS = ("log_normal", "binary", "concrete", "gaussian", "sparse", "none")
ACTIVATIONS = ("relu", "silu", "tanh")
INITIALIZERS = ("glorot", "orthogonal")


@dataclass(frozen=True)
class _Network:
    """What every network model has, and an ensemble of them."""

    kind: str = setting("", "")
    ensemble_size: int | None = setting(
        1, "number of models; each particle follows one of them; null: 1 up to six states, 5 up to ten, else 20"
    )
    hidden: tuple[int, ...] = setting((200, 200), "widths of the hidden layers")
    dropout: str = setting("log_normal", "noise on the units: log_normal, binary, concrete, gaussian, sparse, none")
    log_z_min: float = setting(-10.0, "lower end of the interval of log z, whose upper end is 0 (dropout log_normal)")
    kl_weight: float | None = setting(
        0.1, "factor of the noise's KL divergence; 1: the variational bound; null: 1 for several models, .1 for one"
    )
    weight_decay: float = setting(1.0, "factor of the Gaussian prior on the weights")
    activation: str = setting("silu", "nonlinearity: relu, silu, tanh")
    initializer: str = setting("glorot", "initial weights: glorot, orthogonal")

    def __post_init__(self) -> None:
        checks.typed("model", self)
        checks.kind("model", self.kind, type(self).kind)
        if self.ensemble_size is not None:
            checks.size("model.ensemble_size", self.ensemble_size)
        checks.layers("model.hidden", self.hidden)
        kinds = dict(activation=ACTIVATIONS, dropout=DROPOUTS, initializer=INITIALIZERS)
        for name, choices in kinds.items():
            checks.choice(f"model.{name}", getattr(self, name), choices)
        weights = ("weight_decay",) if self.kl_weight is None else ("kl_weight", "weight_decay")
        checks.check_minimum("model", self, 0, *weights)
        checks.check_range("model.log_z_min", self.log_z_min, -math.inf, 0, open_high=True)


@dataclass(frozen=True)
class BNN(_Network):
    """Bayesian neural network dynamics, or an ensemble of them."""

    kind: str = setting("bnn", "")
    heteroscedastic: bool = setting(True, "true: the predicted noise depends on the input; false: it is constant")


@dataclass(frozen=True)
class Lagrangian(_Network):
    """Dynamics of a mechanism whose energies are a Bayesian neural network, or an ensemble of them."""

    kind: str = setting("lagrangian", "")
    hidden: tuple[int, ...] = setting((32, 32), "widths of the hidden layers")
    substeps: int | None = setting(
        None, "Runge-Kutta steps in a control period; null: 1 for up to two coordinates, 4 for more"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.substeps is not None:
            checks.size("model.substeps", self.substeps)


@dataclass(frozen=True)
class GP:
    """Exact Gaussian-process dynamics."""

    kind: str = setting("gp", "")

    def __post_init__(self) -> None:
        checks.typed("model", self)
        checks.kind("model", self.kind, "gp")


@dataclass(frozen=True)
class SSGP:
    """Sparse-spectrum Gaussian-process dynamics."""

    kind: str = setting("ssgp", "")

    def __post_init__(self) -> None:
        checks.typed("model", self)
        checks.kind("model", self.kind, "ssgp")


Model = BNN | GP | SSGP | Lagrangian


def sized(model: Model, states: int) -> Model:
    """A model's settings for a plant of so many states, with a number for each null: docs/decisions.md 0017."""
    if isinstance(model, GP | SSGP):
        return model
    size = model.ensemble_size or networks(states)
    own = 1.0 if size > 1 else 0.1
    return replace(model, ensemble_size=size, kl_weight=own if model.kl_weight is None else model.kl_weight)


def networks(states: int) -> int:
    """How many networks a plant of so many states needs, so that a policy cannot learn the errors of all of them."""
    return 1 if states <= 6 else 5 if states <= 10 else 20


def several(model: Model) -> int:
    """How many models a sized one is."""
    return 1 if isinstance(model, GP | SSGP) else model.ensemble_size or 1
