"""Learning curves of several seeds and areas under them: each one raw, and their interquartile mean, uncertain."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from scipy.stats import bootstrap, trim_mean

from pegasus_jax.checks import RunError
from pegasus_jax.runs.files import write_whole
from pegasus_jax.runs.store import trials


def seeds_picture(runs: Sequence[Path], path: Path) -> Path:
    """Draw cost and success of the runs against plant time, as far as every run has come."""
    rows = [trials(run) for run in runs]
    shared = min(map(len, rows))
    if not shared:
        raise RunError(f"{runs[0].parent}: not every run has a finished trial yet")
    if any(row["mean_cost"] is None for run in rows for row in run[:shared]):
        raise RunError(
            f"{runs[0].parent}: these runs were not evaluated (eval_episodes=0); pegasus-plot draws each alone"
        )
    cost, success = ([[row[name] for row in run[:shared]] for run in rows] for name in ("mean_cost", "success_rate"))
    picture(
        {f"{len(runs)} seeds": (np.asarray(cost), np.asarray(success))}, [r["plant_seconds"] for r in rows[0]], path
    )
    return path


def picture(
    results: dict[str, tuple[np.ndarray, np.ndarray]], seconds: list[float], path: Path, title: str = ""
) -> None:
    """Draw label -> (mean cost [S, T], success rate [S, T]) against plant time [s]."""
    figure, (top, bottom) = plt.subplots(2, 1, sharex=True, figsize=(7, 6))
    for color, (label, (cost, success)) in enumerate(results.items()):
        curves(top, seconds[: cost.shape[1]], cost, f"C{color}", label)
        curves(bottom, seconds[: cost.shape[1]], success, f"C{color}", label)
    top.set(title=title, ylabel="mean cost a step")
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


def iqm(values: np.ndarray, axis: int = 0) -> np.ndarray:
    """The interquartile mean over seeds, the first axis."""
    return trim_mean(values, 0.25, axis=axis)


def interval(*samples: np.ndarray, paired: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """The 95 % bootstrap interval of the interquartile mean over seeds [S, ...]; of two samples, of the difference.

    `paired` says that both samples have the same seeds, in one order. Unbounded for a single seed, which says nothing
    of the others.
    """
    if min(map(len, samples)) < 2:
        return np.full(samples[0].shape[1:], -np.inf), np.full(samples[0].shape[1:], np.inf)

    def statistic(first: np.ndarray, *second: np.ndarray, axis: int) -> np.ndarray:
        return iqm(first, axis) - sum(iqm(other, axis) for other in second)

    options: dict = dict(axis=0, n_resamples=2000, method="percentile", paired=paired, rng=np.random.default_rng(0))
    found = bootstrap(samples, statistic, **options).confidence_interval
    return found.low, found.high
