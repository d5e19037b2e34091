"""What a run's folder tells, read for a report: whatever cannot be read is said, and the rest is shown."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pegasus_jax.checks import ConfigError, RunError
from pegasus_jax.config import Config
from pegasus_jax.config_models import Model, sized
from pegasus_jax.episode import Episode
from pegasus_jax.presets import own
from pegasus_jax.runs import config_io, driven, restore, store
from pegasus_jax.task import Task

QUANTILES = (5, 25, 50, 75, 95)  # of the imagined particles [%]


class Step(NamedTuple):
    """A trial: what was imagined of its episode, and the episode."""

    number: int
    policy: int | None  # the trial that learned the policy which ran; 0 before any, None without an episode
    real: Episode | None
    fan: dict[str, np.ndarray] | None  # the particles imagined after the trial before: store.save_imagined


class Look(NamedTuple):
    """A run as its folder tells it."""

    path: Path
    config: Config
    task: Task
    rows: list[dict[str, Any]]
    steps: list[Step]  # 1, 2, ...; the last one may be imagined only
    best: int | None  # the trial that learned the best policy; None where that is not known
    about: dict[str, Any]  # run.json
    problems: list[str]  # what could not be read
    driven: list[driven.Driven]  # by pegasus-run, oldest first
    fans: dict[int, dict[str, np.ndarray]]  # trial -> the particles of its policy


def look(path: Path) -> Look:
    """Read a run, finished or not. Raises RunError for a folder that is none, or whose facts are damaged."""
    config, about = config_io.load(store.existing(path) / "config.yaml"), store.stored(path)
    task = store.task_of(path)
    rows, problem = store.readable_trials(path)
    problems = [] if problem is None else [f"{problem}; resume={path} does these trials again, from their episodes"]
    steps = [_step(path, number, problems) for number in range(1, len(rows) + 2)]
    best = None
    if rows and problem is None:
        try:
            best = restore.best(path)
        except RunError as error:
            problems.append(str(error))
    fans = {step.number - 1: step.fan for step in steps if step.fan is not None}
    steps = [step for step in steps if step.real or step.fan]
    return Look(path, config, task, rows, steps, best, about, problems, _driven(path, problems), fans)


def _step(path: Path, number: int, problems: list[str]) -> Step:
    """A trial as far as its files can be read; what cannot is added to `problems`."""
    real = origin = fan = None
    try:
        real, origin = store.load_episode(path, number), store.origin(path, number)
    except RunError as error:
        problems.append(str(error))
    try:
        fan = store.load_imagined(path, number - 1)
    except RunError as error:
        problems.append(str(error))
    return Step(number, None if origin is None else origin[0], real, fan)


def _driven(path: Path, problems: list[str]) -> list[driven.Driven]:
    """The logs of pegasus-run; what cannot be read is added to `problems`."""
    logs = []
    for number in store.numbered(path / driven.FOLDER, ".npz"):
        try:
            logs.append(driven.load(path, number))
        except RunError as error:
            problems.append(str(error))
    return logs


def model_of(found: Look) -> Model:
    """The settings of its model, with a number for each that the plant's states decide."""
    return sized(found.config.model, len(found.task.state_names))


def names(task: Task) -> list[str]:
    """What is drawn of a trial: states, controls, cost."""
    return [*task.state_names, *task.control_names, "cost"]


def times(task: Task, name: str, count: int) -> np.ndarray:
    """When the values of a name were [s]: the cost of a period is counted at its end."""
    return task.dt * (np.arange(count) + (name == "cost"))


def real(step: Step) -> list[np.ndarray]:
    """The episode's values by name, as `names` has them."""
    assert step.real is not None
    ran = step.real.trajectory
    return [*np.asarray(ran.x).T, *np.asarray(ran.u).T, np.asarray(ran.cost)]


def imagined(step: Step) -> list[np.ndarray]:
    """The particles' values [H, K] by name."""
    assert step.fan is not None
    return [*np.moveaxis(step.fan["x"], -1, 0), *np.moveaxis(step.fan["u"], -1, 0), step.fan["cost"]]


def coverage(step: Step, task: Task) -> float | None:
    """The share of an episode's states between the 5 and 95 % quantiles of the imagined particles; 0.9 is calibrated.

    None where one of both is missing. Angles are compared modulo 2 pi; the first state is left out.
    """
    if step.real is None or step.fan is None or len(step.real.trajectory.u) < 1:
        return None
    length = min(len(step.real.trajectory.u), len(step.fan["u"]))
    x, fan = np.asarray(step.real.trajectory.x)[1 : length + 1], step.fan["x"][1 : length + 1]
    low, middle, high = np.percentile(fan, (5, 50, 95), axis=1)
    turns = np.zeros(x.shape)
    turns[:, list(task.angles)] = np.round(((x - middle) / (2 * np.pi))[:, list(task.angles)])
    x = x - 2 * np.pi * turns
    return float(np.mean((low <= x) & (x <= high)))


def began_with(found: Look) -> tuple[str, Config | None]:
    """The words that chose the preset of a run, and that preset; the task's own where its command does not tell."""
    commands = found.about.get("commands") or [{}]
    typed = str(commands[0].get("command", "")) if isinstance(commands[0], dict) else ""
    words = dict(word.split("=", 1) for word in _split(typed) if "=" in word)
    chosen = {key: words[key] for key in (*config_io.NAMED, "legs") if key in words}
    if not {"task", "preset"} & {*chosen}:
        chosen = {"preset": own(found.config.task, found.config.legs)} | chosen
    try:
        preset = config_io.parse(chosen)
    except ConfigError:
        return "", None
    return " ".join(f"{key}={value}" for key, value in chosen.items()), preset


def _split(command: str) -> list[str]:
    try:
        return shlex.split(command)
    except ValueError:
        return []


def settings(found: Look) -> list[tuple[str, Any, Any, bool]]:
    """(name, value, the preset's value, whether they differ) of every setting, those that differ first."""
    _, preset = began_with(found)
    now, before = config_io.plain(found.config), {} if preset is None else config_io.plain(preset)
    rows = [
        (name, value, before.get(name), bool(before) and before.get(name, ...) != value) for name, value in now.items()
    ]
    return sorted(rows, key=lambda row: not row[3])
