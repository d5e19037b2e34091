"""The controller of a run's first episodes, where its user has one: a function of an observation."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from pegasus_jax.checks import ConfigError, names_code, shown
from pegasus_jax.config import Config
from pegasus_jax.math.circles import to_observation
from pegasus_jax.task import Task
from pegasus_jax.tasks import cost_check, user_code


def of_config(config: Config, task: Task) -> Callable[[Any], Any] | None:
    """The function, of the task's state; None for random controls, and for a run's folder, which `runs/` reads."""
    name = config.explore.policy
    if name is None or is_folder(name):
        return None
    function = user_code.load("explore.policy", name)
    return lambda x: function(to_observation(x, task.circles))


def is_folder(name: str | Callable[..., Any] | None) -> bool:
    """Whether explore.policy= names a run's folder: no function of a module."""
    return isinstance(name, str) and not names_code(name)


def exploring(config: Config) -> str:
    """What drives the first episodes, in words."""
    name = config.explore.policy
    return "random controls" if name is None else f"explore.policy={shown(name)}"


def check(config: Config, task: Task) -> None:
    """Raises ConfigError unless the task's first controller gives one finite number a control at the start.

    On a plant in JAX it is part of the program, so it has to be a JAX function.
    """
    if task.guide is None:
        return
    what, guide = f"explore.policy={shown(config.explore.policy)}", task.guide
    start = np.asarray(task.start_mean, np.float32)
    with user_code.blamed(what, guide):
        u = np.asarray(guide(start), float)
        if task.environment is None:
            cost_check.within(lambda x: jnp.asarray(guide(x), float), start.shape, task.observed, what)
    controls = len(task.control_names)
    if u.shape != (controls,):
        raise ConfigError(f"{what} returns an array of shape {u.shape}; expected ({controls},), a number a control")
    if not np.isfinite(u).all():
        raise ConfigError(f"{what} is {u.tolist()} at the start; expected finite numbers")
