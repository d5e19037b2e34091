"""The plants in C MuJoCo, in double precision: what MJX is held to, by the tests and by `benchmarks.plants`."""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import mujoco
import numpy as np

from pegasus_envs.plant import Plant

Drive = Callable[[np.ndarray], Iterable[Any]]
"""control [U] of one period -> actuator commands of each of its time steps"""


def held(plant: Plant) -> Drive:
    """The control is the command."""
    count = round(plant.dt / plant.model.opt.timestep)
    return lambda control: [control] * count


def stroke(legs: int, step: float = 0.01, lag: float = 0.1, rate: float = 4.0) -> Drive:
    """The swimmer's hips, written anew from the description: a filter, then a sine of the time since the start."""
    command, time = np.zeros((3, 6)), 0.0

    def period(control: np.ndarray) -> Iterator[np.ndarray]:
        nonlocal command, time
        target = np.zeros((3, 6))
        if legs == 2:
            target[:2, [2, 5]] = control.reshape(2, 2)
        else:
            target[:] = control.reshape(3, 6)
        for _ in range(100 if legs == 2 else 50):
            command = target + np.exp(-step / lag) * (command - target)
            yield command[1] + command[0] * np.sin(2 * np.pi * rate * time + command[2])
            time += step

    return period


def in_c(
    plant: Plant, qpos: np.ndarray, qvel: np.ndarray, controls: np.ndarray, drive: Drive | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions [H, nq] and velocities [H, nv] after each period, and velocities of each time step [H, n, nv]."""
    data = mujoco.MjData(plant.model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    drive = drive or held(plant)
    positions, velocities, within = [], [], []
    for control in np.asarray(controls, float):
        steps = []
        for command in drive(control):
            data.ctrl[:] = command
            mujoco.mj_step(plant.model, data)
            steps.append(data.qvel.copy())
        positions.append(data.qpos.copy())
        velocities.append(data.qvel.copy())
        within.append(steps)
    return np.stack(positions), np.stack(velocities), np.stack(within)
