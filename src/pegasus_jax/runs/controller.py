"""What a run has learned as a plain function, to be called by the program that drives the robot."""

from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from pegasus_jax import memory as recall
from pegasus_jax.checks import brief
from pegasus_jax.memory import seen_names
from pegasus_jax.runs import restore
from pegasus_jax.tasks import sensed
from pegasus_jax.tasks.signals import AHEAD, times
from pegasus_jax.tasks.terms import goal_names, reference_names
from pegasus_jax.types import Array, Params


class Controller:
    """A learned policy: call it with the user's observation x [O] for the control u [U], within the task's limits.

    `trial` is the trial after which it was learned. `reset` is to be called before each episode. `goal` [G] is to be
    set where each episode had one; `reference`, numbers [R] or a function of the time since `reset` [s], takes the
    place of the run's. Nothing global of JAX is changed, by making it or by calling it.
    """

    def __init__(self, run: Path, trial: restore.Trial) -> None:
        config, experiment, state = restore.restored(run, trial)
        self.trial = int(state.trial)
        task, memory = experiment.task, experiment.task.memory
        see, _, advance = recall.steps(memory)
        self._params, self._size = state.policy.params, len(recall.measured(task)) + len(task.circles)
        double = config.x64
        self._type, self._width = (np.float64, partial(jax.enable_x64, True)) if double else (np.float32, nullcontext)
        self._dt, self._goals = task.dt, 0 if task.goal is None else len(task.goal.units)
        goal = np.array([memory.names.index(name) for name in goal_names(task)], int)
        names = [name for ahead in AHEAD for name in reference_names(task, ahead)]
        asked = np.array([len(seen_names(task)) - len(memory.shown) + memory.shown.index(name) for name in names], int)
        self._references = len(names) // len(AHEAD)

        def start(x: Array) -> Array | None:
            return recall.begin(memory, jax.random.key(0), sensed.state(x, task))

        def act(params: Params, m: Array | None, x: Array, given: Array) -> tuple[Array, Array | None]:
            o = sensed.state(x, task)
            m = m.at[goal].set(given[: len(goal)]) if len(goal) else m  # type: ignore[union-attr]
            seen = see(m, o)
            u = experiment.policy.apply(params, None, seen.at[asked].set(given[len(goal) :]) if len(asked) else seen)
            return u, advance(m, o, u)

        with restore.precision(config):
            x, given = jnp.zeros(self._size, self._type), jnp.zeros(len(goal) + len(asked), self._type)
            self._start = jax.jit(start).lower(x).compile()
            self._act = jax.jit(act).lower(self._params, jax.eval_shape(start, x), x, given).compile()
            self._given = given = np.zeros(given.shape, self._type)
            self._reference: Any = None
            if task.reference is not None:
                at = times(task)
                values = np.asarray(jax.vmap(task.reference.value)(jnp.asarray(at)))
                self._reference = lambda t: [np.interp(t, at, column) for column in values.T]
        self._goal: np.ndarray | None = None
        self.reset()

    @property
    def goal(self) -> np.ndarray | None:
        """What the episode is to reach [G]; None: not set yet. It may change at any time."""
        return self._goal

    @goal.setter
    def goal(self, goal: ArrayLike) -> None:
        if not self._goals:
            raise ValueError("this policy was learned for one cost and has no goal to be set")
        self._goal = _numbers(goal, self._goals, "a goal", self._type)

    @property
    def reference(self) -> Any:
        """What the episode follows: numbers [R], or a function of the time since `reset` [s]; None: nothing."""
        return self._reference

    @reference.setter
    def reference(self, reference: ArrayLike | Callable[[float], ArrayLike]) -> None:
        if not self._references:
            raise ValueError("this policy was learned without a reference, and has none to be set")
        self._reference = reference

    def _asked(self) -> np.ndarray:
        """The goal, then the reference of now and soon after."""
        if self._goals and self._goal is None:
            raise ValueError(f"this policy was learned for goals: set goal, {self._goals} numbers, before it is called")
        if self._goal is not None:
            self._given[: self._goals] = self._goal
        if self._references:
            self._given[self._goals :] = np.concatenate([self._reference_at(self._now + k * self._dt) for k in AHEAD])
        return self._given

    def _reference_at(self, t: float) -> np.ndarray:
        value: Any = self._reference(t) if callable(self._reference) else self._reference
        return _numbers(value, self._references, "a reference", self._type)

    def __call__(self, x: ArrayLike) -> np.ndarray:
        """The control u [U] for an observation x [O]. Raises ValueError unless that is O finite numbers."""
        x = np.asarray(x, self._type)
        if x.shape != (self._size,) or not np.isfinite(x).all():
            raise ValueError(f"an observation is {self._size} finite numbers, not {x}")
        given = self._asked()
        with self._width():
            m = self._start(x) if self._new else self._memory
            u, self._memory = self._act(self._params, m, x, given)
            self._new, self._now = False, self._now + self._dt
            return np.array(u)

    def reset(self) -> None:
        """Forget the episode so far: what is remembered begins with the next observation."""
        self._memory, self._new, self._now = None, True, 0.0


def _numbers(values: ArrayLike, size: int, what: str, kind: type) -> np.ndarray:
    """The values [size]. Raises ValueError for others."""
    found = np.atleast_1d(np.asarray(values, kind))
    if found.shape != (size,) or not np.isfinite(found).all():
        raise ValueError(f"{what} is {size} finite numbers, not {values}")
    return found


@brief
def controller(run: str | Path, trial: restore.Trial = restore.BEST) -> Controller:
    """The policy of a run after a trial, finished run or not: a number, "last", or "best" (`best.best_trial`).

    Of a policy with noise on its units it is the mean, every unit at its expected size. It is compiled here, so that
    the first call takes no longer than the others. Only the run's folder is read: no environment is opened, no model's
    file, and no module of its user is imported. Raises RunError when there is no such run or trial, or nothing was
    learned yet.
    """
    return Controller(Path(run), trial)
