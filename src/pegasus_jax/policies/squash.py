"""Smooth saturations of the real line to [-1, 1], scaled to a plant's control limits."""

from collections.abc import Callable

import jax.numpy as jnp

from pegasus_jax.types import Array

Squash = Callable[[Array], Array]


def sine(v: Array) -> Array:
    """(9 sin v + sin 3v) / 8, PILCO's saturation: its moments under a Gaussian are exact.

    Written with sin 3v = 3 sin v - 4 sin^3 v, so that it stays in [-1, 1] for any v in float32.
    """
    s = jnp.sin(v)
    return (3 * s - s**3) / 2


SQUASHES: dict[str, Squash] = {"tanh": jnp.tanh, "sine": sine}


def to_limits(squash: Squash, low: Array, high: Array) -> Squash:
    """v [U] -> u [U] in [low, high]."""
    middle, half = (high + low) / 2, (high - low) / 2
    return lambda v: jnp.clip(middle + half * squash(v), low, high)  # the clip only undoes rounding
