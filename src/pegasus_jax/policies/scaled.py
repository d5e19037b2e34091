"""A controller's inputs, in units in which they are of order one: large ones saturate it, small ones do nothing."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from pegasus_jax.types import Array

LARGE = 20.0  # root mean square; entries of our own plants reach 15, and are left as they are
SMALL = 1 / LARGE  # entries of our own plants are .1 and more: docs/decisions.md 0040
MOST = 3.0  # root mean square of an entry whose unit is found in the data: docs/decisions.md 0040
CONSTANT = 1e-5  # of its size: what an entry varies by rounding


class Input(NamedTuple):
    """How features become inputs: (features - mean) / scale. It is kept with the parameters, and not learned."""

    mean: Array  # [F]
    scale: Array  # [F]


def in_units(units: Array) -> Input:
    """The input that divides features by these units [F]."""
    return Input(jnp.zeros_like(units), units)


def of_data(features: Array, size: Array, units: Array | float = 1.0, found: bool = False, waves: int = 0) -> Input:
    """The input for data whose first `size` rows of features [N, F] are in use, each counted in its unit [F].

    A feature whose root mean square is more than LARGE or less than SMALL has its mean subtracted and is divided by its
    standard deviation, or by its unit where it is constant; the others are divided by their unit only. The last `waves`
    are sines and cosines, which are never too small: an angle may have moved little so far. With units to be
    `found` in the data, a feature whose root mean square is above 1 then has that of MOST, and a smaller one is
    multiplied by MOST.
    """
    features = features / units
    used = (jnp.arange(features.shape[0]) < size)[:, None]
    count = jnp.maximum(size, 1).astype(features.dtype)
    rows = jnp.where(used, features, 0)
    mean = jnp.sum(rows, 0) / count
    rms = jnp.sqrt(jnp.sum(rows**2, 0) / count)
    spread = jnp.sqrt(jnp.sum(jnp.where(used, rows - mean, 0) ** 2, 0) / count)
    small = (rms < SMALL) & (jnp.arange(len(rms)) < len(rms) - waves)
    rescaled = (rms > LARGE) | small
    others, most = (jnp.maximum(rms, 1), MOST) if found else (1, 1)
    scale = jnp.where(rescaled, jnp.where(spread > CONSTANT * rms, spread, 1), others) / most
    return Input(jnp.where(rescaled, mean, 0) * units, scale * units)


def scaled(given: Input, features: Array) -> Array:
    """The inputs [..., F] of features [..., F]; no gradient reaches the scaling."""
    mean, scale = jax.lax.stop_gradient(given)
    return (features - mean) / scale
