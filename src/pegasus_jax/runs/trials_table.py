"""The trials of a run as a table for a terminal, with a learning curve of one line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.table import Table
from rich.text import Text

from pegasus_jax.runs import store
from pegasus_jax.runs.best import best_trial

Rows = Sequence[dict[str, Any]]  # of one trial, a row of trials.jsonl for each seed
BLOCKS, PLAIN = "▁▂▃▄▅▆▇█", "_.-=+*%#"  # of a curve, on terminals that have them and on others
COLUMNS = ("trial", "plant [s]", "episode: cost", "policy: cost", "success", "imagined", "model error", "computing [s]")


def table(trials: Sequence[Rows], last: int, left_out: int = 0) -> Table:
    """A row a trial; `last` is the number of the run's last one, `left_out` so many that are not shown."""
    made = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    for name in COLUMNS:
        made.add_column(Text(name), justify="right")  # as markup "[s]" would be a style
    if left_out:
        made.add_row(f"{left_out} more", style="dim")
    for rows in trials:
        made.add_row(*cells(rows, last))
    return made


def cells(rows: Rows, last: int) -> list[str]:
    """A trial's cells: of several seeds the means, and the median of the model's errors."""
    errors = [row["calibration"] for row in rows if row.get("calibration") is not None]
    seconds = rows[0].get("seconds") or {}
    return [
        f"{rows[0]['trial']}/{last}",
        f"{rows[0]['plant_seconds']:.1f}",
        _mean(rows, "episode_cost", ".3f"),
        _mean(rows, "mean_cost", ".3f"),
        _mean(rows, "success_rate", ".0%"),
        _mean(rows, "objective_fresh", ".3f"),
        f"{np.median(errors):.1f}x" if errors else "-",
        f"{seconds.get('between_episodes', sum(seconds.values())):.0f}",
    ]


def curves(trials: Sequence[Rows], blocks: str = BLOCKS) -> Text:
    """Cost and success from the first trial to the last, a character a trial, from 0 to 1 or to the highest."""
    evaluated = all(row.get("mean_cost") is not None for rows in trials for row in rows)
    names = {"cost": "mean_cost", "success": "success_rate"} if evaluated else {"cost": "episode_cost"}
    parts = []
    for word, name in names.items():
        values = [np.mean([np.nan if row.get(name) is None else row[name] for row in rows]) for rows in trials]
        parts.append(f"{word} {spark(values, blocks)}")
    return Text("   ".join(parts))


def spark(values: Sequence[Any], blocks: str = BLOCKS) -> str:
    """Numbers as characters: the lowest is 0, the highest 1 or the largest number; a blank where one is not known."""
    known = [float(v) for v in values if np.isfinite(v)]
    top = max([1.0, *known])
    return "".join(
        blocks[min(int(max(v, 0.0) / top * len(blocks)), len(blocks) - 1)] if np.isfinite(v) else " " for v in values
    )


def best(trials: Sequence[Rows], first: int) -> int | None:
    """The trial with the best policy of a single seed so far, `first` as in `best_trial`.

    None where rows of an earlier version do not tell.
    """
    try:
        return best_trial([rows[0] for rows in trials], first=first)
    except (KeyError, TypeError):
        return None


def count_solved(rows: Rows) -> int:
    """How many of several seeds a trial left at 90 % success; none where they are not evaluated."""
    return sum((row.get("success_rate") or 0.0) >= store.SOLVED for row in rows)


def solved(rows: Rows) -> str:
    """How many of several seeds a trial left at 90 % success."""
    return f"{count_solved(rows)} of {len(rows)} seeds are at 90 % success"


def _mean(rows: Rows, name: str, form: str) -> str:
    values = [row[name] for row in rows if row.get(name) is not None]
    return format(float(np.mean(values)), form) if values else "-"
