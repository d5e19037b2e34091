"""A goal, a reference or the time for an exported controller, at each call: further entries of its observation."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from pegasus_jax import memory as recall
from pegasus_jax.task import Task
from pegasus_jax.tasks import sensed, terms


def asking(control: Callable[[Any], np.ndarray], task: Task, seed: int) -> tuple[Callable[..., np.ndarray], list[Any]]:
    """(act(t, x [D]) -> u, memories): a file's controller, given the goals and references of an episode of the task.

    The memory at the episode's start is put into `memories`. All is compiled here, before anything moves.
    """
    names, memory, memories = terms.asked_names(task), task.memory, []
    if not names:
        return lambda t, x: control(sensed.observation(x, task)), memories
    see, _, advance = recall.steps(memory)
    places = np.array([recall.seen_names(task).index(name) for name in names])
    begin = jax.jit(lambda x: recall.begin(memory, jax.random.key(seed), x))
    shown, later = jax.jit(lambda m, x: see(m, x)[places]), jax.jit(advance)
    kept = begin(rest := np.zeros(len(task.state_names), np.float32))
    later(kept, rest, np.zeros(len(task.control_names), np.float32))
    shown(kept, rest)

    def act(t: int, x: np.ndarray) -> np.ndarray:
        nonlocal kept
        if t == 0:
            kept = begin(x)
            memories.append(kept)
        u = control(np.concatenate([sensed.observation(x, task), np.asarray(shown(kept, x))]))
        kept = later(kept, x, u.astype(np.float32))
        return u

    return act, memories
