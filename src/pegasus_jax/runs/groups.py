"""Runs that exist, put beside each other: those whose settings differ in the seed alone are one group."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pegasus_jax.checks import ConfigError, RunError, shown
from pegasus_jax.config import KINDS, Config, label
from pegasus_jax.math.interquartile import interval, iqm
from pegasus_jax.runs import config_io, store

DEPTH = 3  # so many folders below the one that is named: a sweep's combinations, and their seeds, in runs/
ALONE = ("seed", "trials")  # settings in which the runs of a group may differ
NAMED = 3  # a group is called after so many settings at most, else after its folder


class Run(NamedTuple):
    """A run's folder as far as it is compared with others."""

    path: Path
    config: Config
    rows: list[dict[str, Any]]  # of trials.jsonl
    version: str  # of pegasus-jax, that began or last continued it

    def curve(self, name: str) -> list[float | None]:
        """A number of every trial [T]; None where it is not known."""
        return [None if (value := row.get(name)) is None else float(value) for row in self.rows]


class Group(NamedTuple):
    """Runs of the same settings, a seed each."""

    label: str
    runs: list[Run]

    @property
    def shared(self) -> int:
        """So many trials have been done in every run."""
        return min(len(run.rows) for run in self.runs)

    def curves(self, name: str) -> np.ndarray:
        """A number of every shared trial [S, T]; NaN where it is not known."""
        return np.array([run.curve(name)[: self.shared] for run in self.runs], float)


class Measured(NamedTuple):
    """Which columns of trials.jsonl are compared, and what they are."""

    cost: str
    success: str
    words: str


EVALUATED = Measured("mean_cost", "success_rate", "mean of the evaluation episodes after each trial")
OWN = Measured("episode_cost", "episode_success", "each trial's own episode: some of these runs were not evaluated")


def found(paths: Sequence[Path]) -> list[Path]:
    """The runs that these folders are, or hold, each once. Raises RunError for a folder without one."""
    runs: dict[Path, None] = {}
    for path in paths:
        below = [path] if (path / "config.yaml").exists() else _below(path)
        if not below:
            store.existing(path)  # says what is there instead
        runs |= dict.fromkeys(below)
    return list(runs)


def _below(path: Path) -> list[Path]:
    """The runs inside a folder, in the order of their names, numbers by their size."""
    runs = []
    for folder, inner, names in os.walk(path):
        here = Path(folder)
        is_run = "config.yaml" in names and not {"run.json", "trials.jsonl", "episodes"}.isdisjoint([*names, *inner])
        if is_run:
            runs.append(here)
        if is_run or len(here.relative_to(path).parts) >= DEPTH:
            inner.clear()
        inner[:] = [name for name in inner if not name.startswith(".")]
    return sorted(runs, key=lambda run: [_natural(part) for part in run.parts])


def _natural(text: str) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", text)]


def readable(paths: Sequence[Path]) -> tuple[list[Run], list[str]]:
    """The runs of these folders that have finished a trial, and why others are left out, a line each.

    Raises RunError where none is left.
    """
    runs, problems = [], []
    for path in paths:
        try:
            config = config_io.load(store.existing(path) / "config.yaml")
            versions = store.stored(path).get("versions")
            version = str(versions.get("pegasus-jax")) if isinstance(versions, dict) else "unknown"
            run = Run(path, config, store.trials(path), version)
        except (ConfigError, RunError) as error:
            problems.append(str(error))
            continue
        if run.rows:
            runs.append(run)
        else:
            problems.append(f"{path / 'trials.jsonl'} holds no finished trial yet")
    if not runs:
        raise RunError(problems[0])
    return runs, problems


def grouped(runs: Sequence[Run]) -> list[Group]:
    """The runs as groups of the same settings, called after what differs between them."""
    together: dict[str, list[Run]] = {}
    for run in runs:
        together.setdefault(str({k: v for k, v in _settings(run).items() if k not in ALONE}), []).append(run)
    groups = list(together.values())
    return [Group(name, group) for name, group in zip(_labels(groups), groups, strict=True)]


def _settings(run: Run) -> dict[str, Any]:
    return config_io.plain(run.config)


def _labels(groups: list[list[Run]]) -> list[str]:
    """A name for each group: the settings in which it differs from the others, or, if these are many, its folder."""
    if len(groups) == 1:
        return [label(groups[0][0].config)]
    every = [_settings(group[0]) for group in groups]
    kinds = [section for section in KINDS if len({one[f"{section}.kind"] for one in every}) > 1]
    keys = [
        key
        for key in dict.fromkeys(key for one in every for key in one)
        if key not in ALONE
        and (key.partition(".")[0] not in kinds or key.endswith(".kind"))
        and len({str(one.get(key)) for one in every}) > 1
    ]
    names = [", ".join(f"{key}={shown(one[key])}" for key in keys if key in one) for one in every]
    return names if len(keys) <= NAMED and len({*names}) == len(names) else _folders(groups)


def _folders(groups: list[list[Run]]) -> list[str]:
    """The first folder of each group, without what all share and without its seed."""
    paths = [group[0].path.resolve() for group in groups]
    try:
        top = Path(os.path.commonpath([path.parent for path in paths]))
    except ValueError:  # two drives of Windows have nothing in common
        return [path.as_posix() for path in paths]
    names = [re.sub(r"[-_/]?seed\d+$", "", path.relative_to(top).as_posix()) or path.name for path in paths]
    unique = len({*names}) == len(names)
    return names if unique else [path.relative_to(top).as_posix() for path in paths]


def measured(groups: Sequence[Group]) -> Measured:
    """The evaluation where every run has one, else each trial's own episode."""
    rows = [row for group in groups for run in group.runs for row in run.rows]
    return EVALUATED if all(row.get("mean_cost") is not None for row in rows) else OWN


def plant_seconds(group: Group) -> list[float]:
    """Plant time [s] at the end of each shared trial [T], the mean over seeds: early ends make them differ."""
    return group.curves("plant_seconds").mean(0).tolist()


def middle(values: np.ndarray) -> np.ndarray:
    """Interquartile mean over seeds [S, T] and the ends of its 95 % bootstrap interval: [3, T].

    NaN where a seed's value is not known; a single seed has no interval.
    """
    found = np.full((3, values.shape[1]), np.nan)
    known = np.isfinite(values).all(0)
    if known.any():
        found[0, known] = iqm(values[:, known])
        found[1:, known] = interval(values[:, known])
    return np.where(np.isfinite(found), found, np.nan)
