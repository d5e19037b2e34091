"""Whether JAX can trace what somebody wrote of a task: asked when it is composed, so that one line says where not."""

from contextlib import suppress
from inspect import unwrap

import jax
import jax.numpy as jnp

from pegasus_jax.checks import RunError, shown
from pegasus_jax.task import Task
from pegasus_jax.tasks import terms
from pegasus_jax.tasks.user_code import blamed
from pegasus_jax.types import Cost


def whole(task: Task, cost: Cost | None = None) -> Task:
    """`terms.whole`. Raises ConfigError, with the user's file and line, also for a cost or stop that JAX cannot trace.

    Nothing is computed. What they return is looked at where an episode or a rollout takes it.
    """
    made = terms.whole(task, cost)
    x = jax.ShapeDtypeStruct((len(made.state_names) + len(made.memory.names),), jnp.zeros(()).dtype)
    for name, function in {"cost": made.cost.of_state, "stop": made.stop}.items():
        if function is not None:
            # A task that is read back from a run's folder has functions that nobody imported: they say so when asked.
            with blamed(f"{name}={shown(unwrap(function))}", function), suppress(RunError):
                jax.eval_shape(function, x)
    return made
