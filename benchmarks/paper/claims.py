"""A figure's claims judged by its studies, and both as tables."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.paper.comparison import Result, results, stored
from benchmarks.paper.figures import Claim, Figure
from pegasus_jax.math.interquartile import interval, iqm
from pegasus_jax.runs.study import SOLVED, first_solved

MISSING = "not run yet"
SAME = 0.05  # a difference in mean cost a step that nobody would choose a variant for: from 1.0 to 0.3 is to be learned
HEADER = ["variant", "seeds", "trials", "cost at the last", "cost, mean of all", "solved at the last", "first solved"]


class Costs(NamedTuple):
    """Mean cost a step of each seed, over some trials."""

    seeds: list[int]
    mean: np.ndarray  # [S]


class Judged(NamedTuple):
    """A claim with its numbers, as text, and a word."""

    claim: Claim
    difference: str
    verdict: str


def test_claim(claim: Claim, figure: Figure, out: Path) -> Judged:
    """What the studies in `out` say to a claim, by 95 % bootstrap intervals of interquartile means over seeds.

    Of two variants: agrees or contradicts where the interval of the difference leaves out 0; where it does not, no
    difference if it is within SAME, else undecided. The same seeds are drawn in pairs: their first episodes are the
    same. With a published number: beats, reaches or misses it, as the interval lies below, around or above.
    """
    first = costs(claim.lower, claim.trials, figure, out)
    second = costs(claim.than, claim.trials, figure, out) if isinstance(claim.than, str) else claim.than
    if first is None or second is None:
        return Judged(claim, MISSING, MISSING)
    if isinstance(second, Costs):
        low, high = interval(first.mean, second.mean, paired=first.seeds == second.seeds)
        neither = "no difference" if max(-low, high) <= SAME else "undecided"
        words, other = ("agrees", neither, "contradicts"), iqm(second.mean)
    else:
        low, high = (end - second for end in interval(first.mean))
        words, other = ("beats", "reaches", "misses"), second
    verdict = words[0] if high < 0 else words[2] if low > 0 else words[1]
    difference = f"{iqm(first.mean) - other:+.3f} [{low:+.3f}, {high:+.3f}]"
    return Judged(claim, difference, verdict)


def costs(variant: str, trials: tuple[int, int], figure: Figure, out: Path) -> Costs | None:
    """A study's costs over the trials, from and to; None where they have not all been run."""
    result = stored(out, f"{figure.name}-{variant}" if variant in figure.variants else variant)
    if result is None or len(result["plant_seconds"]) < trials[1]:
        return None
    return Costs(result["seeds"], np.asarray(result["mean_cost"], float)[:, trials[0] - 1 : trials[1]].mean(1))


def middling(values: np.ndarray) -> str:
    """Interquartile mean of seeds [S] and its interval."""
    low, high = interval(values)
    return f"{iqm(values):.3f} [{low:.3f}, {high:.3f}]" if len(values) > 1 else f"{values[0]:.3f}"


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
    return [label, *shape, middling(cost[:, -1]), middling(cost.mean(1)), solved, when(result["success_rate"])]


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
        judged = test_claim(claim, figure, out)
        first, last = claim.trials
        span = f"trial {first}" if first == last else f"trials {first} to {last}"
        than = claim.than if isinstance(claim.than, str) else f"published {claim.than:g}"
        rows.append([claim.says, span, f"{claim.lower}, {than}", judged.difference, judged.verdict])
    return [["claim", "mean cost of", "this, below that", "difference", "verdict"], *rows]


def markdown(table: list[list[str]]) -> str:
    """A table, header first, as Markdown that is readable as it is."""
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)) + " |"
        for cells in table
    ]
    return "\n".join([lines[0], "|" + "|".join("-" * (width + 2) for width in widths) + "|", *lines[1:]])
