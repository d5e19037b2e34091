"""A run's policy as the controller of another run's first episodes."""

import os
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax

from pegasus_jax.checks import ConfigError
from pegasus_jax.config import Config
from pegasus_jax.math.circles import to_state
from pegasus_jax.runs import restore
from pegasus_jax.tasks import guide


def found(config: Config) -> Config:
    """The config for a run's folder: explore.policy= is found from anywhere."""
    name = config.explore.policy
    return _with_policy(config, os.path.abspath(str(name))) if guide.is_folder(name) else config


def loaded(config: Config) -> Config:
    """The config with the best policy of the run that explore.policy= names as a function in its place.

    Raises ConfigError where that is no run's folder, and RunError where it has learned nothing yet.
    """
    name = config.explore.policy
    return _with_policy(config, policy_of(str(name))) if guide.is_folder(name) else config


@lru_cache(maxsize=8)
def policy_of(folder: str) -> Callable[[Any], Any]:
    """The best policy of a run, observation -> u [U], without noise on its units."""
    if not (Path(folder) / "config.yaml").is_file():
        raise ConfigError(
            f"explore.policy={folder} is neither a run's folder nor a function; expected a folder with config.yaml, or"
            " module:function, as in explore.policy=robot:swing"
        )
    _, experiment, state = restore.restored(Path(folder), restore.BEST)
    if names := experiment.task.memory.names:
        raise ConfigError(
            f"explore.policy={folder} remembers ({', '.join(names[:3])}), and a first controller is a function of the"
            " newest observation; expected a run without history=, sensors.* and terms of a cost"
        )
    circles, params = experiment.task.circles, state.policy.params
    return jax.jit(lambda x: experiment.policy.apply(params, None, to_state(x, circles)))


def _with_policy(config: Config, policy: Any) -> Config:
    return replace(config, explore=replace(config.explore, policy=policy))
