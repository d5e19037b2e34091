"""What the swimmer's four maneuvers aim at: an error that is affine in the rates, the depth and sines and cosines."""

from collections.abc import Callable
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from pegasus_envs.physics import Scalar

Task = Literal["knife_edge", "belly_up", "corkscrew", "depth_change"]
Cost = Literal["shaped", "authors"]

START_DEPTH = 1.0
_ROLLS = {"knife_edge": np.pi / 2, "belly_up": np.pi, "depth_change": 0.0}

# Widths of the saturating cost. Shaped: the cost at the start is .78 to .96, where the authors' is flat. Authors': from
# the task files of the robot's own learning code, for two and for six legs.
_SHAPED = {"knife_edge": 0.6, "belly_up": 0.8, "corkscrew": 0.6, "depth_change": 0.5}
_AUTHORS = {
    "knife_edge": (0.2, 0.15 * np.pi / 2),
    "belly_up": (0.4, 0.15 * np.pi),
    "corkscrew": (0.25 * np.pi / 3, 0.15 * np.pi / 3),
    "depth_change": (0.4, 0.2),
}


class Goal(NamedTuple):
    error: Callable[[Array], Array]
    """x [D] -> e [E]"""
    width: float
    depth: float
    """[m]"""


def goal(task: Task, legs: int, cost: Cost, roll_rate: Scalar) -> Goal:
    """The aim of a maneuver; |e|^2 sums squared errors of depth and roll rate, and 2 - 2 cos of each angle's error."""
    if task not in _SHAPED:
        raise ValueError(f"unknown swimmer task {task!r}: one of {', '.join(_SHAPED)}")
    if legs not in (2, 6):
        raise ValueError(f"the swimmer has 2 or 6 legs, not {legs!r}")
    if cost not in ("shaped", "authors"):
        raise ValueError(f"unknown cost {cost!r}: shaped or authors")
    depth = START_DEPTH + (1.0 if task == "depth_change" else 0.0)
    rate_weight = 0.5 if cost == "shaped" else 1.0

    def error(x: Array) -> Array:
        roll, pitch, yaw = x[:3]
        parts = [x[3] - depth, jnp.sin(pitch), jnp.cos(pitch) - 1.0, jnp.sin(yaw), jnp.cos(yaw) - 1.0]
        if task == "corkscrew":
            return jnp.stack([*parts, rate_weight * (x[4] - roll_rate)])
        return jnp.stack([*parts, jnp.sin(roll) - np.sin(_ROLLS[task]), jnp.cos(roll) - np.cos(_ROLLS[task])])

    width = _SHAPED[task] if cost == "shaped" else _AUTHORS[task][legs == 6]
    return Goal(error, width, depth)
