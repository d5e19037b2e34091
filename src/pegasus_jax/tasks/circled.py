"""A task whose user observes cosines and sines, as the task of the angles behind them: one function, Task -> Task."""

from collections.abc import Callable
from functools import wraps
from typing import Any

import numpy as np

from pegasus_jax.checks import ConfigError
from pegasus_jax.math import circles as pairs
from pegasus_jax.task import Task
from pegasus_jax.types import Cost


def of_angles(task: Task, circles: pairs.Circles) -> Task:
    """The same task with an angle in the state for each pair of a cosine and a sine in the observation.

    What the user wrote, `cost` and `stop`, still gets the observation, made again from the angle. Raises ConfigError,
    in one line, for circles that the observation cannot have.
    """
    if not circles:
        return task
    size = len(task.state_names)
    check(task, circles)
    angles = (*pairs.places(task.angles, size, circles), *pairs.angle_places(size, circles))

    def of_observation(function: Callable[..., Any]) -> Callable[..., Any]:
        return wraps(function)(lambda x, **terms: function(pairs.to_observation(x, circles), **terms))

    return task._replace(
        cost=Cost(of_observation(task.cost.of_state)),
        stop=None if task.stop is None else of_observation(task.stop),
        environment=_environment(task.environment, circles),
        angles=tuple(sorted(angles)),
        rates=pairs.places(task.rates, size, circles),
        start_mean=pairs.to_state(np.asarray(task.start_mean, float), circles),
        start_std=spread(task.start_mean, task.start_std, circles),
        starts=None if task.starts is None else pairs.to_state(np.asarray(task.starts, float), circles),
        sensor_std=np.zeros(size - len(circles)),
        state_names=pairs.names(task.state_names, circles),
        circles=circles,
    )


def check(task: Task, circles: pairs.Circles) -> None:
    """Raises ConfigError for circles of entries that are not there, or are an angle or a rate already."""
    size = len(task.state_names)
    for entry in (entry for pair in circles for entry in pair):
        if not 0 <= entry < size:
            raise ConfigError(
                f"circles={entry} is not an entry of {task.name}'s observation; choose from 0 to {size - 1}"
            )
        for setting, others in (("angles", task.angles), ("rates", task.rates)):
            if entry in others:
                raise ConfigError(f"circles and {setting} both name {entry}; a cosine or a sine is neither")


def spread(mean: Any, std: Any, circles: pairs.Circles) -> np.ndarray:
    """The standard deviations [D] of a state whose observation has these [O], to first order around the mean [O]."""
    mean, std = np.asarray(mean, float), np.asarray(std, float)
    kept = pairs.to_state(std, circles)
    for place, (cosine, sine) in zip(pairs.angle_places(len(mean), circles), circles, strict=True):
        angle = np.arctan2(mean[sine], mean[cosine])
        kept[place] = np.hypot(np.sin(angle) * std[cosine], np.cos(angle) * std[sine])
    return kept


def start_moments(task: Task) -> Task:
    """The task with the mean and the standard deviation of its starts, where it has some; angles in one piece."""
    if task.starts is None:
        return task
    starts = pairs.around(task.starts, task.angles)
    return task._replace(starts=starts, start_mean=starts.mean(0), start_std=starts.std(0))


def _environment(environment: Any, circles: pairs.Circles) -> Any:
    """The environment, observed as states."""
    if environment is None:
        return None

    def step(control: np.ndarray) -> tuple[Any, ...]:
        x, *rest = environment.step(control)
        return pairs.to_state(x, circles), *rest

    return environment._replace(reset=lambda seed: pairs.to_state(environment.reset(seed), circles), step=step)
