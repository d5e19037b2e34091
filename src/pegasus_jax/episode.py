"""One episode of a controller on a simulated plant."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from pegasus_jax.types import Array, Key, Task, Trajectory


def run(key: Key, act: Callable[[Key, Array, Array], Array], task: Task) -> Trajectory:
    """H control periods of act(key, t, x [D]) -> u [U] on the task's plant, from a random start.

    The controller and the data see the state with sensor noise; the cost is of the true state.
    """
    return watch(key, act, task, lambda state, u: ())[0]


def watch(
    key: Key, act: Callable[[Key, Array, Array], Array], task: Task, look: Callable[[Any, Array], Any]
) -> tuple[Trajectory, Any]:
    """`run`, and what `look(plant's state, u [U])` returned at the beginning of each control period [H, ...]."""
    assert task.plant is not None, f"task {task.name} has no simulated plant"
    plant = task.plant
    begin, first, steps = jax.random.split(key, 3)
    sensor_std = jnp.asarray(task.sensor_std, float)

    def measure(key: Key, state: object) -> Array:
        x = plant.observe(state)
        return x + sensor_std * jax.random.normal(key, x.shape)

    def step(carry: tuple, t_and_key: tuple[Array, Key]) -> tuple[tuple, tuple[Array, Array, Array, Any]]:
        state, x = carry
        t, key = t_and_key
        act_key, sensor_key = jax.random.split(key)
        u = act(act_key, t, x)
        looked = look(state, u)
        state = plant.step(state, u)
        after = measure(sensor_key, state)
        return (state, after), (after, u, task.cost(plant.observe(state)), looked)

    state = plant.reset(begin)
    x = measure(first, state)
    times = jnp.arange(task.horizon)
    _, (xs, us, costs, looks) = jax.lax.scan(step, (state, x), (times, jax.random.split(steps, task.horizon)))
    return Trajectory(jnp.concatenate([x[None], xs]), us, costs), looks


def uniform(key: Key, low: Array, high: Array, horizon: int) -> Array:
    """Random controls [H, U], independent and uniform within the limits."""
    return jax.random.uniform(key, (horizon, low.shape[0]), minval=low, maxval=high)


def random_walk(key: Key, low: Array, high: Array, horizon: int, move: float = 0.3, pull: float = 0.75) -> Array:
    """Random controls [H, U]: with probability `move` a step goes `pull` of the way to a fresh uniform draw.

    The exploration of the authors' swimmer scripts (docs/reference.md 3.4).
    """
    fresh_key, move_key = jax.random.split(key)
    fresh = uniform(fresh_key, low, high, horizon)
    moves = jax.random.bernoulli(move_key, move, (horizon,)).at[0].set(True)

    def step(u: Array, draw: tuple[Array, Array]) -> tuple[Array, Array]:
        target, moved = draw
        u = jnp.where(moved, u + pull * (target - u), u)
        return u, u

    return jax.lax.scan(step, fresh[0], (fresh, moves))[1]
