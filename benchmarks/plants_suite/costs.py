"""What a user writes for each plant: a cost of one observation, and where an episode ends."""

import jax
import jax.numpy as jnp

from pegasus_jax.types import Array


def saturating(*errors: Array) -> Array:
    """1 - exp(-|e|^2 / 2) of errors in units of what is still good."""
    return -jnp.expm1(-0.5 * sum(error**2 for error in errors))


def pendulum(x: Array) -> Array:
    """[cos, sin, rate], upright at 0: the cost of docs/simulator.md."""
    return saturating((x[0] - 1) / 0.5, x[1] / 0.5)


def inverted_pendulum(x: Array) -> Array:
    """[cart, angle, speed, rate], upright at 0."""
    return saturating(x[0] / 0.5, x[1] / 0.1)


def inverted_pendulum_falls(x: Array) -> Array:
    """The episode ends at an angle of .2 rad."""
    return jax.nn.sigmoid((jnp.abs(x[1]) - 0.2) / 0.01)


def _tip(x: Array) -> tuple[Array, Array]:
    """Place and height of the upper end of two links of .6 m [m]; x: [cart, 2 sines, 2 cosines, rates, force]."""
    return x[0] + 0.6 * (x[1] + x[1] * x[4] + x[3] * x[2]), 0.6 * (x[3] + x[3] * x[4] - x[1] * x[2])


def double_pendulum(x: Array) -> Array:
    """Both links upright, over the middle."""
    place, height = _tip(x)
    return saturating(x[0] / 1.0, (place - x[0]) / 0.2, (height - 1.2) / 0.1)


def double_pendulum_falls(x: Array) -> Array:
    """The episode ends where the tip is 1 m high."""
    return jax.nn.sigmoid((1 - _tip(x)[1]) / 0.02)


def mountain_car(x: Array) -> Array:
    """[place, rate]: the top of the hill."""
    return saturating((x[0] - 0.45) / 0.3)


def mountain_car_is_up(x: Array) -> Array:
    """The episode ends there."""
    return x[0] >= 0.45


def reacher(x: Array, u: Array) -> Array:
    """[2 cosines, 2 sines, target, rates], links of .1 and .11 m: what a step loses, of the most that it can be."""
    along = 0.1 * x[0] + 0.11 * (x[0] * x[1] - x[2] * x[3])
    across = 0.1 * x[2] + 0.11 * (x[2] * x[1] + x[0] * x[3])
    lost = jnp.sqrt((along - x[4]) ** 2 + (across - x[5]) ** 2 + 1e-6) + jnp.sum(u**2)
    return lost / 2.42


def cartpole(x: Array) -> Array:
    """[x, x', angle', angle] of the project's own cart-pole, 0 hanging: the tip over the middle of the rail."""
    return saturating((x[0] + 0.6 * jnp.sin(x[3])) / 0.25, 0.6 * (jnp.cos(x[3]) + 1) / 0.25)


def dm_cartpole(x: Array) -> Array:
    """[cart, angle, speed, rate], upright at 0: the tip of a pole of 1 m over the middle of the rail."""
    return saturating((x[0] + jnp.sin(x[1])) / 0.4, (jnp.cos(x[1]) - 1) / 0.4)


def two_links(x: Array) -> Array:
    """[2 angles, rates], 0 hanging, links of .2 and .3 m: the tip above the shoulder, and slow."""
    first, second = x[0], x[0] + x[1]
    beside = 0.2 * jnp.sin(first) + 0.3 * jnp.sin(second)
    height = -0.2 * jnp.cos(first) - 0.3 * jnp.cos(second)
    return saturating(beside / 0.2, (height - 0.5) / 0.2, x[2] / 20, x[3] / 20)
