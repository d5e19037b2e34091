"""The curves of a report as CSV: names and units in the first line, a dot for decimals, nothing where not known."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from pegasus_jax.report import read
from pegasus_jax.report.read import Look

FIRST = "run"  # the first column of every file, by which it is known


def text(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A CSV file."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow([FIRST, *head])
    writer.writerows([["" if value is None else value for value in row] for row in rows])
    return file.getvalue()


def trials_csv(found: Look) -> str:
    """A row a trial: the numbers of trials.jsonl, seconds by phase, and the share inside the imagined band."""
    covered = {step.number: read.coverage(step, found.task) for step in found.steps}
    rows = [_flat(row) | {"inside_band": covered.get(row["trial"])} for row in found.rows]
    head = list(dict.fromkeys(name for row in rows for name in row))
    return text(head, ([found.path.name, *(row.get(name) for name in head)] for row in rows))


def _flat(row: dict[str, Any]) -> dict[str, Any]:
    """A row without objects inside: {"seconds": {"fit": 1}} is seconds_fit=1."""
    flat: dict[str, Any] = {}
    for name, value in row.items():
        flat |= {f"{name}_{inner}": v for inner, v in value.items()} if isinstance(value, dict) else {name: value}
    return flat


def trajectories_csv(found: Look) -> str:
    """A row for each trial, name and moment: what the plant did, and quantiles of what was imagined."""
    rows = []
    for step in found.steps:
        real = read.real(step) if step.real else None
        fans = read.imagined(step) if step.fan is not None else None
        for i, name in enumerate(read.names(found.task)):
            count = max(len(values[i]) for values in (real, fans) if values is not None)
            quantiles = None if fans is None else np.percentile(fans[i], read.QUANTILES, axis=1).T
            for t, moment in enumerate(read.times(found.task, name, count)):
                did = _cell(real[i][t]) if real is not None and t < len(real[i]) else None
                was = quantiles[t] if quantiles is not None and t < len(quantiles) else [None] * len(read.QUANTILES)
                rows.append([found.path.name, step.number, name, _cell(moment), did, *map(_cell, was)])
    return text(["trial", "name", "time [s]", "real", *(f"imagined_{q}_percent" for q in read.QUANTILES)], rows)


def _cell(value: Any) -> Any:
    return None if value is None else float(f"{float(value):.7g}")
