"""A task, a model and a policy that a caller made, tried on shapes alone before anything is composed of them.

What is wrong with one is then a line that names its function, and not a message from inside a fit or a search.
"""

from contextlib import suppress
from functools import partial
from inspect import unwrap
from numbers import Real
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from pegasus_jax.checks import ConfigError, RunError, shown, some
from pegasus_jax.imagine.limits import Constraint
from pegasus_jax.learn.data import empty
from pegasus_jax.memory import given_size, seen_names
from pegasus_jax.shapes import check_floating, check_prediction, check_shape
from pegasus_jax.task import Signal, Task
from pegasus_jax.tasks.user_code import blamed
from pegasus_jax.types import Batch, Dynamics, Key, Policy


def try_task(task: Task) -> None:
    """Raises ConfigError, in one line, for a function of a task that does not answer as `Task` says.

    The functions of a task that is augmented already are of x' [D + M].
    """
    more = 0 if task.terms is None else len(task.memory.names)
    states, arrays = len(task.state_names), jnp.zeros(()).dtype
    x, whole, u = (jax.ShapeDtypeStruct((n,), arrays) for n in (states, states + more, len(task.control_names)))
    for name, given in (("goal", jax.random.key(0)), ("reference", jnp.zeros(()))):
        if not isinstance(signal := getattr(task, name), Signal | None):
            raise ConfigError(f"the task's {name} is of type {type(signal).__name__}; expected Signal(value, units)")
        if signal is None:
            continue
        if not isinstance(signal.units, tuple | list) or not all(
            isinstance(n, Real) and 0 < n < np.inf for n in signal.units
        ):
            raise ConfigError(f"the task's {name} has units={signal.units!r}; expected a tuple of numbers above 0")
        size = (len(signal.units),)
        _answers(name, signal.value, size, f"{size}, as many as its units", given)
    if not isinstance(limits := task.constraint, Constraint | None):
        raise ConfigError(
            f"the task's constraint is of type {type(limits).__name__};"
            " expected pegasus_jax.imagine.limits.Constraint(of_state, bound)"
        )
    if limits is not None:
        _answers("constraint", limits.of_state, None, "one number, or a vector", whole)
    if task.prior is not None:
        _answers("prior", task.prior, (states,), f"({states},), the state one period later", x, u)
    if task.stop is not None:
        _answers("stop", task.stop, (), "(), the probability that an episode ends there", whole)
        value: Any = 0.0 if more else task.stop(jnp.asarray(task.start_mean, float))
        if not isinstance(value, Tracer) and not 0 <= value <= 1:
            raise ConfigError(f"the task's stop is {value:g} at start_mean; expected a probability, from 0 to 1")


def _answers(name: str, function: Any, shape: tuple[int, ...] | None, expected: str, *given: Any) -> None:
    """Raises ConfigError unless a task's function returns an array of this shape; None: of one number, or a vector.

    A RunError is of a task that is read back from a run's folder: nobody imported its functions, which say so.
    """
    with blamed(f"{name}={shown(unwrap(function))}", function), suppress(RunError):
        found = jax.eval_shape(function, *given)
        if not isinstance(found, jax.ShapeDtypeStruct):
            raise ConfigError(f"the task's {name} has values of type {type(found).__name__}; expected an array")
        if len(found.shape) > 1 if shape is None else found.shape != shape:
            raise ConfigError(f"the task's {name} has values of shape {found.shape}; expected {expected}")


def try_dynamics(dynamics: Dynamics, task: Task, rows: int, fits: bool) -> None:
    """Raises ConfigError unless a model of one's own takes and returns what `Dynamics` says, for `rows` of this task.

    `fits` says whether its loss is minimized: a fitter of one's own may have no use for it, nor for gradients.
    """
    states, inputs = len(task.state_names), given_size(task.memory, len(task.control_names))
    inputs += states if task.prior is not None else 0  # it is told what the simulator does: models/residual.py
    more = 0 if task.hindsight is None else task.hindsight.more
    call = partial(called, "dynamics", dynamics)

    def each(key: Key) -> None:
        first, second, third = jax.random.split(key, 3)
        params = call("init", first)
        data = empty(rows, states, inputs + more, len(task.memory.names))
        if fits:
            check_floating("what dynamics.init returns", params)
            context, batch = call("prepare", data), Batch(data.x, data.u, data.y)
            loss = call("loss", params, second, batch, context)
            check_shape("what dynamics.loss returns", loss, ())
        posterior = call("posterior", params, data)
        if dynamics.deal is None:
            draw = call("sample", third, posterior)
        else:
            draw = jax.tree.map(lambda leaf: leaf[0], call("deal", third[None], posterior))
        x, u = jnp.zeros(states), jnp.zeros(inputs)
        predicted = call("apply", posterior, draw, x, u)
        check_prediction("dynamics.apply returns", predicted, x.shape, "[D]")

    tried(each)


def try_policy(policy: Policy, task: Task, follows: bool) -> None:
    """Raises ConfigError unless a policy of one's own takes and returns what `Policy` says, for this task.

    `follows` says whether it follows a gradient: a searcher of one's own may have no use for one.
    """
    call = partial(called, "policy", policy)
    if policy.memory.names not in ((), task.memory.names):
        raise ConfigError(
            f"the policy remembers {some(policy.memory.names)}, and the task {some(task.memory.names) or 'nothing'};"
            " expected the memory= of the task"
        )

    def each(key: Key) -> None:
        first, second = jax.random.split(key)
        params = call("init", first)
        if follows:
            check_floating("what policy.init returns", params)
        noise = call("sample", second)
        u = call("apply", params, noise, jnp.zeros(len(seen_names(task))))
        check_shape("what policy.apply returns", u, (len(task.control_names),), "[U]")

    tried(each)


def tried(each: Any) -> None:
    """The function of a key, traced and not run. Raises ConfigError for whatever it refuses."""
    try:
        jax.eval_shape(each, jax.random.key(0))
    except ConfigError:
        raise
    except ValueError as error:  # of what a trace of the pieces would refuse later
        raise ConfigError(str(error)) from error


def called(what: str, piece: Any, name: str, *given: Any) -> Any:
    """What the function of that name of a piece returns. Raises ConfigError that begins with where it is."""
    function = getattr(piece, name)
    if not callable(function):
        raise ConfigError(
            f"{what}.{name}={function!r} is no function; expected one, as {type(piece).__name__} in types.py has it"
        )
    with blamed(f"{what}.{name}", function):
        return function(*given)
