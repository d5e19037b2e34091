"""What whoever drives the robot must know of an exported controller, as JSON: names, units, order, limits, period."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from pegasus_jax.exports.learned import Learned
from pegasus_jax.exports.parity import Parity
from pegasus_jax.math.units import parted
from pegasus_jax.memory import measured, resting
from pegasus_jax.runs.machine import about
from pegasus_jax.tasks.remembered import kept_by

EXPLICIT = ("onnx", "stablehlo")  # formats of functions, whose caller keeps the memory


def contract(learned: Learned, format: str, file: Path, data: bytes, parity: Parity, command: str) -> dict[str, Any]:
    """The contract of a file of these bytes. Observations and controls are in the order of their entries."""
    task = learned.task
    rates = task.control_rate
    low, high = (np.asarray(limit, float).tolist() for limit in (task.control_low, task.control_high))
    controls = zip(task.control_names, low, high, strict=True)
    cosines = {entry: part for pair in task.circles for entry, part in zip(pair, ("cosine", "sine"), strict=True)}
    return {
        "file": file.name,
        "sha256": hashlib.sha256(data).hexdigest(),
        "format": format,
        "title": learned.title,
        "task": task.name,
        "run": learned.run,
        "trial": learned.trial,
        "numbers": learned.dtype.name,
        "period_s": float(task.dt),
        "observation": [
            named(name)
            | ({"is": f"{cosines[i]} of an angle"} if i in cosines else {})
            | ({"is": "asked for, no sensor's"} if i >= len(learned.sensors) else {})
            for i, name in enumerate(learned.observation)
        ],
        "control": [
            named(name) | {"low": low, "high": high} | ({} if rates is None else {"rate_per_s": float(rates[i])})
            for i, (name, low, high) in enumerate(controls)
        ],
        **_memory(learned),
        **_memory_of_caller(learned, format),
        "parity": {
            **parity._asdict(),
            "allowed": parity.allowed,
            "against": "the policy, as pegasus_jax.controller has it",
        },
        "command": command,
        "versions": about(command)["versions"],
    }


def _memory(learned: Learned) -> dict[str, Any]:
    """What the file remembers of an episode, from `reset` on: its filter, and past observations and controls."""
    task = learned.task
    if not learned.memory.names:
        return {"filter": "none", "history": "none"}
    kept = kept_by(learned.config, task)
    rest = resting(task).astype(float).tolist()
    rates = {
        "rates_of": [task.state_names[i] for i in measured(task)],
        "computed_by": "difference",
        "weight_of_the_newest": kept.weight,
    }
    return {
        "filter": rates if kept.rates else "none",
        "history": {"controls": kept.controls, "observations": kept.rows, "controls_before_an_episode": rest},
    }


def _memory_of_caller(learned: Learned, format: str) -> dict[str, Any]:
    """What a caller hands on from call to call, of a file that keeps nothing itself."""
    if format not in EXPLICIT or not learned.remembered:
        return {}
    return {"memory": [{"name": name, "initial": 0.0} for name in learned.remembered]}


def named(name: str) -> dict[str, Any]:
    """A name and its unit, which is null where it is not known: "theta [rad]" is theta in rad."""
    return dict(zip(("name", "unit"), parted(name), strict=True))
