"""What a controller knows exactly beside its newest observation: values that make a `Memory`, and how they are used.

A state of a rollout is x' = [x, m]: x [D] is what a model predicts, m [M] is computed. A memory is a machine with one
step a control period: it holds m when the observation o [O] comes, the policy sees `see(m, o)`, and `advance(m, o, u)`
makes the next m. The same functions run in imagination, on a plant in JAX, on an environment and in an
exported controller.
"""

import re
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax.math.units import rate_of
from pegasus_jax.task import Task
from pegasus_jax.types import NO_MEMORY, Array, Key, Memory, Trajectory

__all__ = ["clock", "combined", "constant", "past_controls"]

# What the key of an episode's start is folded with for its memory. It is not small: fold_in(key, 1) is split(key)[1].
_START = 2**31 - 1


def past_controls(names: tuple[str, ...], rest: Any, count: int, *, shown: bool) -> Memory:
    """The last `count` controls, newest first; before an episode they were `rest` [U].

    Those of two periods ago and before are in m while a state is reached by the newest: a cost of x' can tell how much
    a control changed. With `shown` the policy sees them, too.
    """
    rest, size = np.asarray(rest, float), len(names)
    past = tuple(f"{name} {i} before" for i in range(1, count + 1) for name in names)

    return Memory(
        names=past,
        start=lambda key, o: jnp.tile(jnp.asarray(rest, o.dtype), count),
        advance=lambda m, o, u: jnp.concatenate([u, m[: size * (count - 1)]]),
        shown=past if shown else (),
        show=lambda m, o: m if shown else m[:0],
    )


def resting(task: Task) -> np.ndarray:
    """What an episode's controls [U] are taken to have been before it: 0, or the nearest that is allowed."""
    return np.clip(np.zeros(len(task.control_names)), task.control_low, task.control_high)


def clock(dt: float) -> Memory:
    """The time since an episode's start [s], which the policy does not see."""
    return Memory(("t [s]",), lambda key, o: jnp.zeros(1, o.dtype), lambda m, o, u: m + dt, matched=False)


def constant(names: tuple[str, ...], draw: Callable[[Key], Array]) -> Memory:
    """Numbers `draw(key)` [M] that are drawn for each episode, and which the policy sees: a goal."""
    start = lambda key, o: draw(key).astype(o.dtype)  # noqa: E731
    return Memory(names, start, lambda m, o, u: m, shown=names, show=lambda m, o: m, matched=False)


def combined(*memories: Memory) -> Memory:
    """All of these memories at once, their entries in this order.

    One of them at most may say what the model's control is (`applied`). Raises ValueError for two.
    """
    memories = tuple(memory for memory in memories if memory.names)
    if len(memories) < 2:
        return memories[0] if memories else NO_MEMORY
    measuring = [memory.measured for memory in memories if memory.measured is not None]
    applying = [i for i, memory in enumerate(memories) if memory.applied is not None]
    if len(applying) > 1:
        raise ValueError(f"{len(applying)} memories say what the model's control is; expected one at most")
    ends = np.cumsum([0, *(len(memory.names) for memory in memories)])
    shown = np.cumsum([0, *(len(memory.shown) for memory in memories)])

    def part(m: Any, i: int) -> Any:
        return m[ends[i] : ends[i + 1]]

    def each(function: Callable[[int, Memory], Array]) -> Array:
        return jnp.concatenate([function(i, memory) for i, memory in enumerate(memories)])

    def applied(m: Any, u: Array) -> Array:
        (i,) = applying
        return memories[i].applied(part(m, i), u)  # type: ignore[misc]

    return Memory(
        names=tuple(name for memory in memories for name in memory.names),
        start=lambda key, o: each(lambda i, memory: memory.start(jax.random.fold_in(key, i), o)),
        advance=lambda m, o, u: each(lambda i, memory: memory.advance(part(m, i), o, u)),
        shown=tuple(name for memory in memories for name in memory.shown),
        show=lambda m, o: each(lambda i, memory: memory.show(part(m, i), o)),
        shown_angles=tuple(int(shown[i]) + a for i, memory in enumerate(memories) for a in memory.shown_angles),
        shown_units=tuple(unit for memory in memories for unit in units(memory)),
        applied=applied if applying else None,
        matched=all(memory.matched for memory in memories),
        measured=measuring[0] if measuring else None,
    )


