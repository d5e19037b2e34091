"""One episode of a controller: on a plant in JAX, as one pure function, or on an environment, step by step."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax import interrupt
from pegasus_jax import memory as recall
from pegasus_jax.shapes import check_shape
from pegasus_jax.task import Task
from pegasus_jax.types import Array, Key, Trajectory

CUT = ("error", "interrupted")  # ends that say nothing of the policy


class Episode(NamedTuple):
    """An episode on an environment, and why it is over."""

    trajectory: Trajectory
    ended: str = "horizon"  # or terminated, truncated; error, interrupted
    error: BaseException | None = None  # what was raised


def run(key: Key, act: Callable[[Key, Array, Array], Array], task: Task) -> Trajectory:
    """H control periods of act(key, t, what the policy sees [P]) -> u [U] on the task's plant, from a random start.

    The controller and the data see the state with sensor noise; the cost is of the true state. Where the task's `stop`
    says so it is over: the periods after that are no data, and cost `stop_cost`.
    """
    return run_with_trace(key, act, task, lambda state, u: ())[0]


def run_with_trace(
    key: Key, act: Callable[[Key, Array, Array], Array], task: Task, look: Callable[[Any, Array], Any]
) -> tuple[Trajectory, Any]:
    """`run`, and what `look(plant's state, u [U])` returned at the beginning of each control period [H, ...]."""
    if task.plant is None:
        raise ValueError(f"task {task.name} has no plant in JAX; hand its episodes to add_episode")
    plant = task.plant
    begin, first, steps = jax.random.split(key, 3)
    see, _, advance = recall.steps(task.memory)
    sensor_std = jnp.asarray(task.sensor_std, float)

    def measure(key: Key, state: object) -> Array:
        x = jnp.asarray(plant.observe(state), float)
        check_shape("what plant.observe returns", x, (len(task.state_names),), "[D]")
        return x + sensor_std * jax.random.normal(key, x.shape)

    def step(carry: tuple, t_and_key: tuple[Array, Key]) -> tuple[tuple, tuple[Array, Array, Array, Array, Any]]:
        state, x, m = carry
        t, key = t_and_key
        act_key, sensor_key = jax.random.split(key)
        u = act(act_key, t, see(m, x))
        check_shape("what policy.apply returns", u, (len(task.control_names),), "[U]")
        looked = look(state, u)
        before, state = state, plant.step(state, u)
        check_state(before, state)
        after = measure(sensor_key, state)
        m = advance(m, x, u)
        seen = recall.join(plant.observe(state), m)
        over = jnp.zeros((), bool) if task.stop is None else task.stop(seen) > 0.5
        cost = task.cost.of_state(seen)
        check_shape("the cost of one state", cost, ())
        return (state, after, m), (after, u, cost, over, looked)

    state = plant.reset(begin)
    x = measure(first, state)
    m, times = recall.begin(task.memory, begin, x), jnp.arange(task.horizon)
    _, (xs, us, costs, over, looks) = jax.lax.scan(step, (state, x, m), (times, jax.random.split(steps, task.horizon)))
    xs = jnp.concatenate([x[None], xs])
    if task.stop is None:
        return Trajectory(xs, us, costs, memory=m), looks
    length = jnp.where(jnp.any(over), jnp.argmax(over) + 1, task.horizon).astype(jnp.int32)
    return Trajectory(xs, us, jnp.where(times < length, costs, task.stop_cost), length, m), looks


def check_state(before: Any, after: Any) -> None:
    """Raises ValueError, in one line, unless a plant's state has the same parts, shapes and types after a step.

    The type of a number that Python made, as 0 of `{"t": 0}`, is JAX's to choose.
    """
    parts, now = jax.tree.structure(before), jax.tree.structure(after)
    if parts != now:
        raise ValueError(f"plant.step returns a state of parts {now}; expected {parts}, as plant.reset returns it")
    for (path, was), now in zip(jax.tree.leaves_with_path(before), jax.tree.leaves(after), strict=True):
        was, now, where = jax.typeof(was), jax.typeof(now), jax.tree_util.keystr(path)
        if was.shape != now.shape or not (was.dtype == now.dtype or was.weak_type):
            raise ValueError(
                f"plant.step returns a state{where} of {now.str_short()}; expected {was.str_short()}, as plant.reset"
                " returns it"
            )


def drive(seed: int, act: Callable[[int, np.ndarray], Any], task: Task) -> Episode:
    """At most H control periods of act(t, x [D]) -> u [U] on the task's environment; its rows are NumPy's, of NaN cost.

    `terminated` and `truncated` end it, and so does what the environment raises, an observation that is not finite, and
    a signal: then `error` is what was raised, the rows so far are kept, and the environment is closed before this
    returns. Otherwise its `rest` is called, as fit and search take time. Before every control a request to stop is
    checked. Rows hold the controls as they were sent.
    """
    rows, ended, error, first = [], "horizon", None, None
    try:
        with interrupt.heard():
            interrupt.forget_input()
            first = x = task.environment.reset(seed)
            interrupt.reclaim()
            for t in range(task.horizon):
                u = act(t, x)
                interrupt.check()
                x, sent, over = task.environment.step(u)
                rows.append((x, sent))
                if over:
                    # A time limit that is the horizon ends nothing early.
                    ended = "horizon" if (over, t + 1) == ("truncated", task.horizon) else over
                    break
            task.environment.rest()
    except BaseException as raised:
        interrupt.let_go(task.environment.close)
        ended, error = "interrupted" if isinstance(raised, KeyboardInterrupt) else "error", raised
    states, controls = len(task.state_names), len(task.control_names)
    x = np.array([*([] if first is None else [first]), *(x for x, _ in rows)], np.float32).reshape(-1, states)
    u = np.array([u for _, u in rows], np.float32).reshape(-1, controls)
    return Episode(Trajectory(x, u, np.full(len(u), np.nan, np.float32)), ended, error)  # type: ignore[arg-type]


def padded(trajectory: Trajectory, horizon: int) -> Trajectory:
    """The episode of L <= H control periods in arrays of H, with its length: nothing recompiles for another L.

    In NumPy: a program for each L would be compiled between two episodes.
    """
    length: Any = np.int32(len(trajectory.cost))

    def pad(rows: Any, size: int) -> Any:
        rows = np.asarray(rows)
        return np.pad(rows, [(0, size - len(rows)), *[(0, 0)] * (rows.ndim - 1)])

    x, u, cost = pad(trajectory.x, horizon + 1), pad(trajectory.u, horizon), pad(trajectory.cost, horizon)
    return Trajectory(x, u, cost, length, trajectory.memory)


def trimmed(trajectory: Trajectory) -> Trajectory:
    """The rows that took place, without a length: what is stored, and drawn."""
    length = len(trajectory.u) if trajectory.length is None else int(trajectory.length)
    rows = trajectory.x[: length + 1], trajectory.u[:length], trajectory.cost[:length]
    return Trajectory(*rows, memory=trajectory.memory)


def states(task: Task, trajectory: Trajectory) -> Array:
    """x' [H+1, D + M] along an episode: what its costs are of."""
    return recall.join(jnp.asarray(trajectory.x), recall.replay(task.memory, trajectory))


