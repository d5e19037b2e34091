"""Logs beside the robot that they are of: from where to where their columns go, and whether they begin as it does."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from pegasus_jax.logs.read import Logged
from pegasus_jax.logs.table import names_of
from pegasus_jax.math.angles import difference
from pegasus_jax.math.circles import to_observation
from pegasus_jax.memory import measured
from pegasus_jax.task import Task

TURN = 2 * np.pi  # [rad]
SEAMLESS = 1.05  # turns that an angle which is kept to one turn does not cover: others are told, they may be degrees
FAR = 10.0  # standard deviations of the starts


def ranges(logs: Sequence[Logged], task: Task) -> str:
    """One line: of each column that is used the least and the greatest value, in the environment's unit.

    Of angles of more than a turn it says how many turns that is, for those who wrote degrees.
    """
    names = names_of(task)
    places, seen = list(measured(task)), []
    for one in logs:
        x = to_observation(np.asarray(one.trajectory.x)[:, places], task.circles)
        u = np.asarray(one.trajectory.u)
        seen.append(np.concatenate([[x.min(0), x.max(0)], [u.min(0), u.max(0)]], axis=1))  # [2, O+U]
    low, high = np.min(seen, axis=(0, 1)), np.max(seen, axis=(0, 1))
    texts = []
    for i, name in enumerate((*names.observation, *names.control)):
        columns = [*dict.fromkeys(one.columns[i] for one in logs if one.columns)]
        unit = names.units.get(name, "")
        turns = (
            f", {(high[i] - low[i]) / TURN:.1f} turns" if unit == "rad" and high[i] - low[i] > SEAMLESS * TURN else ""
        )
        is_ = "" if {*columns} <= {name, f"{name} [{unit}]"} else f" is {' or '.join(columns)},"
        texts.append(f"{name}{is_} from {low[i]:.4g} to {high[i]:.4g}{unit and ' '}{unit}{turns}")
    return f"in the logs {'; '.join(texts)}"


def far(logs: Sequence[Logged], task: Task) -> list[str]:
    """A note on each entry of which an episode's first row is far from where the task's episodes start.

    Far is FAR standard deviations of those starts; an entry that never varies there says nothing.
    """
    begun = [one for one in logs if one.begins]
    if not begun:
        return []
    spread = np.hypot(np.asarray(task.start_std, float), np.asarray(task.sensor_std, float))
    first = jnp.asarray([one.trajectory.x[0] for one in begun])
    away = np.abs(difference(first, jnp.asarray(task.start_mean, float), task.angles))  # [N, D]
    notes = []
    for i in measured(task):
        mean = float(task.start_mean[i])
        off = away[:, i]
        if spread[i] > 0 and off.max() > FAR * spread[i]:
            one, count = begun[int(off.argmax())], int(np.sum(off > FAR * spread[i]))
            notes.append(
                f"{one.source}{f' and {count - 1} more' if count > 1 else ''}: {task.state_names[i]} begins at"
                f" {float(one.trajectory.x[0, i]):.4g}, and episodes at {mean:.4g} give or take {spread[i]:.2g}:"
                " another column, or another unit?"
            )
    return notes
