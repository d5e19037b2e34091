"""Angles enter networks as (sin, cos) and leave data as wrapped differences (Deisenroth 2010)."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from pegasus_jax.types import Array

__all__ = ["difference", "encode", "feature_names", "wrap"]


def encode(x: Array, angles: tuple[int, ...]) -> Array:
    """Features [..., F] of states x [..., D]: the other dimensions, then all sines, then all cosines; F = D + A.

    Raises ValueError for an angle that is none of the D dimensions, or named twice.
    """
    check_places(angles, x.shape[-1])
    plain = pick(x, [i for i in range(x.shape[-1]) if i not in angles])
    angle = pick(x, angles)
    return jnp.concatenate([plain, jnp.sin(angle), jnp.cos(angle)], axis=-1)


def check_places(angles: tuple[int, ...], size: int) -> None:
    """Raises ValueError unless these are different dimensions, from 0 on; JAX would take others, or none."""
    for angle in angles:
        if not 0 <= angle < size:
            raise ValueError(f"angles={angles} has {angle}; expected indices from 0 to {size - 1}")
        if list(angles).count(angle) > 1:
            raise ValueError(f"angles={angles} has {angle} twice; expected different indices")


def pick(x: Array, indices: Sequence[int]) -> Array:
    """x[..., indices] by slices: a GPU's compiler joins them with what is around them, there and back."""
    return jnp.concatenate([x[..., :0], *(x[..., i : i + 1] for i in indices)], axis=-1)


def feature_names(names: tuple[str, ...], angles: tuple[int, ...]) -> tuple[str, ...]:
    """Names of the features of `encode`, in its order. Raises ValueError as it does."""
    check_places(angles, len(names))
    plain = tuple(name for i, name in enumerate(names) if i not in angles)
    return plain + tuple(f"sin {names[i]}" for i in angles) + tuple(f"cos {names[i]}" for i in angles)


def wrap(angle: Array) -> Array:
    """The same angle [rad] in [-pi, pi]; exact (no change at all) for angles already inside."""
    return jnp.where(jnp.abs(angle) <= jnp.pi, angle, jnp.arctan2(jnp.sin(angle), jnp.cos(angle)))


def difference(after: Array, before: Array, angles: tuple[int, ...]) -> Array:
    """after - before [..., D], the angle dimensions wrapped: a roll that crosses 180 degrees has not jumped."""
    change = jnp.asarray(after - before)
    check_places(angles, change.shape[-1])
    return change.at[..., np.array(angles, int)].set(wrap(change[..., np.array(angles, int)])) if angles else change
