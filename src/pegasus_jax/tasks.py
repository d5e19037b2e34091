"""Task names -> tasks. The only importer of pegasus_envs."""

from collections.abc import Callable
from typing import Any

from pegasus_envs.cartpole import cartpole
from pegasus_envs.plant import Plant
from pegasus_jax.config import SettingError, nearest
from pegasus_jax.cost import saturating
from pegasus_jax.types import Task


def of_plant(name: str, plant: Plant) -> Task:
    """The task a plant of pegasus_envs poses."""
    return Task(
        name=name,
        plant=plant,
        cost=saturating(plant.error, plant.width),
        angles=plant.angles,
        start_mean=plant.start_mean,
        start_std=plant.start_std,
        sensor_std=plant.sensor_std,
        control_low=plant.control_low,
        control_high=plant.control_high,
        horizon=plant.horizon,
        dt=plant.dt,
        state_names=plant.state_names,
        control_names=plant.control_names,
    )


TASKS: dict[str, Callable[[], Plant]] = {
    "cartpole": cartpole,
}

# What a task changes in the defaults of config.py, by dotted name.
DEFAULTS: dict[str, dict[str, Any]] = {
    "cartpole": {},
}


def make(name: str) -> Task:
    """The task of that name. Raises SettingError for an unknown one."""
    if name not in TASKS:
        raise SettingError(f"task={name} is unknown; {nearest(name, TASKS)}")
    return of_plant(name, TASKS[name]())
