"""What a file is asked for at each call, a goal, a reference or the time, as further entries of its observation."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from pegasus_jax import memory as recall
from pegasus_jax.task import Task
from pegasus_jax.tasks import sensed, terms
from pegasus_jax.types import NO_MEMORY


def observed(task: Task) -> tuple[Task, tuple[float, ...]]:
    """The task of a file, that observes what its policy is asked for behind x, and the sizes of these entries.

    A task whose policy sees of its memory anything else is returned as it is.
    """
    names, units = terms.asked_names(task), recall.units(task.memory)
    if not task.memory.names or task.memory.shown != names:
        return task, ()

    def grown(values: Any, more: Any) -> np.ndarray:
        return np.concatenate([np.asarray(values, float), np.asarray(more, float)])

    none = np.zeros(len(names))
    found = task._replace(
        memory=NO_MEMORY,
        terms=(),
        reference=None,
        goal=None,
        state_names=(*task.state_names, *names),
        start_mean=grown(task.start_mean, none),
        start_std=grown(task.start_std, units),
        sensor_std=grown(task.sensor_std, none),
    )
    return found, units


def asking(control: Callable[[Any], np.ndarray], task: Task, seed: int) -> tuple[Callable[..., np.ndarray], list[Any]]:
    """(act(t, x [D]) -> u, memories): a file's controller, asked for what an episode of the task asks for.

    The memory of the episode's start is put into `memories`. All is compiled here, before anything moves.
    """
    names, memory, memories = terms.asked_names(task), task.memory, []
    if not memory.names or memory.shown != names:
        return lambda t, x: control(sensed.observation(x, task)), memories
    see, _, advance = recall.steps(memory)
    begin = jax.jit(lambda x: recall.begin(memory, jax.random.key(seed), x))
    shown, later = jax.jit(lambda m, x: see(m, x)[len(x) :]), jax.jit(advance)
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
