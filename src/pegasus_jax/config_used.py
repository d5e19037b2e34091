"""Which settings of a plant's own are of use to which task, and the refusal of those that are not."""

import dataclasses
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any

from pegasus_jax.checks import ConfigError, shown
from pegasus_jax.config import TASKS, Config, Explore, uses

NEEDS = {"constraint_bound": "constraint", "data_columns": "data", "data_control": "data", "init_parts": "init"}
# Setting -> another one, and its values with which it changes something.
ONLY_WITH = {
    "model.log_z_min": ("model.dropout", ("log_normal",)),
    "model.kl_weight": ("model.dropout", ("log_normal", "concrete", "gaussian", "sparse")),  # what is learned
}


def check_config(config: Config) -> None:
    """Raises ConfigError for a setting of a plant's own that a config changes, and its task does not use."""
    usual = leaves(Config())
    check_used(config.task, {name: value for name, value in leaves(config).items() if value != usual.get(name, value)})


def check_used(task: str, given: Mapping[str, Any]) -> None:
    """Raises ConfigError for a setting of a plant's own that is of no use with this task."""
    of_some = used_by()
    for key, value in given.items():
        if task not in of_some.get(key, (task,)):
            raise ConfigError(
                f"{key}={shown(value)} is of no use with task={task}; the nearest task that uses it is"
                f" task={_nearest_of(task, of_some[key])}"
            )


def check_needed(config: Config, given: Mapping[str, Any]) -> None:
    """Raises ConfigError for a setting that was given, and is of no use without another one."""
    for key, need in NEEDS.items():
        if key in given and not getattr(config, need):
            raise ConfigError(f"{key}={shown(given[key])} needs {need}=; expected both, or neither")
    now = leaves(config)
    for key, (other, values) in ONLY_WITH.items():
        if key in given and now[other] not in values:
            raise ConfigError(
                f"{key}={shown(given[key])} changes nothing with {other}={now[other]}; it needs {other}={values[0]}"
            )


def used_by() -> dict[str, tuple[str, ...]]:
    """Setting -> the tasks that use it, of those settings that describe a plant, or how it is explored."""
    found: dict[str, tuple[str, ...]] = {}
    for f in dataclasses.fields(Config):
        if f.metadata.get("of"):
            using, inner = tuple(task for task in TASKS if uses(task, f.name)), getattr(Config, f.name)
            names = leaves(inner, f"{f.name}.") if dataclasses.is_dataclass(inner) else [f.name]
            found |= dict.fromkeys(names, using)
    return found | {f"explore.{f.name}": TASKS for f in dataclasses.fields(Explore) if f.metadata.get("of")}


def _nearest_of(task: str, choices: Sequence[str]) -> str:
    return (get_close_matches(task, choices, n=1) or [choices[0]])[0]


def leaves(node: Any, prefix: str = "") -> dict[str, Any]:
    """Dotted name -> value of every setting under a config dataclass."""
    found: dict[str, Any] = {}
    for f in dataclasses.fields(node):
        value = getattr(node, f.name)
        if dataclasses.is_dataclass(value):
            found |= leaves(value, f"{prefix}{f.name}.")
        else:
            found[prefix + f.name] = value
    return found
