"""The simulator that `prior=` names, as a function of state and control: one of the user's, or an MJCF file's."""

from difflib import get_close_matches
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from pegasus_jax.checks import ConfigError, shown
from pegasus_jax.config import MJCF, Config
from pegasus_jax.math import circles
from pegasus_jax.math.units import parted
from pegasus_jax.models.residual import Simulate
from pegasus_jax.task import Task
from pegasus_jax.tasks import cost_check, user_code
from pegasus_jax.types import Array

FILE = ".xml"
UNITS = ("rad", "rad/s", "m", "m/s")  # of a file's joints; others may be those in another spelling


def of_config(config: Config, task: Task) -> Simulate | None:
    """The config's prior, or None. Raises ConfigError, in one line, for one that does not suit the task."""
    what, prior = f"prior={shown(config.prior)}", config.prior
    of_a_file = isinstance(prior, str) and prior.endswith(FILE)
    if config.observe and config.task != MJCF and not of_a_file:
        raise ConfigError(f"observe={shown(config.observe)} is of an MJCF file: it needs task=mjcf, or prior=FILE.xml")
    if prior is None:
        return None
    if of_a_file:
        return checked(what, of_file(what, config, task), task)
    if isinstance(prior, str) and ":" not in prior:
        near = get_close_matches(prior, [path.name for path in Path().glob(f"*{FILE}")], n=1)
        raise ConfigError(
            f"{what} is no simulator: expected module:function, as simulator:step, or an MJCF file, whose name ends in"
            f" {FILE}" + (f"; did you mean prior={near[0]}?" if near else "")
        )
    function = user_code.load("prior", prior)

    def simulate(x: Array, u: Array) -> Array:
        return circles.to_state(function(circles.to_observation(x, task.circles), u), task.circles)

    sizes = len(task.state_names), len(task.control_names)
    cost_check.within(simulate, sizes, task.observed, what, function)
    return checked(what, simulate, task, function)


def of_file(what: str, config: Config, task: Task) -> Simulate:
    """A control period of an MJCF file, whose entries `observe=` names, in the order of the task's state.

    Its gradients go forward through the simulator: contacts and limits are loops without a way back, and the few
    columns of the Jacobian [D, D + U] take less memory than the steps in between.
    """
    from pegasus_envs import mjcf_plant

    limits: dict[str, Any] = {name: tuple(map(float, getattr(task, name))) for name in ("control_low", "control_high")}
    try:
        plant = mjcf_plant.mechanism(mjcf_plant.read(Path(config.prior)), task.dt, observe=config.observe, **limits)  # type: ignore[arg-type]
    except ValueError as error:
        raise ConfigError(f"{what}: {' '.join(str(error).split())}") from error
    states, names = len(task.state_names), ", ".join(plant.state_names)
    if len(plant.state_names) != states:
        raise ConfigError(
            f"{what} has the state {names}, and {task.name} has {', '.join(task.state_names)};"
            " observe=[qpos.0,qvel.0] says which entries, in that order"
        )
    for its, mine in zip(plant.state_names, task.state_names, strict=True):
        units = {parted(name)[1] for name in (its, mine)}
        if len(units) == 2 and units <= {*UNITS}:
            raise ConfigError(
                f"{what} has {its} where {task.name} has {mine}: expected the order {', '.join(task.state_names)};"
                " observe=[qpos.0,qvel.0] says which entries, in that order"
            )

    def step(x: Array, u: Array) -> Array:
        return plant.observe(plant.step(plant.state_from_observation(x), u))

    def jacobian(x: Array, u: Array) -> tuple[Array, tuple[Array, Array]]:
        columns = jax.jacfwd(step, (0, 1))(x, u)
        return step(x, u), columns

    simulate = jax.custom_vjp(step)
    simulate.defvjp(jacobian, lambda columns, g: (g @ columns[0], g @ columns[1]))
    return simulate  # type: ignore[return-value]


def checked(what: str, simulate: Simulate, task: Task, function: Any = None) -> Simulate:
    """The simulator, if it makes a state of a state. Raises ConfigError, in one line, for anything else."""
    x, u = jnp.asarray(task.start_mean, float), (jnp.asarray(task.control_low, float) + task.control_high) / 2

    def total(x: Array, u: Array) -> tuple[Array, Array]:
        after = jnp.asarray(simulate(x, u))
        return jnp.sum(after), after

    with user_code.blamed(what, function):
        shape = jax.eval_shape(simulate, x, u)
    if getattr(shape, "shape", None) != x.shape:
        raise ConfigError(
            f"{what} returns {getattr(shape, 'shape', type(shape).__name__)} of a state {x.shape} and a control"
            f" {u.shape}; expected the state a control period later, {x.shape}"
        )
    with user_code.blamed(what, function):
        (_, after), slopes = jax.jit(jax.value_and_grad(total, (0, 1), has_aux=True))(x, u)
    if not jnp.isfinite(after).all():
        raise ConfigError(f"{what} makes {after.tolist()} of the start {x.tolist()}; expected finite numbers")
    if not all(jnp.isfinite(slope).all() for slope in slopes):
        raise ConfigError(
            f"{what} has a gradient that is not finite at the start {x.tolist()}, which no search follows"
        )
    return simulate
