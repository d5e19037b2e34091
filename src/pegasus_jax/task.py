"""What is to be learned: a plant, a cost, where episodes start, and what is asked of a policy from outside."""

from collections.abc import Callable
from operator import index
from typing import Any, NamedTuple

import numpy as np
from jax.core import Tracer

from pegasus_jax.checks import ConfigError, different, shown
from pegasus_jax.types import NO_MEMORY, Array, Hindsight, Memory


class Signal(NamedTuple):
    """What is asked of a policy from outside: a reference, which changes with time, or the goal of an episode."""

    value: Callable[[Array], Array]  # a reference: t [] [s] -> [R]; a goal: key -> [G]
    units: tuple[float, ...]  # how large each of its entries is: a network counts it in these


class Task(NamedTuple):
    """What is to be learned: a plant's interface, a cost, and where episodes start."""

    name: str
    plant: Any  # reset(key) -> state; step(state, u [U]) -> state; observe(state) -> x [D]. None: others give episodes
    cost: Any  # a `Cost`, or what `compose` makes one of: a function of x [D] and, by their names, of `terms`
    angles: tuple[int, ...]  # the dimensions of x that are angles [rad]
    start_mean: Any  # [D]
    start_std: Any  # [D]
    sensor_std: Any  # [D] noise added to what the policy and the data see
    control_low: Any  # [U]
    control_high: Any  # [U]
    horizon: int  # H, control periods an episode
    dt: float  # [s] control period
    state_names: tuple[str, ...]
    control_names: tuple[str, ...]
    # The entries of x that are rates of its other entries, in the order of those; (): x is not made of such pairs.
    rates: tuple[int, ...] = ()
    success: float = 0.2  # a rollout whose last five steps cost less than this on average has succeeded
    # reset(seed) -> x [D]; step(u [U]) -> (x [D], the control sent [U], how it ended or ""); rest(), after an episode;
    # close(). The one plant outside of JAX: a Gymnasium environment, maybe a robot.
    environment: Any = None
    # x [D] -> probability that an episode ends there; None: it ends at the horizon, or where the environment says so
    stop: Callable[[Array], Array] | None = None
    stop_cost: float = 1.0  # of each control period that an early end leaves out
    # Pairs of entries of the user's observation that are cosine and sine of one angle of x (math/circles.py); (): the
    # observation is x.
    circles: tuple[tuple[int, ...], ...] = ()
    prior: Callable[[Array, Array], Array] | None = None  # a simulator: (x [D], u [U]) -> x [D] one period later
    starts: Any = None  # [N, D] states where episodes start, equally likely; None: N(start_mean, diag(start_std^2))
    starts_std: Any = None  # [D] spread of the starts around these, normal; None: they are used as they are
    memory: Memory = NO_MEMORY
    hindsight: Hindsight | None = None  # None: the states are as observed
    # Which of u, previous_u, t, reference, goal the cost takes; None: `cost` and `stop` are of x yet, not of x'
    terms: tuple[str, ...] | None = None
    reference: Signal | None = None
    goal: Signal | None = None
    constraint: Any = None  # an `imagine.limits.Constraint`; None: a policy may do anything
    control_rate: Any = None  # [U] the largest rate of change of each control [1/s]; None: any
    guide: Callable[[Any], Any] | None = None  # x [D] -> u [U], the controller of the first episodes; None: random

    late: int = 0  # control periods that a control waits in `plant`, of which a controller has to remember them

    @property
    def observed(self) -> int:
        """The size of the observation that the user's functions get: two entries for each angle of `circles`."""
        return len(self.state_names) + len(self.circles)

    @property
    def may_end(self) -> bool:
        """Whether an episode may be shorter than the horizon."""
        return self.environment is not None or self.stop is not None


def known(task: Task, field: str) -> np.ndarray:
    """The numbers of a field by which something is built. Raises ConfigError for those that JAX traces."""
    value: Any = getattr(task, field)
    if isinstance(value, Tracer):
        raise ConfigError(
            f"the task's {field} is traced by jit, vmap or grad, and what is built here depends on it; expected numbers"
            " that are known before"
        )
    return np.asarray(value, float)


def checked(task: Task) -> Task:
    """The task, with its places in the state as tuples. Raises ConfigError, in one line, where fields do not agree.

    A mistake in one that somebody wrote would come back as a shape from deep inside JAX, or not at all. What its
    functions answer, `assembly.own_pieces.try_task` looks at.
    """
    states, controls = len(task.state_names), len(task.control_names)
    sizes = {"start_mean": states, "start_std": states, "sensor_std": states, "starts_std": states}
    for name, size in (sizes | dict.fromkeys(("control_low", "control_high", "control_rate"), controls)).items():
        given: Any = getattr(task, name)
        if (shape := np.shape(given)) == (size,):
            _finite(name, given)
        elif given is not None or name not in ("starts_std", "control_rate"):
            of = f"{size} {'states' if name in sizes else 'controls'}"
            raise ConfigError(f"the task's {name} has shape {shape}; expected ({size},), of {of}")
    starts: Any = task.starts
    if starts is not None:
        if (shape := np.shape(starts)) != (*shape[:1], states) or not shape[0]:
            raise ConfigError(f"the task's starts has shape {shape}; expected (N, {states}), rows of {states} states")
        _finite("starts", starts)
    rate: Any = task.control_rate
    if rate is not None and not isinstance(rate, Tracer) and not (np.asarray(rate) > 0).all():
        raise ConfigError(f"the task's control_rate is {rate}; expected numbers above 0, or None for any rate")
    if not isinstance(task.horizon, int | np.integer) or task.horizon < 1:
        raise ConfigError(f"the task's horizon={task.horizon!r} is not a whole number of control periods, at least 1")
    dt: Any = task.dt
    if not isinstance(dt, Tracer) and not (isinstance(dt, float | int | np.number | np.ndarray) and 0 < dt < np.inf):
        raise ConfigError(f"the task's dt={shown(dt)} is no control period; expected a number of seconds above 0")
    for name, example in (("success", "0.2"), ("stop_cost", "1.0")):
        cost: Any = getattr(task, name)
        if not isinstance(cost, float | int | np.number | np.ndarray | Array) or np.ndim(cost):
            raise ConfigError(f"the task's {name}={shown(cost)} is no number; expected a cost a step, as {example}")
    if not any(isinstance(limit, Tracer) for limit in (task.control_low, task.control_high)):
        for name, low, high in zip(task.control_names, task.control_low, task.control_high, strict=True):
            if not low < high:
                raise ConfigError(f"the task's limits of {name} are {low:g} and {high:g}; expected control_low first")
    places = {name: _places(name, getattr(task, name), states) for name in ("angles", "rates")}
    return task._replace(**places, horizon=int(task.horizon))


def _finite(name: str, given: Any) -> None:
    """Raises ConfigError for a field with an entry that is not finite, unless JAX traces it."""
    if not isinstance(given, Tracer) and not np.isfinite(np.asarray(given, float)).all():
        raise ConfigError(f"the task's {name} is {given}; expected finite numbers")


def _places(name: str, given: Any, states: int) -> tuple[int, ...]:
    """The entries of the state that a field names. Raises ConfigError for what are none, and for one named twice."""
    try:
        places = tuple(map(index, given))
    except TypeError:
        raise ConfigError(f"the task's {name}={given!r} is no tuple of places in the state; for example (0,)") from None
    if wrong := [place for place in places if place not in range(states)]:
        raise ConfigError(f"the task's {name}={places} has {wrong[0]}; its {states} states are 0 to {states - 1}")
    different(f"the task's {name}", places)
    return places
