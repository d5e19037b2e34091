"""Runs that exist side by side: groups of seeds, with interquartile means and intervals, and every seed's raw curve."""

from __future__ import annotations

import time
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from pegasus_jax.checks import RunError, shown
from pegasus_jax.report.chart import sparkline
from pegasus_jax.report.compared_curves import COLORS, Compared, areas, curves, files
from pegasus_jax.report.findings import Finding, said
from pegasus_jax.report.page import Section, downloads, facts, number, table
from pegasus_jax.runs import config_io, groups, restore
from pegasus_jax.runs.groups import Group, Run, measured, middle, plant_seconds
from pegasus_jax.runs.study import first_solved

SUMMARY = (
    "settings",
    "seeds",
    "trials",
    "plant time [s]",
    "cost in the last",
    "success in the last",
    "first trial at 90 %",
    "area under the cost",
)
RUNS = ("run", "settings", "seed", "trials", "cost", "last cost", "last success", "best trial", "its cost")


def compared(paths: Sequence[Path]) -> Compared:
    """The runs of these folders. Raises RunError where none has finished a trial."""
    runs, problems = groups.readable(paths)
    every = groups.grouped(runs)
    return Compared(every, measured(every), problems)


def title(found: Compared) -> str:
    """What the page is called."""
    runs = sum(len(group.runs) for group in found.groups)
    several = len(found.groups) > 1
    return f"{runs} runs, {len(found.groups)} settings" if several else f"{found.groups[0].label}, {runs} runs"


def lead(found: Compared) -> str:
    """The lines below the title."""
    runs = [run for group in found.groups for run in group.runs]
    tasks = ", ".join(sorted({run.config.task for run in runs}))
    seeds = ", ".join(str(len(group.runs)) for group in found.groups[:12])
    pairs = [
        ("runs", str(len(runs))),
        ("settings", f"{len(found.groups)} <small>seeds of each: {seeds}</small>"),
        ("trials in every run", str(_shared(found))),
    ]
    when = time.strftime("%Y-%m-%d %H:%M")
    return f'<p class="soft">Task {escape(tasks)}. Read {when}.</p>{facts(pairs)}'


def sections(found: Compared) -> list[Section]:
    """The page of a comparison."""
    notes = _notes(found)
    made = [
        Section("warnings", "Warnings", said(notes) if notes else ""),
        Section("summary", "Summary", _summary(found)),
        Section("curves", "Learning curves", curves(found)),
        Section("areas", "Area under the cost", areas(found)),
        Section("runs", "Every run", _runs(found)),
        Section("settings", "Settings that differ", _settings(found)),
        Section("data", "Data", downloads(files(found))),
    ]
    return [part for part in made if part.html]


def _shared(found: Compared) -> int:
    return min(group.shared for group in found.groups)


def _notes(found: Compared) -> list[Finding]:
    runs = [run for group in found.groups for run in group.runs]
    notes = [Finding("warning", problem, "This run is left out.") for problem in found.problems]
    if len({run.config.task for run in runs}) > 1:
        notes.append(Finding("warning", "runs of several tasks", "Their costs cannot be compared with each other."))
    if small := [group.label for group in found.groups if len(group.runs) < 3]:
        means = "An interval of two seeds says little, and one seed has none."
        notes.append(Finding("note", f"fewer than three seeds: {'; '.join(small[:5])}", means))
    if len({len(run.rows) for run in runs}) > 1:
        means = "Means go as far as every seed of the same settings has come; raw curves go on."
        notes.append(Finding("note", "some runs have more trials than others", means))
    if len(made := sorted({run.version for run in runs})) > 1:
        notes.append(Finding("note", f"made by versions {', '.join(made)}", "They may learn in other ways."))
    return notes


def _summary(found: Compared) -> str:
    """A row a group: how well it does in the last trial that all of its seeds have, and how soon."""
    rows = [_row(found, index, group) for index, group in enumerate(found.groups)]
    words = (
        f"<p>Cost and success: {found.kind.words}. Interquartile means over seeds with their 95 % bootstrap intervals."
        f" The area is the mean cost of trials 1 to {_shared(found)}. A lower cost is better.</p>"
    )
    return words + table(SUMMARY, rows)


def _row(found: Compared, index: int, group: Group) -> list[str]:
    cost, success = group.curves(found.kind.cost), group.curves(found.kind.success)
    key = f'<svg class="key inline" viewBox="0 0 22 16"><line x2="22" y1="8" y2="8" class="c{index % COLORS}"/></svg>'
    return [
        f"{key} {escape(group.label)}",
        str(len(group.runs)),
        str(group.shared),
        f"{plant_seconds(group)[-1]:g}",
        _interval(middle(cost)[:, -1]),
        _interval(middle(success)[:, -1], ".0%"),
        _first([first_solved(one) for one in success.tolist()]),
        _interval(middle(cost[:, : _shared(found)].mean(1, keepdims=True))[:, 0]),
    ]


def _interval(values: np.ndarray, form: str = ".3f") -> str:
    if not np.isfinite(values[0]):
        return "–"
    ends = f" [{values[1]:{form}}, {values[2]:{form}}]" if np.isfinite(values[1:]).all() else ""
    return f"{values[0]:{form}}{ends}"


def _first(first: list[int | None]) -> str:
    """The median of the seeds' first trials, their range, and how many seeds have none."""
    known = [trial for trial in first if trial is not None]
    parts = [f"{np.median(known):g}"] if known else []
    parts += [f"from {min(known)} to {max(known)}"] if len(known) > 1 else []
    return ", ".join(parts + ([f"{len(first) - len(known)} never"] if len(known) < len(first) else []))


def _runs(found: Compared) -> str:
    """A row a run, with a small curve."""
    rows = [_of_run(found, group, run) for group in found.groups for run in group.runs]
    words = "The small curve is the cost, from the first trial to the last."
    return f"<p>{words} <code>pegasus-report RUN</code> shows a run in full.</p>{table(RUNS, rows)}"


def _of_run(found: Compared, group: Group, run: Run) -> list[str]:
    last, best = run.rows[-1], best_of(run)
    return [
        f"<code>{escape(str(run.path))}</code>",
        escape(group.label),
        str(run.config.seed),
        f"{len(run.rows)} of {run.config.trials}",
        sparkline(run.curve(found.kind.cost)),
        number(last.get(found.kind.cost)),
        number(last.get(found.kind.success), ".0%"),
        "–" if best is None else str(best),
        number(run.rows[best - 1].get(found.kind.cost) if best else None),
    ]


def best_of(run: Run) -> int | None:
    """The trial that learned a run's best policy, as every command finds it; None where that is not known."""
    try:
        return restore.best(run.path)
    except RunError:  # of a version that wrote less
        return None


def _settings(found: Compared) -> str:
    plain = [config_io.plain(group.runs[0].config) for group in found.groups]
    keys = [key for key in dict.fromkeys(key for one in plain for key in one) if key not in groups.ALONE]
    differ = [key for key in keys if len({str(one.get(key)) for one in plain}) > 1]
    values = {key: [escape(shown(one[key])) if key in one else "–" for one in plain] for key in differ}
    rows = [[f"<code>{escape(key)}</code>", *cells] for key, cells in values.items()]
    return table(["setting", *(escape(group.label) for group in found.groups)], rows, "words") if rows else ""
