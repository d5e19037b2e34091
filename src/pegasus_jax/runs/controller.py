"""What a run has learned as a plain function, to be called by the program that drives the robot."""

from contextlib import nullcontext
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from pegasus_jax.math.circles import to_state
from pegasus_jax.runs import restore


class Controller:
    """A learned policy: call it with the user's observation x [O] for the control u [U], within the task's limits.

    `trial` is the trial after which it was learned. `reset` is to be called before each episode. Nothing global of JAX
    is changed, by making it or by calling it.
    """

    def __init__(self, run: Path, trial: restore.Trial) -> None:
        config, experiment, state = restore.restored(run, trial)
        self.trial = int(state.trial)
        circles = experiment.task.circles
        self._params, self._size = state.policy.params, len(experiment.task.state_names) + len(circles)
        double = config.x64
        self._type, self._width = (np.float64, partial(jax.enable_x64, True)) if double else (np.float32, nullcontext)
        with restore.precision(config):
            act = jax.jit(lambda params, x: experiment.policy.apply(params, None, to_state(x, circles)))
            self._act = act.lower(self._params, jnp.zeros(self._size, self._type)).compile()

    def __call__(self, x: ArrayLike) -> np.ndarray:
        """The control u [U] for an observation x [O]. Raises ValueError unless that is O finite numbers."""
        x = np.asarray(x, self._type)
        if x.shape != (self._size,) or not np.isfinite(x).all():
            raise ValueError(f"an observation is {self._size} finite numbers, not {x}")
        with self._width():
            return np.array(self._act(self._params, x))

    def reset(self) -> None:
        """Forget the episode so far. A policy of today remembers nothing; one that filters its sensors will."""


def controller(run: str | Path, trial: restore.Trial = restore.BEST) -> Controller:
    """The policy of a run after a trial, finished run or not: a number, "last", or "best" (`record.best_trial`).

    Of a policy with noise on its units it is the mean, every unit at its expected size. It is compiled here, so that
    the first call takes no longer than the others. Only the run's folder is read: no environment is opened, no model's
    file, and no module of its user is imported. Raises RunError when there is no such run or trial, or nothing was
    learned yet.
    """
    return Controller(Path(run), trial)
