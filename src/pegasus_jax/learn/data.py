"""The experience so far, in arrays of fixed capacity: x [N, D], u [N, U], y [N, D]."""

import jax
import jax.numpy as jnp

from pegasus_jax.math.angles import difference
from pegasus_jax.shapes import check_trajectory
from pegasus_jax.types import Array, Batch, Dataset, Key, Trajectory

__all__ = ["add", "empty", "grow", "minibatch", "room"]

LEAST_ROOM = 1024  # rows; 40 episodes of the cart-pole


def room(rows: int) -> int:
    """The capacity for at least so many rows: a power of two, so that runs of other lengths share compiled programs."""
    return max(LEAST_ROOM, 1 << (int(rows) - 1).bit_length())


def empty(capacity: int, states: int, controls: int, memory: int = 0) -> Dataset:
    """A data set of `capacity` rows, none in use."""
    x, u, y = (jnp.zeros((capacity, size)) for size in (states, controls, states))
    return Dataset(x, u, y, jnp.int32(0), jnp.zeros((capacity, memory)) if memory else None)


def add(data: Dataset, trajectory: Trajectory, angles: tuple[int, ...], memory: Array | None = None) -> Dataset:
    """The data set with the transitions of an episode appended (Alg. 1 line 4), and the `memory` along it [H+1, M].

    Rows that did not take place are left out, and so are rows beyond the capacity: the caller makes room for the whole
    run (trials x horizon). Raises ValueError for an episode of other widths.
    """
    check_trajectory(trajectory, data.x.shape[1], data.u.shape[1])
    horizon, capacity = trajectory.u.shape[0], data.x.shape[0]
    length = horizon if trajectory.length is None else jnp.clip(trajectory.length, 0, horizon)
    place = jnp.where((rows := jnp.arange(horizon)) < length, data.size + rows, capacity)  # beyond the end: dropped
    y = difference(trajectory.x[1:], trajectory.x[:-1], angles)
    new = Dataset(trajectory.x[:-1], trajectory.u, y, data.size, None if memory is None else memory[:-1])
    placed = jax.tree.map(lambda old, rows: old if old.ndim == 0 else old.at[place].set(rows, mode="drop"), data, new)
    return placed._replace(size=jnp.minimum(data.size + length, capacity).astype(jnp.int32))


def grow(data: Dataset, capacity: int) -> Dataset:
    """The same data with room for `capacity` rows, at least as many as now."""
    return jax.tree.map(lambda rows: jnp.pad(rows, ((0, capacity - len(data.x)), (0, 0))) if rows.ndim else rows, data)


def minibatch(key: Key, data: Dataset, rows: int) -> Batch:
    """`rows` rows drawn with replacement from those in use."""
    index: Array = jax.random.randint(key, (rows,), 0, data.size)
    return Batch(*(jnp.asarray(values)[index] for values in (data.x, data.u, data.y)))
