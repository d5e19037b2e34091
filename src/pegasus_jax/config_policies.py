"""The settings of a policy; as `Config.policy`. config.py has those of everything else."""

from dataclasses import dataclass

from pegasus_jax import checks
from pegasus_jax.config_models import INITIALIZERS, setting

SQUASHES = ("tanh", "sine")


@dataclass(frozen=True)
class MLP:
    """A ReLU network controller."""

    kind: str = setting("mlp", "")
    hidden: tuple[int, ...] = setting((200, 200), "widths of the hidden layers")
    dropout: float = setting(0.0, "drop probability of the hidden units; 0 is a deterministic policy")
    squash: str = setting("tanh", "saturation: tanh, or sine, (9 sin v + sin 3v)/8")
    input_units: tuple[float, ...] | None = setting(
        (),
        "what each entry that is not an angle is divided by; []: the plant's units; null: found in the data",
    )
    initializer: str = setting("glorot", "initial weights: glorot, orthogonal")

    def __post_init__(self) -> None:
        checks.typed("policy", self)
        checks.kind("policy", self.kind, "mlp")
        checks.layers("policy.hidden", self.hidden)
        for name, choices in (("squash", SQUASHES), ("initializer", INITIALIZERS)):
            checks.choice(f"policy.{name}", getattr(self, name), choices)
        checks.check_range("policy.dropout", self.dropout, 0, 0.99)
        for unit in self.input_units or ():
            checks.check_range("policy.input_units", unit, 0, open_low=True)


@dataclass(frozen=True)
class RBF:
    """A controller of radial basis functions: the mean of a Gaussian process, PILCO's."""

    kind: str = setting("rbf", "")
    num_centers: int = setting(30, "number of radial basis functions")
    squash: str = setting("sine", "saturation: sine, (9 sin v + sin 3v)/8, or tanh")

    def __post_init__(self) -> None:
        checks.typed("policy", self)
        checks.kind("policy", self.kind, "rbf")
        checks.size("policy.num_centers", self.num_centers)
        checks.choice("policy.squash", self.squash, SQUASHES)


@dataclass(frozen=True)
class Linear:
    """A linear controller of the encoded state."""

    kind: str = setting("linear", "")
    squash: str = setting("sine", "saturation: sine, (9 sin v + sin 3v)/8, or tanh")

    def __post_init__(self) -> None:
        checks.typed("policy", self)
        checks.kind("policy", self.kind, "linear")
        checks.choice("policy.squash", self.squash, SQUASHES)
