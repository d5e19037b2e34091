"""A task and what JAX traces: whether it can, so that one line says where not, and what is made while it does."""

from contextlib import AbstractContextManager, nullcontext, suppress
from inspect import unwrap

import jax
import jax.numpy as jnp
from jax.core import Tracer

from pegasus_jax.checks import RunError, shown
from pegasus_jax.task import Task
from pegasus_jax.tasks import terms
from pegasus_jax.tasks.user_code import blamed
from pegasus_jax.types import Cost


def augmented(task: Task, cost: Cost | None = None) -> Task:
    """`terms.augmented`. Raises ConfigError, with the user's file and line, also where JAX cannot trace cost or stop.

    Nothing is computed. Episodes and rollouts check what the functions return.
    """
    made = terms.augmented(task, cost)
    x = jax.ShapeDtypeStruct((len(made.state_names) + len(made.memory.names),), jnp.zeros(()).dtype)
    for name, function in {"cost": made.cost.of_state, "stop": made.stop}.items():
        if function is not None:
            # A task that is read back from a run's folder has functions that nobody imported: they say so when asked.
            with blamed(f"{name}={shown(unwrap(function))}", function), suppress(RunError):
                jax.eval_shape(function, x)
    return made


def outside() -> AbstractContextManager[None]:
    """What is made within is computed now, and belongs to no program that is traced around it.

    Where none is there is nothing to do: JAX compiles again within such a context, which takes MJX seconds.
    """
    return jax.ensure_compile_time_eval() if isinstance(jnp.zeros(()), Tracer) else nullcontext()
