"""A limit on how fast a control changes: the same function in imagination, on a plant and in a controller."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from pegasus_jax.math.angles import difference
from pegasus_jax.memory import measured
from pegasus_jax.task import Task
from pegasus_jax.types import Array, Params, Policy


def rate_limited(policy: Policy, task: Task) -> Policy:
    """The policy whose controls [U] follow the one before by at most `task.control_rate` [1/s]; it sees that control.

    The policy itself where a control may change at any rate. What was before is what the task's memory shows.
    """
    if task.control_rate is None:
        return policy

    def apply(params: Params, noise: Params, seen: Array) -> Array:
        return follow(policy.apply(params, noise, seen), before(seen, task), task, jnp)

    return policy._replace(apply=apply, moments=None)


def before(seen: Array, task: Task) -> Array | None:
    """The control [U] of the period before, of what the policy sees [P]; None of a task without such a limit."""
    if task.control_rate is None:
        return None
    first = len(measured(task))
    place = np.array([first + task.memory.shown.index(f"{name} 1 before") for name in task.control_names])
    low, high = jnp.asarray(task.control_low, seen.dtype), jnp.asarray(task.control_high, seen.dtype)
    return jnp.clip(seen[place], low, high)  # moment matching may have redrawn it from a Gaussian


def follow(u: Any, before: Any, task: Task, numpy: Any) -> Any:
    """The control [U] nearest to u that the task's limit allows after the one before.

    Where that is u itself, the gradient is that of u, else that of the control before: a policy that is too fast now
    still learns from what it did until then.
    """
    change = numpy.asarray(largest_change(task), before.dtype)
    return numpy.clip(u, before - change, before + change)


def explored(task: Task, x: Any, plan: Any, before: Any, numpy: Any) -> Any:
    """The controls [U] of an exploring period: `plan`, added to those of the task's first controller if it has one.

    That is given the state x [D]: see `with_state`.
    """
    u = plan
    if task.guide is not None:
        low, high = numpy.asarray(task.control_low), numpy.asarray(task.control_high)
        u = numpy.clip(numpy.asarray(task.guide(x), plan.dtype) + plan, low, high).astype(plan.dtype)
    return u if task.control_rate is None else follow(u, before, task, numpy)


def with_state(task: Task) -> Task:
    """The task whose policy sees, behind all else, the state [D] that a first controller is given.

    It is that of an environment's rows: rates that no sensor measures are differences of the positions that one does.
    """
    memory, positions, rates = task.memory, np.array(measured(task)), np.array(task.rates, int)
    turning = tuple(place for place, i in enumerate(positions) if i in task.angles)

    def state(m: Any, o: Array) -> Array:
        if memory.measured is None:
            return o
        last = np.array([memory.names.index(f"{task.state_names[i]} 1 before") for i in positions])
        return o.at[rates].set(difference(o[positions], m[last], turning) / task.dt)

    shown = (*memory.shown, *(f"{name} of a first controller" for name in task.state_names))
    show = lambda m, o: jnp.concatenate([memory.show(m, o), state(m, o)])  # noqa: E731
    return task._replace(memory=memory._replace(shown=shown, show=show))


def largest_change(task: Task) -> np.ndarray:
    """The largest change [U] of a control from one period to the next; infinite where there is no limit."""
    rate = np.inf if task.control_rate is None else task.control_rate
    return np.broadcast_to(np.asarray(rate, float) * task.dt, (len(task.control_names),))
