"""A learned controller as data: a short list of layers. Each format prints code for these, and knows no policies."""

from typing import NamedTuple

import jax
import numpy as np

from pegasus_jax import memory as recall
from pegasus_jax.checks import ConfigError
from pegasus_jax.config import MLP, RBF, Linear
from pegasus_jax.exports.learned import Learned
from pegasus_jax.math.circles import entries
from pegasus_jax.pilco.rbf import regress
from pegasus_jax.policies.rate_limited import largest_change
from pegasus_jax.runs.restore import precision
from pegasus_jax.tasks import input_scale
from pegasus_jax.tasks.remembered import kept_by


class Recall(NamedTuple):
    """v = the state [n] of the observation, then what is remembered of an episode; see tasks/remembered.py.

    Past controls, newest first, then past states, newest first, then the rates of the state. Last come entries of the
    observation that are `asked` for.
    """

    state: tuple[tuple[int, ...], ...]  # [n] (entry of the observation,), or those of a cosine and a sine of an angle
    rest: np.ndarray  # [U] the controls before the episode
    controls: int  # past ones
    rows: int  # past states
    turning: tuple[int, ...]  # the entries of the state that are angles; of their differences no turn is counted
    rates: bool
    weight: float  # of the newest difference in a rate
    dt: float  # [s]
    asked: tuple[int, ...]

    @property
    def size(self) -> int:
        """Entries of v."""
        return len(self.state) * (1 + self.rows + self.rates) + self.controls * len(self.rest) + len(self.asked)

    @property
    def parts(self) -> dict[str, int]:
        """The sizes of what is remembered: past controls, past states, the state before, and filtered rates."""
        n, filtered = len(self.state), self.rates and self.weight < 1
        return {
            "past": self.controls * len(self.rest),
            "rows": self.rows * n,
            "before": self.rates * n,
            "rate": filtered * n,
        }


class Features(NamedTuple):
    """v = entries of the observation as they are, then sines of all angles, then their cosines (`angles.encode`)."""

    plain: tuple[int, ...]
    angles: tuple[tuple[int, ...], ...]  # (entry,) [rad], or (entry of the cosine, entry of the sine)

    @property
    def size(self) -> int:
        """F."""
        return len(self.plain) + 2 * len(self.angles)


class Standardize(NamedTuple):
    """v = (v - mean) / scale."""

    mean: np.ndarray  # [F]
    scale: np.ndarray  # [F]


class Dense(NamedTuple):
    """v = v @ kernel + bias, and max(v, 0) with `relu`."""

    kernel: np.ndarray  # [inputs, outputs]
    bias: np.ndarray  # [outputs]
    relu: bool


class Kernels(NamedTuple):
    """v_u = sum over n of weights_un exp(-|(v - centers_n) / lengthscales_u|^2 / 2) (docs/reference.md 5.1).

    In double precision, whatever the controller's is: weights of 50 and more cancel.
    """

    centers: np.ndarray  # [n, F]
    lengthscales: np.ndarray  # [U, F]
    weights: np.ndarray  # [U, n]


class Squash(NamedTuple):
    """u = middle + half * squash(v), within the limits; tanh, or sine: (3 sin v - sin^3 v) / 2."""

    kind: str
    low: np.ndarray  # [U]
    high: np.ndarray  # [U]

    @property
    def middle(self) -> np.ndarray:
        """[U]."""
        return (self.high + self.low) / 2

    @property
    def half(self) -> np.ndarray:
        """[U]."""
        return (self.high - self.low) / 2


class Limit(NamedTuple):
    """u is moved towards the control before until it differs from that by no more than this."""

    change: np.ndarray  # [U]


Layer = Recall | Features | Standardize | Dense | Kernels | Squash | Limit


def layers_of(learned: Learned, format: str) -> tuple[Layer, ...]:
    """The layers of a policy, from the observation to the control. A new kind of policy is added here alone.

    Raises ConfigError for a policy that these layers cannot express.
    """
    settings, params, dtype = learned.config.policy, learned.params, learned.dtype
    match settings:
        case MLP():
            middle = _network(settings, learned)
        case Linear():
            middle = [Dense(_array(params["weights"], dtype).T, _array(params["bias"], dtype), False)]
        case RBF():
            with precision(learned.config):
                lengthscales, beta = jax.jit(regress)(params)
            middle = [Kernels(*(_array(value, np.float64) for value in (params["centres"], lengthscales, beta)))]
        case _:
            raise ConfigError(f"format={format} cannot write this policy; the nearest is format=stablehlo")
    low, high = (_array(limit, dtype) for limit in (learned.task.control_low, learned.task.control_high))
    layers = (*_features(learned), *middle, Squash(settings.squash, low, high))
    return (
        layers if learned.task.control_rate is None else (*layers, Limit(_array(largest_change(learned.task), dtype)))
    )


def _features(learned: Learned) -> tuple[Layer, ...]:
    """Where the features of what the policy sees are in the observation, and in what is remembered."""
    task, measured, sensors = learned.task, recall.measured(learned.task), len(learned.sensors)
    pair_at = {min(pair): tuple(pair) for pair in task.circles}
    kept = [pair_at.get(entry, (entry,)) for entry in entries(sensors, task.circles)]
    asked = range(sensors, len(learned.observation))
    seen, turning, first = [*kept, *((entry,) for entry in asked)], recall.seen_angles(task), ()
    if learned.memory.names:
        kept_of = kept_by(learned.config, task)
        layer = Recall(
            state=tuple(kept),
            rest=_array(recall.resting(task), learned.dtype),
            controls=kept_of.controls,
            rows=kept_of.rows,
            turning=tuple(measured.index(i) for i in task.angles if i in measured),
            rates=kept_of.rates,
            weight=kept_of.weight,
            dt=float(task.dt),
            asked=tuple(asked),
        )
        seen, first = [(entry,) for entry in range(layer.size)], (layer,)
    plain = tuple(entry for i, (entry, *_) in enumerate(seen) if i not in turning)
    return *first, Features(plain, tuple(seen[i] for i in turning))


def _network(settings: MLP, learned: Learned) -> list[Layer]:
    """The layers of the mean of a network: noise on the units is its mean, which the kernels take in."""
    params, dtype = learned.params, learned.dtype
    mean, scale = (_array(value, np.float64) for value in params["input"])
    units = 1 / np.broadcast_to(input_scale(learned.task, settings.input_units), mean.shape)
    dense = [params["network"]["params"][f"layer_{i}"] for i in range(len(settings.hidden) + 1)]
    layers: list[Layer] = []
    if np.any(mean != 0) or np.any(scale * units != 1):
        layers.append(Standardize((mean * units).astype(dtype), (scale * units).astype(dtype)))
    for i, layer in enumerate(dense):
        kernel = _array(layer["kernel"], np.float64) * (1 - settings.dropout if i else 1)
        layers.append(Dense(kernel.astype(dtype), _array(layer["bias"], dtype), relu=i < len(settings.hidden)))
    return layers


def _array(values: object, dtype: np.dtype | type) -> np.ndarray:
    return np.asarray(values).astype(dtype)
