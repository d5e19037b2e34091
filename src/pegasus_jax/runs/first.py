"""A run's policy as the controller of another run's first episodes, `explore.policy=RUN`.

RUN/explore    what is needed of it: it may learn on, move, or be deleted
"""

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
from pegasus_jax.runs import begin, restore
from pegasus_jax.task import Task
from pegasus_jax.tasks import guide

FOLDER = "explore"


def found(config: Config) -> Config:
    """The config for a run's folder: explore.policy= is found from anywhere."""
    name = config.explore.policy
    return _with_policy(config, os.path.abspath(str(name))) if guide.is_folder(name) else config


def copy(config: Config, run: Path) -> None:
    """Copy what the config's explore.policy= names into a new run's folder."""
    if guide.is_folder(config.explore.policy):
        begin.copied(*_source(config), run / FOLDER)


def loaded(config: Config, run: Path | None = None) -> Config:
    """The config with the best policy of the run that explore.policy= names as a function in its place.

    Of the copy in `run`, where there is one: a run of an earlier version has none. Raises ConfigError where that is no
    run's folder, or has learned nothing yet.
    """
    if not guide.is_folder(config.explore.policy):
        return config
    kept = None if run is None else run / FOLDER
    source = _source(config) if kept is None or not kept.is_dir() else (kept, begin.numbered(kept, restore.LAST, ""))
    return _with_policy(config, policy_of(*source, _what(config)))


def checked(config: Config, task: Task) -> list[str]:
    """What to say of explore.policy=RUN: one line each. Raises ConfigError where its policy does not suit the task."""
    if not guide.is_folder(config.explore.policy):
        return []
    theirs = begin.read(*_source(config), _what(config))[1].task
    begin.suits(_what(config), task, theirs, observed=True)
    return begin.otherwise(task, theirs)


def _what(config: Config) -> str:
    return f"explore.policy={config.explore.policy}"


def _source(config: Config) -> tuple[Path, int]:
    """The folder, and the trial with the best policy."""
    folder = Path(str(config.explore.policy))
    if not (folder / "config.yaml").is_file():
        raise ConfigError(
            f"{_what(config)} is neither a run's folder nor a function; expected a folder with config.yaml, or"
            " module:function, as in explore.policy=robot:swing"
        )
    return folder, begin.numbered(folder, restore.BEST, _what(config))


def policy_of(folder: Path, trial: int, what: str) -> Callable[[Any], Any]:
    """The policy of a run's trial, observation -> u [U], without noise on its units; one function as long as it is one.

    Raises ConfigError, beginning with `what`, for one that needs more than the newest observation.
    """
    # The second has the digests of all that a checkpoint holds.
    files = (folder / name for name in ("config.yaml", f"checkpoints/{trial:04d}.json"))
    return _policy(folder, trial, what, "".join(file.read_text(encoding="utf-8") for file in files if file.is_file()))


@lru_cache(maxsize=8)
def _policy(folder: Path, trial: int, what: str, content: str) -> Callable[[Any], Any]:
    _, experiment, state = begin.read(folder, trial, what)
    if names := experiment.task.memory.names:
        raise ConfigError(
            f"{what} remembers ({', '.join(names[:3])}), and a first controller is a function of the newest"
            " observation; expected a run without history=, sensors.* and terms of a cost"
        )
    circles, params = experiment.task.circles, state.policy.params
    return jax.jit(lambda x: experiment.policy.apply(params, None, to_state(x, circles)))


def _with_policy(config: Config, policy: Any) -> Config:
    return replace(config, explore=replace(config.explore, policy=policy))
