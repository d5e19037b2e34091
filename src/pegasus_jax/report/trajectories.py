"""A trial's episode over what was imagined of it, entry by entry."""

from __future__ import annotations

from html import escape

import numpy as np

from pegasus_jax.episode import mean_cost
from pegasus_jax.math.window import window
from pegasus_jax.report import read
from pegasus_jax.report.chart import Band, Level, Line, Mark, chart, legend
from pegasus_jax.report.read import Step
from pegasus_jax.task import Task

THIN = 12  # particles that are drawn as lines


def summary(step: Step, task: Task, first: str) -> str:
    """The line that opens a trial; `first` is what ran where no policy of the run's did."""
    if step.real is None:
        return f'Trial {step.number} <span class="soft">imagined; no trial has run this policy yet</span>'
    who = f"policy of trial {step.policy}" if step.policy else escape(first)
    cost = f"cost {mean_cost(step.real, task):.3f}" if len(step.real.trajectory.cost) else "no control period"
    share = read.coverage(step, task)
    inside = "nothing was imagined of it" if share is None else f"{share:.0%} of its states inside the 90 % band"
    early = "" if step.real.ended == "horizon" else f", ended early: {escape(step.real.ended)}"
    return f'Trial {step.number} <span class="soft">{who}, {cost}, {inside}{early}</span>'


def fans(step: Step, task: Task) -> str:
    """Charts of states, controls and cost."""
    states = len(task.state_names)
    every = [_marks(step, task, i, name) for i, name in enumerate(read.names(task))]
    named = enumerate(zip(read.names(task), every, strict=True))
    charts = [_one(name, marks, _limits(step, i, marks)) for i, (name, marks) in named]
    parts = {"States": charts[:states], "Controls and cost": charts[states:]}
    return legend(every[0]) + "".join(
        f'<h3>{title}</h3><div class="grid-of">{"".join(found)}</div>' for title, found in parts.items()
    )


def _one(name: str, marks: list[Mark], limits: tuple[float, float] | None) -> str:
    words, _, unit = name.partition(" [")
    up = name if unit else f"{name} a period" if name == "cost" else name
    return chart(words, "time [s]", up, marks, y=limits, small=True)


def _limits(step: Step, i: int, marks: list[Mark]) -> tuple[float, float] | None:
    """How far the chart of an entry reaches."""
    real = None if step.real is None else read.real(step)[i]
    return window(
        real,
        None if step.fan is None else read.imagined(step)[i],
        *(mark.y for mark in marks if isinstance(mark, Level)),
    )


def _marks(step: Step, task: Task, i: int, name: str) -> list[Mark]:
    marks: list[Mark] = []
    if step.fan is not None:
        values = read.imagined(step)[i]
        time = read.times(task, name, len(values)).tolist()
        q = np.percentile(values, read.QUANTILES, axis=1).tolist()
        marks += [Band(time, q[0], q[4], "imagined", "imagined 90 %"), Band(time, q[1], q[3], "imagined deep", "50 %")]
        marks += [Line(time, column.tolist(), "imagined faint") for column in values.T[:THIN]]
    if step.real is not None:
        values = read.real(step)[i]
        marks.append(Line(read.times(task, name, len(values)).tolist(), values.tolist(), "real", "plant"))
    control = i - len(task.state_names)
    if 0 <= control < len(task.control_names):
        marks += [Level(float(np.asarray(limit)[control])) for limit in (task.control_low, task.control_high)]
    return marks
