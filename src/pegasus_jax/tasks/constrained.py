"""The constraint that a user's function of an observation poses; what is wrong with it is one line."""

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax.checks import ConfigError, shown
from pegasus_jax.config import Config
from pegasus_jax.imagine.limits import Constraint
from pegasus_jax.math.circles import to_observation
from pegasus_jax.task import Task
from pegasus_jax.tasks import cost_check, user_code
from pegasus_jax.types import Array

TURNS = 10  # [rad] an angle is looked at no further away than this


def of_config(config: Config, task: Task) -> Constraint | None:
    """The constraint that a config names, in units of how far the starts are from its limits; None where it has none.

    The function gets the task's observation. Raises ConfigError where it returns no numbers, or is positive where every
    episode starts.
    """
    if config.constraint is None:
        return None
    function, what = user_code.load("constraint", config.constraint), f"constraint={shown(config.constraint)}"
    points = jnp.asarray(np.asarray(task.start_mean)[None] if task.starts is None else task.starts, float)

    def numbers(x: Array) -> Array:
        return jnp.atleast_1d(jnp.asarray(function(to_observation(x, task.circles))))

    cost_check.within(numbers, (len(task.state_names),), task.observed, what, function)
    with user_code.blamed(what, function):
        values = jax.jit(lambda rows: jax.lax.map(numbers, rows))(points)
    if values.ndim != 2 or not jnp.issubdtype(values.dtype, jnp.floating):
        kind = f"an array of shape {values.shape[1:]}" if values.ndim != 2 else f"values of type {values.dtype}"
        raise ConfigError(
            f"{what} returns {kind}; expected a number, or a vector of numbers: how far x is beyond each limit, as"
            " jnp.abs(x[0]) - 1.5"
        )
    if not jnp.isfinite(values).all():
        raise ConfigError(f"{what} is not finite where episodes start; expected finite numbers")
    if (jnp.max(values, 1) >= 0).all():
        raise ConfigError(
            f"{what} is {float(jnp.max(values)):.3g} where episodes start, not negative: every episode would break it;"
            " is its sign right? Positive is beyond the limit"
        )
    scale = jnp.mean(jnp.abs(values), 0)
    scale = jnp.where(scale > 0, scale, 1.0)
    return Constraint(lambda x: numbers(x) / scale, config.constraint_bound)


def notes(constraint: Constraint | None, facts: cost_check.Facts, what: str) -> list[str]:
    """What its owner should know of a constraint. Raises ConfigError, beginning with `what`, if no search can keep it.

    It is looked at where a cost is, and far away along each entry of the state.
    """
    if constraint is None:
        return []
    away = [
        sign * size * axis
        for entry, axis in enumerate(np.eye(len(facts.start_mean)))
        for size in (0.1, 1, 10, 100, 1000)
        if size <= TURNS or entry not in facts.angles
        for sign in (1, -1)
    ]
    near = cost_check.probes(facts)
    numbers, slopes = _evaluated(constraint, np.concatenate([near, np.array(away) + facts.start_mean]), what)
    for kind, found in (("", numbers), ("gradient ", slopes.reshape(len(slopes), -1))):
        for i in np.flatnonzero(~np.isfinite(found[: len(near)]).all(1))[:1]:
            value = found[i][~np.isfinite(found[i])][0]
            raise ConfigError(f"{what} has a {kind or 'value '}of {value:g} at x={np.round(near[i], 3).tolist()}")
    for c in np.flatnonzero(~np.nan_to_num(slopes).any((0, 2)))[:1]:
        raise ConfigError(
            f"{what} has a gradient of 0 at each of {len(slopes)} points in its number {c}, so a search has nothing to"
            " follow; return how far x is beyond the limit, as jnp.abs(x[0]) - 1.5, not whether it is"
        )
    never = np.flatnonzero(~(np.nan_to_num(numbers) > 0).any(0))
    where = f"positive at none of {len(numbers)} points"
    return [f"{what} is {where} in its number {c}: is its sign right? Angles are in radians" for c in never]


def _evaluated(constraint: Constraint, points: np.ndarray, what: str) -> tuple[np.ndarray, np.ndarray]:
    """The numbers [P, C] of a constraint at points [P, D], and their gradients [P, C, D]."""

    def one(x: Array) -> tuple[Array, Array]:
        return constraint.of_state(x), jax.jacrev(constraint.of_state)(x)

    with user_code.blamed(what, constraint.of_state):
        found = jax.jit(jax.vmap(one))(jnp.asarray(points, float))
    return tuple(np.asarray(part, np.float64) for part in found)  # type: ignore[return-value]
