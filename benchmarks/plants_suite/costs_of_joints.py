"""The costs and ends of batched.py: of the joints' positions and rates."""

import jax
import jax.numpy as jnp

from benchmarks.plants_suite.costs import inverted_pendulum, inverted_pendulum_falls, saturating
from pegasus_jax.types import Array

__all__ = [
    "double_pendulum",
    "double_pendulum_falls",
    "inverted_pendulum",
    "inverted_pendulum_falls",
    "pendulum",
    "reacher",
]


def pendulum(x: Array) -> Array:
    """[angle, rate], upright at 0."""
    return saturating((jnp.cos(x[0]) - 1) / 0.5, jnp.sin(x[0]) / 0.5)


def _tip(x: Array) -> tuple[Array, Array]:
    """How far beside the cart and how high the tip of two links of .6 m is [m]; x: [cart, 2 angles, rates]."""
    return 0.6 * (jnp.sin(x[1]) + jnp.sin(x[1] + x[2])), 0.6 * (jnp.cos(x[1]) + jnp.cos(x[1] + x[2]))


def double_pendulum(x: Array) -> Array:
    """Both links upright, over the middle."""
    beside, height = _tip(x)
    return saturating(x[0] / 1.0, beside / 0.2, (height - 1.2) / 0.1)


def double_pendulum_falls(x: Array) -> Array:
    """The episode ends where the tip is 1 m high."""
    return jax.nn.sigmoid((1 - _tip(x)[1]) / 0.02)


def reacher(x: Array) -> Array:
    """[2 angles, target's place, 2 rates]: the fingertip near the target from afar, and then exactly there."""
    along = 0.1 * jnp.cos(x[0]) + 0.11 * jnp.cos(x[0] + x[1])
    across = 0.1 * jnp.sin(x[0]) + 0.11 * jnp.sin(x[0] + x[1])
    square = (along - x[2]) ** 2 + (across - x[3]) ** 2
    return 1 - 0.5 * jnp.exp(-0.5 * square / 0.03**2) - 0.5 * jnp.exp(-0.5 * square / 0.15**2)
