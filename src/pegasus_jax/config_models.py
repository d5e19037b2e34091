"""The settings of the models, and how a setting is declared; see config.py, which has them all."""

import math
from dataclasses import dataclass, field
from typing import Any

from pegasus_jax import checks
from pegasus_jax.checks import SettingError


def setting(default: Any, text: str, of: tuple[str, ...] = ()) -> Any:
    """A field with its help text, and where not every task uses it, the names of those that do, maybe with a *."""
    return field(default=default, metadata={"help": f"of task={'|'.join(of)}: {text}" if of else text, "of": of})


DROPOUTS = ("log_normal", "binary", "concrete", "gaussian", "sparse", "none")
HEADS = ("sigmoid", "softplus")
ACTIVATIONS = ("relu", "silu", "tanh")
INITIALISERS = ("glorot", "orthogonal")


@dataclass(frozen=True)
class _Network:
    """What every network model has, and an ensemble of them."""

    kind: str = setting("", "")
    members: int = setting(1, "networks fitted side by side; each particle follows one of them")
    hidden: tuple[int, ...] = setting((200, 200), "widths of the hidden layers")
    dropout: str = setting("log_normal", "noise on the units: log_normal, binary, concrete, gaussian, sparse, none")
    rate: float = setting(0.1, "drop probability of binary dropout, initial one of concrete dropout")
    low: float = setting(-10.0, "lower end of the interval of log z (log_normal)")
    high: float = setting(0.0, "upper end of the interval of log z (log_normal)")
    head: str = setting("sigmoid", "form of the predicted noise: sigmoid (at most .1 of the target's scale), softplus")
    kl_weight: float = setting(0.1, "factor of the noise's KL divergence; 1 is the variational bound")
    weight_decay: float = setting(1.0, "factor of the Gaussian prior on the weights")
    activation: str = setting("silu", "nonlinearity: relu, silu, tanh")
    initialiser: str = setting("glorot", "initial weights: glorot, orthogonal")

    def __post_init__(self) -> None:
        checks.typed("model", self)
        checks.kind("model", self.kind, type(self).kind)
        checks.size("model.members", self.members)
        checks.layers("model.hidden", self.hidden)
        kinds = dict(activation=ACTIVATIONS, dropout=DROPOUTS, head=HEADS, initialiser=INITIALISERS)
        for name, choices in kinds.items():
            checks.choice(f"model.{name}", getattr(self, name), choices)
        checks.within("model.rate", self.rate, 0, 0.99)
        checks.least("model", self, 0, "kl_weight", "weight_decay")
        checks.least("model", self, -math.inf, "low", "high")
        if not self.low < self.high:
            raise SettingError(f"model.low={self.low:g} must be less than model.high={self.high:g}")


@dataclass(frozen=True)
class BNN(_Network):
    """Bayesian neural network dynamics, or an ensemble of them."""

    kind: str = setting("bnn", "")
    input_noise: bool = setting(False, "noise on the network's own inputs as well")
    heteroscedastic: bool = setting(True, "predicted noise depends on the input")
    whitening: str = setting("full", "scaling of inputs and targets: full covariance, or diagonal")

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.choice("model.whitening", self.whitening, ("full", "diagonal"))


@dataclass(frozen=True)
class Lagrangian(_Network):
    """Dynamics of a mechanism whose energies are a Bayesian neural network, or an ensemble of them."""

    kind: str = setting("lagrangian", "")
    hidden: tuple[int, ...] = setting((32, 32), "widths of the hidden layers")
    substeps: int = setting(2, "Runge-Kutta steps a control period")

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.size("model.substeps", self.substeps)


@dataclass(frozen=True)
class GP:
    """Exact Gaussian-process dynamics."""

    kind: str = setting("gp", "")
    features: int = setting(200, "sines and cosines in a particle's function, before the data correct it")

    def __post_init__(self) -> None:
        checks.typed("model", self)
        checks.kind("model", self.kind, "gp")
        checks.size("model.features", self.features, 2)
        if self.features % 2:
            raise SettingError(f"model.features={self.features} must be even; the nearest is {self.features + 1}")


@dataclass(frozen=True)
class SSGP:
    """Sparse-spectrum Gaussian-process dynamics."""

    kind: str = setting("ssgp", "")
    points: int = setting(100, "frequencies of each dimension, a cosine and a sine each")

    def __post_init__(self) -> None:
        checks.typed("model", self)
        checks.kind("model", self.kind, "ssgp")
        checks.size("model.points", self.points)