def costs(task: Task, trajectory: Trajectory) -> Array:
    """What each control period [H] of an episode costs, by what was observed; in JAX, to be jitted."""
    return jax.vmap(task.cost.of_state)(states(task, trajectory)[1:])


def charged(cost: Any, task: Task) -> np.ndarray:
    """The costs [H] of an episode of L periods: each of those that an early end left out costs `task.stop_cost`."""
    cost = np.asarray(cost, np.float64)
    return np.concatenate([cost, np.full(task.horizon - len(cost), task.stop_cost)])


def mean_cost(ran: Episode, task: Task) -> float:
    """Mean cost a step of an episode; of one that a fault or a person cut short, of the steps that there were.

    The same number for an episode that was just run and for one that was read back.
    """
    cost = np.asarray(ran.trajectory.cost, np.float64)
    return float(np.mean(cost if ran.ended in CUT else charged(cost, task)))


def succeeded(costs: Any, task: Task) -> np.ndarray:
    """Which episodes [...] of costs [..., H] succeeded: their last five steps cost little on average."""
    return np.mean(np.asarray(costs)[..., -5:], axis=-1) < task.success


def works(trajectory: Trajectory, task: Task) -> Array:
    """Whether an episode succeeded [], in JAX; the periods that an early end left out cost `task.stop_cost`."""
    cost = jnp.asarray(trajectory.cost)
    if trajectory.length is not None:
        cost = jnp.where(jnp.arange(len(cost)) < trajectory.length, cost, task.stop_cost)
    return jnp.mean(cost[-5:]) < task.success


def verdict(ran: Episode, task: Task) -> dict[str, Any]:
    """What an episode says of its policy: its mean cost a step, and whether it succeeded."""
    return {
        "episode_cost": mean_cost(ran, task),
        "episode_success": bool(succeeded(charged(ran.trajectory.cost, task), task)),
    }


def uniform(key: Key, low: Array, high: Array, horizon: int) -> Array:
    """Random controls [H, U], independent and uniform within the limits."""
    return jax.random.uniform(key, (horizon, low.shape[0]), minval=low, maxval=high)


def gently(plan: Array, amplitude: float, low: Array, high: Array) -> Array:
    """Controls [H, U] drawn in towards rest, 0 or the limit next to it: `amplitude` of how far they were from it.

    That is so in the last period; in the first it is a fifth of that, and grows evenly, so that a person can step in.
    """
    rest = jnp.clip(0.0, low, high)
    return rest + amplitude * jnp.linspace(0.2, 1.0, len(plan))[:, None] * (plan - rest)


def random_walk(key: Key, low: Array, high: Array, horizon: int) -> Array:
    """Random controls [H, U]: with probability 0.3 a step goes 0.75 of the way to a fresh uniform draw.

    The exploration of the authors' swimmer scripts (docs/reference.md 3.4).
    """
    fresh_key, move_key = jax.random.split(key)
    fresh = uniform(fresh_key, low, high, horizon)
    moves = jax.random.bernoulli(move_key, 0.3, (horizon,)).at[0].set(True)

    def step(u: Array, draw: tuple[Array, Array]) -> tuple[Array, Array]:
        target, moved = draw
        u = jnp.where(moved, u + 0.75 * (target - u), u)
        return u, u

    return jax.lax.scan(step, fresh[0], (fresh, moves))[1]
