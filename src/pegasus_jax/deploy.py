"""What a run has learned as a plain function, to be called by the program that drives the robot."""

from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from pegasus_jax.record import existing
from pegasus_jax.train import newest


def controller(run: str | Path) -> Callable[[ArrayLike], np.ndarray]:
    """The newest policy of a run, finished or not: observation x [D] -> control u [U], within the task's limits.

    Of a policy with noise on its units it is the mean, every unit at its expected size. It is compiled here, so that
    the first call takes no longer than the others, and opens no environment. The function raises ValueError for an
    observation of another shape or one that is not finite. Raises RunError when there is no such run, or it has learned
    nothing yet.
    """
    _, experiment, state = newest(existing(Path(run)))
    params, size, precision = state.policy.params, len(experiment.task.state_names), jnp.zeros(()).dtype
    act = jax.jit(lambda x: experiment.policy.apply(params, None, x)).lower(jnp.zeros(size)).compile()

    def control(x: ArrayLike) -> np.ndarray:
        x = np.asarray(x, precision)
        if x.shape != (size,) or not np.isfinite(x).all():
            raise ValueError(f"an observation is {size} finite numbers, not {x}")
        return np.asarray(act(x))

    return control
