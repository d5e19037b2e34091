"""The curves of groups of runs: as charts, and as CSV."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from pegasus_jax.report.chart import Band, Level, Line, Mark, chart, unit
from pegasus_jax.report.page import number
from pegasus_jax.report.tables import text
from pegasus_jax.runs.groups import Group, Measured, middle, plant_seconds
from pegasus_jax.runs.store import COLUMNS, SOLVED

COLORS = 8  # of the style sheet
RAW = ("trial", *COLUMNS, "episode_success", "calibration", "saturated")  # of every run
MEANS = ("success_rate", "episode_success", "objective_fresh", "calibration")  # beside the cost


class Compared(NamedTuple):
    """Runs side by side."""

    groups: list[Group]
    kind: Measured
    problems: list[str]  # why runs are left out


def curves(found: Compared) -> str:
    """Cost, success and calibration against plant time."""
    shown_as = {
        "Cost": (found.kind.cost, "mean cost a step"),
        "Success": (found.kind.success, "success rate"),
        "Imagined cost": ("objective_fresh", "imagined cost a step"),
        "Model errors": ("calibration", "error / predicted error"),
    }
    charts = []
    for name, (column, up) in shown_as.items():
        if marks := _marks(found.groups, column):
            log = column == "calibration"
            limits = None if log else (-0.04, 1.04) if name == "Success" else unit(marks)
            charts.append(chart(name, "plant time [s]", up, marks, y=limits, log=log))
    words = (
        "<p>Thin: every seed, raw. Thick: the interquartile mean of the seeds, with its 95 % bootstrap interval.</p>"
    )
    return words + "".join(charts)


def _marks(every: Sequence[Group], column: str) -> list[Mark]:
    marks: list[Mark] = []
    for index, group in enumerate(every):
        style = f"c{index % COLORS}"
        center, low, high = middle(group.curves(column)).tolist()
        seconds = plant_seconds(group)
        if np.isfinite(low).any():
            marks.append(Band(seconds, low, high, style))
        for run in group.runs:
            words = [
                f"{group.label}, seed {run.config.seed}, trial {row['trial']}: {number(row.get(column))}"
                for row in run.rows
            ]
            when = [row["plant_seconds"] for row in run.rows]
            marks.append(Line(when, run.curve(column), f"{style} thin", dots=words if len(group.runs) < 4 else None))
        dots = [f"{group.label}, trial {t}: {number(v)}" for t, v in enumerate(center, 1)]
        marks.append(Line(seconds, center, style, f"{group.label} ({len(group.runs)})", dots))
    if column == "calibration":
        marks.append(Level(1.0, "calibrated"))
    if column.startswith("success"):
        marks.append(Level(SOLVED, "90 %"))
    return (
        marks
        if any(np.isfinite(v) for mark in marks if isinstance(mark, Line) for v in mark.y if v is not None)
        else []
    )


def areas(found: Compared) -> str:
    """A dot a seed: its mean cost over the trials that every run has."""
    shared = min(group.shared for group in found.groups)
    marks: list[Mark] = []
    for index, group in enumerate(found.groups):
        costs = group.curves(found.kind.cost)[:, :shared].mean(1)
        style, place = f"c{index % COLORS}", index + 1
        center, low, high = middle(costs[:, None])[:, 0].tolist()
        ends = [place - 0.2, place + 0.2]
        if np.isfinite(low):
            marks.append(Band(ends, [low, low], [high, high], style))
        marks.append(Line(ends, [center, center], style, f"{place}: {group.label}"))
        for i, (run, cost) in enumerate(zip(group.runs, costs.tolist(), strict=True)):
            spread = place + 0.2 * ((i + 0.5) / len(costs) - 0.5)  # so that no dot hides another
            marks.append(Line([spread], [cost], style, dots=[f"{group.label}, seed {run.config.seed}: {cost:.3f}"]))
    limits = (0.5, len(found.groups) + 0.5)
    return chart(
        "Area under the cost", "settings, as numbered below", f"mean cost of trials 1 to {shared}", marks, x=limits
    )


def files(found: Compared) -> dict[str, str]:
    """Name -> CSV of the curves of a comparison: every run's own, and the means of the groups."""
    raw = [
        [run.path.as_posix(), group.label, run.config.seed, *(row.get(name) for name in RAW)]
        for group in found.groups
        for run in group.runs
        for row in run.rows
    ]
    head = ["settings", "seeds", "name", "trial", "plant_seconds", "iqm", "low", "high"]
    means = [row for group in found.groups for name in (found.kind.cost, *MEANS) for row in _means(group, name)]
    return {"curves.csv": text(["settings", "seed", *RAW], raw), "means.csv": text(head, means)}


def _means(group: Group, name: str) -> list[list[Any]]:
    """A row a trial: interquartile mean of the group's seeds, and the ends of its interval."""
    values = [[v if np.isfinite(v) else None for v in row] for row in middle(group.curves(name)).T.tolist()]
    every = enumerate(zip(plant_seconds(group), values, strict=True), 1)
    return [["", group.label, len(group.runs), name, trial, seconds, *row] for trial, (seconds, row) in every]
