"""A controller from somebody else's network: a Flax module's, or any pair of functions."""

from collections.abc import Callable

import jax.numpy as jnp

from pegasus_jax.checks import choice
from pegasus_jax.math.angles import encode
from pegasus_jax.memory import seen_angles
from pegasus_jax.policies.squash import SQUASHES, to_limits
from pegasus_jax.shapes import check_shape
from pegasus_jax.task import Task
from pegasus_jax.types import Array, Key, Params, Policy


def of_pair(
    init: Callable[[Key], Params], apply: Callable[[Params, Array], Array], task: Task, squash: str = "tanh"
) -> Policy:
    """u = apply(params, features [F]) [U], any real numbers, saturated to the task's limits by tanh or sine.

    The features are those of every other controller: what the policy sees, with its angles as sines and cosines
    (`angles.encode`): the state, and what the task's memory shows. Raises ConfigError for another saturation, and
    ValueError where `apply` returns another shape.
    """
    choice("squash", squash, SQUASHES)
    low, high = jnp.asarray(task.control_low, float), jnp.asarray(task.control_high, float)
    saturate = to_limits(SQUASHES[squash], low, high)
    turning = seen_angles(task)

    def limited(params: Params, noise: Params, x: Array) -> Array:
        u = apply(params, encode(x, turning))
        check_shape("what apply returns", u, low.shape, "[U]")  # the limits would make as many of one number
        return saturate(u)

    return Policy(init, lambda key: (), limited)
