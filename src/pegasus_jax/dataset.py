"""The experience so far, in arrays of fixed capacity."""

import jax
import jax.numpy as jnp

from pegasus_jax.angles import difference
from pegasus_jax.types import Array, Batch, Dataset, Key, Trajectory


def empty(capacity: int, states: int, controls: int) -> Dataset:
    """A data set of `capacity` rows, none in use."""
    zeros = jnp.zeros
    return Dataset(zeros((capacity, states)), zeros((capacity, controls)), zeros((capacity, states)), jnp.int32(0))


def add(data: Dataset, trajectory: Trajectory, angles: tuple[int, ...]) -> Dataset:
    """The data set with the H transitions of an episode behind it (Alg. 1 line 4).

    A full data set forgets nothing silently: the caller sizes it for the whole run (trials x horizon).
    """
    y = difference(trajectory.x[1:], trajectory.x[:-1], angles)
    put = jax.lax.dynamic_update_slice_in_dim
    return Dataset(
        put(data.x, trajectory.x[:-1], data.size, 0),
        put(data.u, trajectory.u, data.size, 0),
        put(data.y, y, data.size, 0),
        data.size + y.shape[0],
    )


def grow(data: Dataset, capacity: int) -> Dataset:
    """The same data with room for `capacity` rows, at least as many as now."""
    more = capacity - data.x.shape[0]
    x, u, y = (jnp.pad(rows, ((0, more), (0, 0))) for rows in data[:3])
    return Dataset(x, u, y, data.size)


def minibatch(key: Key, data: Dataset, rows: int) -> Batch:
    """`rows` rows drawn with replacement from those in use."""
    index: Array = jax.random.randint(key, (rows,), 0, data.size)
    return Batch(data.x[index], data.u[index], data.y[index])
