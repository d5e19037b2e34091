"""Learning curves of several seeds: each one raw, and their interquartile mean with its uncertainty."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from scipy.stats import bootstrap, trim_mean

from pegasus_jax.record import RunError, trials


def seeds_picture(runs: Sequence[Path], path: Path) -> Path:
    """Draw cost and success of the runs against plant time, as far as every run has come."""
    rows = [trials(run) for run in runs]
    shared = min(map(len, rows))
    if not shared:
        raise RunError(f"{runs[0].parent}: not every run has a finished trial yet")
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
    for colour, (label, (cost, success)) in enumerate(results.items()):
        curves(top, seconds[: cost.shape[1]], cost, f"C{colour}", label)
        curves(bottom, seconds[: cost.shape[1]], success, f"C{colour}", label)
    top.set(title=title, ylabel="mean cost a step")
    bottom.set(ylabel="success rate", xlabel="plant time [s]")
    top.legend(frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def curves(axis: Axes, x: list[float], values: np.ndarray, colour: str, label: str) -> None:
    """Raw curves [S, T] thin; interquartile mean over seeds thick, with its 95 % bootstrap interval."""
    axis.plot(x, values.T, color=colour, lw=0.5, alpha=0.4)
    axis.plot(x, trim_mean(values, 0.25, axis=0), color=colour, lw=2, label=label)
    if values.shape[0] > 2:
        interval = bootstrap(
            (values,),
            lambda v, axis: trim_mean(v, 0.25, axis=axis),
            axis=0,
            n_resamples=2000,
            method="percentile",
            rng=np.random.default_rng(0),
        ).confidence_interval
        axis.fill_between(x, interval.low, interval.high, color=colour, alpha=0.2, lw=0)
    axis.grid(alpha=0.25)
