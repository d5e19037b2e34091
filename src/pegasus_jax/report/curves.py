"""A run's curves over its trials: cost and success, how well calibrated the model was, and all of it as a table."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any

from pegasus_jax.report import read
from pegasus_jax.report.chart import Level, Line, chart, unit
from pegasus_jax.report.page import number, table
from pegasus_jax.report.read import Look
from pegasus_jax.runs import store
from pegasus_jax.runs.display import executed
from pegasus_jax.tasks import guide

HEAD = (  # of the table of trials
    "trial",
    "plant time [s]",
    "episode",
    "its cost",
    "policy: cost",
    "success",
    "imagined cost",
    "model error",
    "inside band",
    "controls at limits",
    "computing + compiling [s]",
)


def learning(found: Look) -> str:
    """Cost and success against plant time, raw."""
    rows = found.rows
    seconds = [row["plant_seconds"] for row in rows]

    def line(name: str, style: str, words: str) -> Line:
        dots = [f"trial {row['trial']}: {number(row.get(name))}{early(row) * (name == 'episode_cost')}" for row in rows]
        return Line(seconds, [row.get(name) for row in rows], style, words, dots)

    costs = [
        line("mean_cost", "real", "plant, mean of the evaluation episodes"),
        line("episode_cost", "c1 dotted", "plant, the trial's own episode (policy of the trial before)"),
        line("objective_last", "imagined", "imagined, scenarios that the search held"),
        line("objective_fresh", "imagined dashed", "imagined, fresh scenarios"),
    ]
    known = [line for line in costs if any(v is not None for v in line.y)]
    cost = chart("Cost", "plant time [s]", "mean cost a step", known, y=unit(known))
    evaluated = any(row.get("success_rate") is not None for row in rows)
    own = [None if row.get("episode_success") is None else float(row["episode_success"]) for row in rows]
    rate = (
        line("success_rate", "real", "success rate of the evaluation episodes")
        if evaluated
        else Line(seconds, own, "real", "the trial's own episode: 1 succeeded, 0 did not", [f"{v}" for v in own])
    )
    success = chart("Success", "plant time [s]", "success rate", [rate, Level(store.SOLVED, "90 %")], y=(-0.04, 1.04))
    return f"<p>Every trial raw: nothing is smoothed. A lower cost is better.</p>{cost}{success}"


def early(row: dict[str, Any]) -> str:
    """How an episode ended, where that was before its horizon."""
    return "" if row.get("ended", "horizon") == "horizon" else f", {row['ended']}"


def calibration(found: Look) -> str:
    """How well the model predicts the size of its errors, one step and a whole episode ahead."""
    rows = [row for row in found.rows if row.get("calibration")]
    shares = [(step, read.coverage(step, found.task)) for step in found.steps]
    covered = [(step.number, share) for step, share in shares if share is not None]
    if not rows and not covered:
        return ""
    words = (
        "<p>Each episode is compared with what was predicted before the model saw it. One step ahead: the median error"
        " over the predicted one. 1 is calibrated, and at 2 errors are twice as large as the model claims. A whole"
        " episode ahead: the share of the states between the 5 and 95 % quantiles of the imagined particles. 0.9 is"
        " calibrated.</p>"
    )
    charts = []
    if rows:
        marks = [_by_trial([(row["trial"], row["calibration"]) for row in rows], "imagined"), Level(1.0, "calibrated")]
        charts.append(chart("One step ahead", "trial", "error / predicted error", marks, log=True, small=True))
    if covered:
        marks = [_by_trial(covered, "real"), Level(0.9, "calibrated")]
        up = "share inside the 90 % band"
        charts.append(chart("A whole episode ahead", "trial", up, marks, y=(-0.04, 1.04), small=True))
    return f'{words}<div class="grid-of">{"".join(charts)}</div>'


def _by_trial(values: Sequence[tuple[int, float]], style: str) -> Line:
    numbers = [trial for trial, _ in values]
    return Line(numbers, [v for _, v in values], style, dots=[f"trial {trial}: {v:.2f}" for trial, v in values])


def trials(found: Look) -> str:
    """A row a trial."""
    covered = {step.number: read.coverage(step, found.task) for step in found.steps}
    words = guide.exploring(found.config)
    rows = [_row(row, row["trial"] == found.best, covered, words) for row in found.rows]
    note = "<p>“policy” is the one that the trial ends with; its own episode was run by the policy before it.</p>"
    return note + table(HEAD, rows)


def _row(row: dict[str, Any], best: bool, covered: dict[int, float | None], exploring: str) -> list[str]:
    """The cells of a trial; it leads to its trajectories, where there are some."""
    trial, (spent, compiling) = row["trial"], store.computing(row)
    name = f'<a href="#trial-{trial}">{trial}</a>' if trial in covered else str(trial)
    who = executed([row], exploring).removeprefix("episode ").removeprefix("of ").removeprefix("by the ")
    return [
        f"{name} <b>best</b>" if best else name,
        f"{row['plant_seconds']:g}",
        escape(who + early(row)),
        number(row.get("episode_cost")),
        number(row.get("mean_cost")),
        number(row.get("success_rate"), ".0%"),
        number(row.get("objective_fresh")),
        number(row.get("calibration"), ".2f"),
        number(covered.get(trial), ".0%"),
        number(row.get("saturated"), ".0%"),
        f"{spent:.0f} + {compiling:.0f}" if row.get("seconds") else "–",
    ]
