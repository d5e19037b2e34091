"""Learning curves of several seeds and areas under them: each one raw, and their interquartile mean, uncertain."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from pegasus_jax.math.interquartile import interval, iqm
from pegasus_jax.runs.files import write_whole
from pegasus_jax.runs.groups import Group, measured, plant_seconds


def groups_picture(groups: Sequence[Group], path: Path) -> Path:
    """Draw cost and success of runs that exist against plant time, a color for each group of seeds."""
    kind = measured(groups)
    results = {
        f"{group.label} ({len(group.runs)} seed{'s'[: len(group.runs) > 1]})": (
            plant_seconds(group),
            group.curves(kind.cost),
            group.curves(kind.success),
        )
        for group in groups
    }
    _picture(results, path, kind.words)
    return path


def picture(
    results: dict[str, tuple[np.ndarray, np.ndarray]], seconds: list[float], path: Path, title: str = ""
) -> None:
    """Draw label -> (mean cost [S, T], success rate [S, T]) against plant time [s]."""
    _picture({label: (seconds[: cost.shape[1]], cost, good) for label, (cost, good) in results.items()}, path, title)


def _picture(results: dict[str, tuple[list[float], np.ndarray, np.ndarray]], path: Path, title: str) -> None:
    figure, (top, bottom) = plt.subplots(2, 1, sharex=True, figsize=(7, 6))
    for color, (label, (seconds, cost, success)) in enumerate(results.items()):
        curves(top, seconds, cost, f"C{color}", label)
        curves(bottom, seconds, success, f"C{color}", label)
    top.set(ylabel="mean cost a step")
    top.set_title(title, fontsize=10)
    bottom.set(ylabel="success rate", xlabel="plant time [s]")
    top.legend(frameon=False)
    figure.tight_layout()
    write_whole(path, lambda file: figure.savefig(file, format="png", dpi=110))
    plt.close(figure)


def curves(axis: Axes, x: list[float], values: np.ndarray, color: str, label: str) -> None:
    """Raw curves [S, T] thin; interquartile mean over seeds thick, with its 95 % bootstrap interval."""
    axis.plot(x, values.T, color=color, lw=0.5, alpha=0.4)
    axis.plot(x, iqm(values), color=color, lw=2, label=label)
    if values.shape[0] > 2:
        axis.fill_between(x, *interval(values), color=color, alpha=0.2, lw=0)
    axis.grid(alpha=0.25)


def areas_picture(
    results: dict[str, tuple[np.ndarray, np.ndarray]], seconds: list[float], path: Path, title: str = ""
) -> None:
    """Draw the area under the learning curve of each label -> (mean cost [S, T], success rate [S, T]).

    That is the mean over trials, as many as every label has, of the mean cost a step. A dot a seed.
    """
    shared = min(cost.shape[1] for cost, _ in results.values())
    figure, axis = plt.subplots(figsize=(7, 4))
    for x, (cost, _) in enumerate(results.values()):
        areas = cost[:, :shared].mean(1)
        spread = 0.25 * (np.arange(areas.size) / max(areas.size - 1, 1) - 0.5)  # so that no dot hides another
        axis.plot(x + spread, areas, "o", color="C0", ms=4, alpha=0.5, mew=0)
        axis.plot([x - 0.25, x + 0.25], 2 * [iqm(areas)], color="C0", lw=2)
        if areas.size > 2:
            axis.fill_between([x - 0.25, x + 0.25], *interval(areas), color="C0", alpha=0.2, lw=0)
    axis.set_xticks(range(len(results)), list(results))
    axis.set(
        title=title, ylabel=f"mean cost a step, mean of trials 1 to {shared}\n({seconds[shared - 1]:g} s of plant)"
    )
    axis.grid(axis="y", alpha=0.25)
    figure.tight_layout()
    write_whole(path, lambda file: figure.savefig(file, format="png", dpi=110))
    plt.close(figure)
