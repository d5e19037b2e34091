"""What a run had learned after a trial, which every format writes in its own way."""

import re
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from pegasus_jax import memory as recall
from pegasus_jax.config import Config
from pegasus_jax.math.circles import entries, to_state
from pegasus_jax.task import Task
from pegasus_jax.tasks import sensed
from pegasus_jax.types import Array, Params, Policy


class Learned(NamedTuple):
    """The policy that a run had after a trial."""

    run: str  # the name of its folder
    trial: int
    config: Config
    task: Task
    policy: Policy
    params: Params
    asked: tuple[float, ...] = ()  # the sizes of the last entries of the state, which are no sensors': exports/asked.py

    @property
    def title(self) -> str:
        """Which one it is, in words."""
        return f"The controller after trial {self.trial} of {self.run}, task {self.task.name}"

    @property
    def dtype(self) -> np.dtype:
        """The type of all its numbers."""
        return np.dtype(np.float64 if self.config.x64 else np.float32)

    @property
    def observation(self) -> tuple[str, ...]:
        """Names of the entries of an observation [O]; without any, a cosine and a sine are x0, x1, ..."""
        if names := self.config.state_names:
            return tuple(names[i] for i in self.config.sensors.measured or range(len(names)))
        task, measured = self.task, recall.measured(self.task)
        size = len(measured) + len(task.circles)
        kept = dict(zip(entries(size, task.circles), (task.state_names[i] for i in measured), strict=True))
        paired = {entry for pair in task.circles for entry in pair}
        return tuple(f"x{i}" if i in paired else kept[i] for i in range(size))


def function(learned: Learned) -> Callable[[Array], Array]:
    """The policy as a function of an observation [O], to be traced: control [U], every noisy unit at its mean."""

    def act(observation: Array) -> Array:
        # What depends on the weights alone, such as an RBF controller's regression, is computed while it is traced.
        with jax.ensure_compile_time_eval():
            return learned.policy.apply(learned.params, None, to_state(observation, learned.task.circles))

    return act


def along(learned: Learned) -> Callable[[Array], Array]:
    """The policy as a function of an episode's observations [L, O], to be traced: the controls [L, U]."""
    task, memory = learned.task, learned.task.memory
    see, _, advance = recall.steps(memory)

    def act(m: Any, o: Array) -> tuple[Any, Array]:
        u = learned.policy.apply(learned.params, None, see(m, o))
        return advance(m, o, u), u

    def episode(observations: Array) -> Array:
        o = sensed.state(observations, task)
        return jax.lax.scan(act, recall.begin(memory, jax.random.key(0), o[0]), o)[1]

    return episode


def said(text: str) -> str:
    """A text as a comment of any language can have it."""
    return re.sub(r"[^\w .,:;()\[\]/+^'-]", "_", text)
