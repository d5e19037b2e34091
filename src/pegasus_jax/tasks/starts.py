"""Where episodes start, on a plant in JAX and in imagination."""

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax.checks import ConfigError
from pegasus_jax.task import Task, known
from pegasus_jax.tasks import circled
from pegasus_jax.types import Array, Key


def start(key: Key, *, task: Task) -> Array:
    """A first state [D] of the task."""
    if task.starts is not None and task.starts_std is not None:
        which, around = jax.random.split(key)
        place = jax.random.choice(which, jnp.asarray(task.starts, float))
        return place + jnp.asarray(task.starts_std, float) * jax.random.normal(around, place.shape)
    if task.starts is not None:
        return jax.random.choice(key, jnp.asarray(task.starts, float))
    mean, std = jnp.asarray(task.start_mean, float), jnp.asarray(task.start_std, float)
    return mean + std * jax.random.normal(key, mean.shape)


def examples(task: Task, count: int) -> np.ndarray:
    """First states [count, D] of the task, always the same. In NumPy: nothing is compiled for them."""
    draws = np.random.default_rng(0)
    mean, std = known(task, "start_mean"), known(task, "start_std")
    if task.starts is None:
        return mean + std * draws.normal(size=(count, len(mean)))
    places = np.asarray(task.starts, float)[draws.integers(len(task.starts), size=count)]
    return places if task.starts_std is None else places + task.starts_std * draws.normal(size=places.shape)


def from_starts(task: Task, starts: tuple[tuple[float, ...], ...]) -> Task:
    """The task whose plant in JAX starts around these states, equally likely, with the spread that its starts have.

    Raises ConfigError for a row of another length.
    """
    size, plant, spread = len(task.state_names), task.plant, np.asarray(task.start_std, float)
    for row in starts:
        if len(row) != size:
            raise ConfigError(f"a row of starts has {len(row)} entries; expected {size}: {', '.join(task.state_names)}")
    task = circled.start_moments(task._replace(starts=np.array(starts, float)))
    task = task._replace(start_std=np.hypot(task.start_std, spread), starts_std=spread)
    return task._replace(plant=plant._replace(reset=lambda key: plant.state_from_observation(start(key, task=task))))
