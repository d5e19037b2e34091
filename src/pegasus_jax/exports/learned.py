"""What a run had learned after a trial, which every format writes in its own way."""

import re
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax import memory as recall
from pegasus_jax.config import Config
from pegasus_jax.math.circles import entries
from pegasus_jax.task import Task
from pegasus_jax.tasks import sensed, terms
from pegasus_jax.tasks.remembered import remembering
from pegasus_jax.types import NO_MEMORY, Array, Memory, Params, Policy

BEGUN = "1 within an episode"


class Learned(NamedTuple):
    """The policy that a run had after a trial."""

    run: str  # the name of its folder
    trial: int
    config: Config
    task: Task
    policy: Policy
    params: Params

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
        """Names of the entries of an observation [O]: what sensors give, then what the policy is asked for."""
        return (*self.sensors, *self.asked)

    @property
    def asked(self) -> tuple[str, ...]:
        """Names of what somebody sets at each call: the time, a reference, a goal."""
        return terms.asked_names(self.task)

    @property
    def memory(self) -> Memory:
        """What a file remembers of an episode: what its policy sees beside its observation."""
        return remembering(self.config, self.task._replace(memory=NO_MEMORY)).memory

    @property
    def remembered(self) -> tuple[str, ...]:
        """Names of the entries of a file's memory [M], all of which are 0 where an episode begins."""
        return (BEGUN, *self.memory.names) if self.memory.names else ()

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of what sensors give; without any, a cosine and a sine are x0, x1, ..."""
        if names := self.config.state_names:
            return tuple(names[i] for i in self.config.sensors.measured or range(len(names)))
        task, measured = self.task, recall.measured(self.task)
        size = len(measured) + len(task.circles)
        kept = dict(zip(entries(size, task.circles), (task.state_names[i] for i in measured), strict=True))
        paired = {entry for pair in task.circles for entry in pair}
        return tuple(f"x{i}" if i in paired else kept[i] for i in range(size))


def controlling(learned: Learned) -> Callable[..., tuple[Array, Array]]:
    """The controller as a function to be traced: (observation [O], memory [M]) -> (control [U], memory [M]).

    Every noisy unit is at its mean. A memory of zeros begins an episode; M is 0 where nothing is remembered. Where
    another control is sent than the function returns, the third argument is that one, to be remembered.
    """
    task, memory, sensors = learned.task, learned.memory, len(learned.sensors)
    see, _, advance = recall.steps(memory)

    def act(observation: Array, kept: Array, sent: Array | None = None) -> tuple[Array, Array]:
        # What depends on the weights alone, such as an RBF controller's regression, is computed while it is traced.
        with jax.ensure_compile_time_eval():
            o = sensed.state(observation[:sensors], task)
            first: Any = recall.begin(memory, jax.random.key(0), o)
            m = jnp.where(kept[0] > 0, kept[1:], first) if memory.names else None
            u = learned.policy.apply(learned.params, None, jnp.concatenate([see(m, o), observation[sensors:]]))
            later = [jnp.ones(1, o.dtype), advance(m, o, u if sent is None else sent)] if memory.names else [kept]
            return u, jnp.concatenate(later)

    return act


def driven(act: Callable[[Any, Any], Any], observations: np.ndarray, memory: int, episode: int) -> np.ndarray:
    """The controls [N, U] of act(observation [O], memory) -> (control, memory) in episodes of so many observations."""
    found, kept = [], None
    for number, x in enumerate(observations):
        kept = np.zeros(memory, x.dtype) if number % episode == 0 else kept
        u, kept = act(x, kept)
        found.append(u)
    return np.stack(found)


def for_comment(text: str) -> str:
    """A text without the characters that could end a comment in some language."""
    return re.sub(r"[^\w .,:;()\[\]/+^'-]", "_", text)
