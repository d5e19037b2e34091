"""A figure's claims judged by its studies, and both as tables."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from pegasus_jax.report.comparison import Result, results, stored
from pegasus_jax.report.curves import interval, middle
from pegasus_jax.report.figures import Claim, Figure
from pegasus_jax.study import SOLVED, first_solved

MISSING = "not run yet"
HEADER = ["variant", "seeds", "trials", "cost at the last", "cost, mean of all", "solved at the last", "first solved"]


class Judged(NamedTuple):
    """A claim with its numbers, as text, and a word."""

    claim: Claim
    lower: str
    than: str
    verdict: str


def judge(claim: Claim, figure: Figure, out: Path) -> Judged:
    """What the studies in `out` say to a claim, by 95 % bootstrap intervals of interquartile means over seeds.

    Of two variants: agrees or contradicts where the interval of the difference leaves out 0, else undecided. With a
    published number: beats, reaches or misses it, as the interval lies below, around or above.
    """
    first = costs(claim.lower, claim.trials, figure, out)
    second = costs(claim.than, claim.trials, figure, out) if isinstance(claim.than, str) else claim.than
    if first is None or second is None:
        verdict = MISSING
    elif isinstance(second, np.ndarray):
        verdict = word(interval(first, second), 0.0, ("agrees", "undecided", "contradicts"))
    else:
        verdict = word(interval(first), second, ("beats", "reaches", "misses"))
    return Judged(claim, estimate(first), estimate(second), verdict)


def costs(variant: str, trials: tuple[int, int], figure: Figure, out: Path) -> np.ndarray | None:
    """Mean cost of each seed [S] over the trials, from and to; None where they have not all been run."""
    result = stored(out, f"{figure.name}-{variant}" if variant in figure.variants else variant)
    if result is None or len(result["plant_seconds"]) < trials[1]:
        return None
    return np.asarray(result["mean_cost"], float)[:, trials[0] - 1 : trials[1]].mean(1)


def word(between: tuple[np.ndarray, np.ndarray], number: float, words: tuple[str, str, str]) -> str:
    """The first word where the interval lies below the number, the second where it holds it, else the third."""
    low, high = between
    return words[0] if high < number else words[2] if low > number else words[1]


def estimate(values: np.ndarray | float | None) -> str:
    """Interquartile mean of seeds [S] and its interval; of a published number, itself."""
    if values is None:
        return MISSING
    if not isinstance(values, np.ndarray):
        return f"{values:g}"
    low, high = interval(values)
    return f"{middle(values):.3f} [{low:.3f}, {high:.3f}]" if len(values) > 1 else f"{values[0]:.3f}"


def variants_table(figure: Figure, out: Path) -> list[list[str]]:
    """A header and a row for each variant: how many seeds and trials, costs, and when its seeds were solved."""
    there = results(figure, out)
    missing = [MISSING, *[""] * (len(HEADER) - 2)]
    return [HEADER, *(row(label, there[label]) if label in there else [label, *missing] for label in figure.variants)]


def row(label: str, result: Result) -> list[str]:
    """A study in one row."""
    cost, success = (np.asarray(result[name], float) for name in ("mean_cost", "success_rate"))
    solved = f"{np.sum(success[:, -1] >= SOLVED)} of {len(cost)}"
    shape = [str(count) for count in cost.shape]
    return [label, *shape, estimate(cost[:, -1]), estimate(cost.mean(1)), solved, when(result["success_rate"])]


def when(success_rate: list[list[float]]) -> str:
    """At which trials the seeds [S, T] were solved first: the median, where half of them were, and the range."""
    firsts = [first_solved(rates) for rates in success_rate]
    solved = sorted(first for first in firsts if first)
    never = len(firsts) - len(solved)
    if not solved:
        return "never"
    middle_one = (len(firsts) - 1) // 2
    median = f"{solved[middle_one]}, " if middle_one < len(solved) else ""
    return f"{median}from {solved[0]} to {solved[-1]}" + (f", {never} never" if never else "")


def claims_table(figure: Figure, out: Path) -> list[list[str]]:
    """A header and a row for each claim."""
    rows = []
    for claim in figure.claims:
        judged = judge(claim, figure, out)
        first, last = claim.trials
        span = f"trial {first}" if first == last else f"trials {first} to {last}"
        than = claim.than if isinstance(claim.than, str) else "published"
        rows.append([claim.says, span, f"{claim.lower}: {judged.lower}", f"{than}: {judged.than}", judged.verdict])
    return [["claim", "mean cost of", "lower", "than", "verdict"], *rows]


def markdown(table: list[list[str]]) -> str:
    """A table, header first, as Markdown that is readable as it is."""
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)) + " |"
        for cells in table
    ]
    return "\n".join([lines[0], "|" + "|".join("-" * (width + 2) for width in widths) + "|", *lines[1:]])
