"""What a run has learned as a plain function, to be called by the program that drives the robot."""

from contextlib import nullcontext
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from pegasus_jax import memory as recall
from pegasus_jax.runs import restore
from pegasus_jax.tasks import sensed
from pegasus_jax.types import Array, Params


class Controller:
    """A learned policy: call it with the user's observation x [O] for the control u [U], within the task's limits.

    `trial` is the trial after which it was learned. `reset` is to be called before each episode. Nothing global of JAX
    is changed, by making it or by calling it.
    """

    def __init__(self, run: Path, trial: restore.Trial) -> None:
        config, experiment, state = restore.restored(run, trial)
        self.trial = int(state.trial)
        task, memory = experiment.task, experiment.task.memory
        see, _, advance = recall.steps(memory)
        self._params, self._size = state.policy.params, len(recall.measured(task)) + len(task.circles)
        double = config.x64
        self._type, self._width = (np.float64, partial(jax.enable_x64, True)) if double else (np.float32, nullcontext)

        def start(x: Array) -> Array | None:
            return recall.begin(memory, jax.random.key(0), sensed.state(x, task))

        def act(params: Params, m: Array | None, x: Array) -> tuple[Array, Array | None]:
            o = sensed.state(x, task)
            u = experiment.policy.apply(params, None, see(m, o))
            return u, advance(m, o, u)

        with restore.precision(config):
            x = jnp.zeros(self._size, self._type)
            self._start = jax.jit(start).lower(x).compile()
            self._act = jax.jit(act).lower(self._params, jax.eval_shape(start, x), x).compile()
        self.reset()

    def __call__(self, x: ArrayLike) -> np.ndarray:
        """The control u [U] for an observation x [O]. Raises ValueError unless that is O finite numbers."""
        x = np.asarray(x, self._type)
        if x.shape != (self._size,) or not np.isfinite(x).all():
            raise ValueError(f"an observation is {self._size} finite numbers, not {x}")
        with self._width():
            m = self._start(x) if self._new else self._memory
            u, self._memory = self._act(self._params, m, x)
            self._new = False
            return np.array(u)

    def reset(self) -> None:
        """Forget the episode so far: what is remembered begins with the next observation."""
        self._memory, self._new = None, True


def controller(run: str | Path, trial: restore.Trial = restore.BEST) -> Controller:
    """The policy of a run after a trial, finished run or not: a number, "last", or "best" (`record.best_trial`).

    Of a policy with noise on its units it is the mean, every unit at its expected size. It is compiled here, so that
    the first call takes no longer than the others. Only the run's folder is read: no environment is opened, no model's
    file, and no module of its user is imported. Raises RunError when there is no such run or trial, or nothing was
    learned yet.
    """
    return Controller(Path(run), trial)