def join(x: Array, m: Array | None) -> Array:
    """x' [..., D + M] of a state x [..., D] and a memory [..., M]; x itself where there is none."""
    return x if m is None else jnp.concatenate([x, m], -1)


def split(state: Array, states: int) -> tuple[Array, Array | None]:
    """x [..., D] and m [..., M] of x' [..., D + M]; m is None where there is none."""
    return (state, None) if state.shape[-1] == states else (state[..., :states], state[..., states:])


def begin(memory: Memory, key: Key, o: Array) -> Array | None:
    """m [M] at the first observation of the episode whose start is drawn from `key`."""
    return memory.start(jax.random.fold_in(key, _START), o) if memory.names else None


def steps(memory: Memory) -> tuple[Callable[..., Array], Callable[..., Array], Callable[..., Any]]:
    """What a memory does in a control period, each a function of m [M] or, where there is none, of None:

    see: (m, o [O]) -> what the policy sees [P]. given: (m, u [U]) -> what the model is given as the control [V].
    advance: (m, o, u) -> m one period later.
    """

    measured = None if memory.measured is None else np.array(memory.measured)

    def see(m: Any, o: Array) -> Array:
        seen = o if measured is None else o[measured]
        return jnp.concatenate([seen, memory.show(m, o)]) if memory.shown else seen

    def given(m: Any, u: Array) -> Array:
        return u if memory.applied is None else memory.applied(m, u)

    return see, given, memory.advance


def given_size(memory: Memory, controls: int) -> int:
    """V, the entries of what the model is given as the control."""
    m = jnp.zeros(len(memory.names)) if memory.names else None
    return jax.eval_shape(steps(memory)[1], m, jnp.zeros(controls)).shape[0]


def measured(task: Task) -> tuple[int, ...]:
    """The entries of the state that the sensors measure; what an observation has in the other entries is not used."""
    return tuple(range(len(task.state_names))) if task.memory.measured is None else task.memory.measured


def coordinates(task: Task) -> list[int]:
    """The entries of the state that are no rates, in the order of their rates."""
    return [i for i in range(len(task.state_names)) if i not in task.rates]


def units(memory: Memory) -> tuple[float, ...]:
    """The unit of each entry that the memory shows to the policy."""
    return memory.shown_units or (1.0,) * len(memory.shown)


def seen_names(task: Task) -> tuple[str, ...]:
    """Names of what the policy sees [P]."""
    return (*(task.state_names[i] for i in measured(task)), *task.memory.shown)


def seen_kinds(task: Task) -> tuple[str, ...]:
    """What the policy sees [P], by places in state and control instead of their names, which are a user's."""
    places = {f"measured {rate_of(name)}": f"rate {i}" for i, name in enumerate(task.state_names)}
    named = [
        (name, f"{what} {i}") for what in ("state", "control") for i, name in enumerate(getattr(task, f"{what}_names"))
    ]

    def kind(shown: str) -> str:
        for name, place in named:
            if re.fullmatch(rf"{re.escape(name)} \d+ before", shown):
                return place + shown.removeprefix(name)
        return places.get(shown, shown.partition(" in ")[0])  # a reference's time follows from dt, which may differ

    return (*(f"state {i}" for i in measured(task)), *map(kind, task.memory.shown))


def seen_angles(task: Task) -> tuple[int, ...]:
    """Which entries of what the policy sees are angles."""
    seen = measured(task)
    return (*(seen.index(i) for i in task.angles if i in seen), *(len(seen) + i for i in task.memory.shown_angles))


def replay(memory: Memory, trajectory: Trajectory) -> Array | None:
    """m [H+1, M] along an episode, from its observations and controls; rows after its end have no meaning."""
    if not memory.names:
        return None
    o, u = jnp.asarray(trajectory.x), jnp.asarray(trajectory.u)
    # An episode that was not run here does not store what was drawn for it.
    first: Any = begin(memory, jax.random.key(0), o[0]) if trajectory.memory is None else jnp.asarray(trajectory.memory)

    def step(m: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
        m = memory.advance(m, *row)
        return m, m

    return jnp.concatenate([first[None], jax.lax.scan(step, first, (o[:-1], u))[1]])
