"""The settings of the models, and how a setting is declared; see config.py, which has them all."""

import math
from dataclasses import dataclass, field
from typing import Any

from pegasus_jax import checks


def setting(default: Any, text: str, of: tuple[str, ...] = ()) -> Any:
    """A field with its help text, and of a plant's own the names of the tasks that use it, maybe with a *."""
    some = of and "*" not in of
    return field(default=default, metadata={"help": f"of task={'|'.join(of)}: {text}" if some else text, "of": of})


DROPOUTS = ("log_normal", "binary", "concrete", "gaussian", "sparse", "none")
ACTIVATIONS = ("relu", "silu", "tanh")
INITIALIZERS = ("glorot", "orthogonal")


@dataclass(frozen=True)
class _Network:
    """What every network model has, and an ensemble of them."""

    kind: str = setting("", "")
    ensemble_size: int = setting(1, "models fitted side by side; each particle follows one of them")
    hidden: tuple[int, ...] = setting((200, 200), "widths of the hidden layers")
    dropout: str = setting("log_normal", "noise on the units: log_normal, binary, concrete, gaussian, sparse, none")
    log_z_min: float = setting(-10.0, "lower end of the interval of log z (log_normal), whose upper end is 0")
    kl_weight: float = setting(0.1, "factor of the noise's KL divergence; 1 is the variational bound")
    weight_decay: float = setting(1.0, "factor of the Gaussian prior on the weights")
    activation: str = setting("silu", "nonlinearity: relu, silu, tanh")
    initializer: str = setting("glorot", "initial weights: glorot, orthogonal")

    def __post_init__(self) -> None:
        checks.typed("model", self)
        checks.kind("model", self.kind, type(self).kind)
        checks.size("model.ensemble_size", self.ensemble_size)
        checks.layers("model.hidden", self.hidden)
        kinds = dict(activation=ACTIVATIONS, dropout=DROPOUTS, initializer=INITIALIZERS)
        for name, choices in kinds.items():
            checks.choice(f"model.{name}", getattr(self, name), choices)
        checks.check_minimum("model", self, 0, "kl_weight", "weight_decay")
        checks.check_range("model.log_z_min", self.log_z_min, -math.inf, 0, open_high=True)


@dataclass(frozen=True)
class BNN(_Network):
    """Bayesian neural network dynamics, or an ensemble of them."""

    kind: str = setting("bnn", "")
    heteroscedastic: bool = setting(True, "predicted noise depends on the input")


@dataclass(frozen=True)
class Lagrangian(_Network):
    """Dynamics of a mechanism whose energies are a Bayesian neural network, or an ensemble of them."""

    kind: str = setting("lagrangian", "")
    hidden: tuple[int, ...] = setting((32, 32), "widths of the hidden layers")
    substeps: int | None = setting(
        None, "Runge-Kutta steps a control period; null: 1 for up to two coordinates, 4 for more, which may be chaotic"
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
