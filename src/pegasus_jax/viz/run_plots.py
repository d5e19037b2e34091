"""Pictures of a run: its learning curve, and each trial's imagined trajectories against what the plant then did."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from pegasus_jax.checks import RunError
from pegasus_jax.math.window import window
from pegasus_jax.runs.files import write_whole
from pegasus_jax.runs.store import load_episode, load_imagined, trials
from pegasus_jax.task import Task

REAL, IMAGINED = "#d1495b", "#30638e"


def run_pictures(run: Path, task: Task) -> list[Path]:
    """Draw RUN/plots/learning.png and RUN/plots/trial_NNNN.png for every trial that has been imagined."""
    rows = trials(run)
    if not rows:
        raise RunError(f"{run / 'trials.jsonl'} holds no finished trial yet")
    folder = run / "plots"
    if folder.is_symlink():  # what it points to may be anybody's
        folder.unlink()
    paths = [folder / "learning.png"]
    learning(rows, paths[0])
    for row in rows:
        fan = load_imagined(run, row["trial"])
        if fan is not None:
            paths.append(folder / f"trial_{row['trial']:04d}.png")
            trajectories(run, row["trial"], fan, task, paths[-1])
    return paths


def trial_pictures(run: Path, task: Task, trial: int) -> dict[str, Path]:
    """Draw the learning curve, and what was imagined after the trial before, if a policy was searched, with this
    trial's episode over it."""
    found = {"learning": run / "plots" / "learning.png"}
    learning(trials(run)[:trial], found["learning"])
    fan = load_imagined(run, trial - 1)
    if fan is not None:
        found["imagined_and_real"] = run / "plots" / f"trial_{trial - 1:04d}.png"
        trajectories(run, trial - 1, fan, task, found["imagined_and_real"])
    return found


def learning(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Cost and success against seconds of plant time, raw: no smoothing, no best so far.

    Of a run that is not evaluated, those of each trial's own episode, by the policy of the trial before. Episodes that
    ended early have an empty circle.
    """
    measured = any(row["mean_cost"] is not None for row in rows)
    cost, good = ("mean_cost", "success_rate") if measured else ("episode_cost", "episode_success")
    early = [row for row in rows if row.get("ended", "horizon") != "horizon"]
    hollow = dict(color=REAL, mfc="white", zorder=3)
    figure, (top, bottom) = plt.subplots(2, 1, sharex=True, figsize=(7, 5.5), height_ratios=(2, 1))
    label = "mean of evaluation episodes" if measured else "the trial's episode"
    _line(top, rows, cost, "o-", color=REAL, label=f"plant, {label}")
    _line(top, rows, "objective_last", ".--", color=IMAGINED, label="imagined, held scenarios")
    _line(top, rows, "objective_fresh", ".:", color=IMAGINED, label="imagined, fresh scenarios")
    if early:
        _line(top, early, "episode_cost", "o", label="plant, an episode that ended early", **hollow)
    top.set(ylabel="mean cost a step", ylim=(0, max(1.02, *(1.04 * (row[cost] or 0) for row in rows))))
    top.legend(frameon=False)
    _line(bottom, rows, good, "o-", color=REAL)
    bottom.set(ylabel="success rate", xlabel="plant time [s]", ylim=(-0.06, 1.06))
    if not measured:
        _line(bottom, early, good, "o", **hollow)
        bottom.set_ylabel("episode succeeded")
        bottom.set_yticks([0, 1], ["no", "yes"])
    for axis in (top, bottom):
        axis.grid(alpha=0.25)
    _save(figure, path)


def _line(axis: Axes, rows: Sequence[dict[str, Any]], name: str, style: str, **how: Any) -> None:
    """Draw a number of the rows; where a row lacks it, there is a gap."""
    axis.plot([row["plant_seconds"] for row in rows], np.array([row.get(name) for row in rows], float), style, **how)


def trajectories(run: Path, trial: int, fan: dict[str, np.ndarray], task: Task, path: Path) -> None:
    """The fan of particles after a trial, and over it the next episode on the plant, if it has been run."""
    real = load_episode(run, trial + 1)
    names = [*task.state_names, *task.control_names, "cost"]
    columns = 3
    figure, axes = plt.subplots(-(-len(names) // columns), columns, figsize=(11, 2.4 * -(-len(names) // columns)))
    flat: list[Axes] = list(np.ravel(axes))
    imagined = [*np.moveaxis(fan["x"], -1, 0), *np.moveaxis(fan["u"], -1, 0), fan["cost"]]
    actual = None if real is None else [*real.trajectory.x.T, *real.trajectory.u.T, real.trajectory.cost]
    for i, (axis, name) in enumerate(zip(flat, names, strict=False)):
        first = 1 if name == "cost" else 0
        _fan(axis, (first + np.arange(imagined[i].shape[0])) * task.dt, imagined[i])
        if limits := window(None if actual is None else actual[i], imagined[i]):
            axis.set_ylim(*limits)
        if actual is not None:
            axis.plot((first + np.arange(len(actual[i]))) * task.dt, actual[i], color=REAL, lw=1.6)
        axis.set_title(name, fontsize=9)
        axis.grid(alpha=0.25)
    for axis in flat[len(names) :]:
        axis.axis("off")
    told = "the plant's next episode in red" if actual is not None else "no trial has run this policy yet"
    figure.suptitle(f"after trial {trial}: imagined particles in blue, {told}", fontsize=10)
    _save(figure, path)


def _fan(axis: Axes, time: np.ndarray, values: np.ndarray) -> None:
    """Every particle thin, the middle 50 and 90 % shaded; values [H, K]."""
    axis.plot(time, values[:, :40], color=IMAGINED, lw=0.4, alpha=0.25)
    for low, high, alpha in ((5, 95, 0.15), (25, 75, 0.25)):
        bounds = np.percentile(values, (low, high), axis=1)
        axis.fill_between(time, *bounds, color=IMAGINED, alpha=alpha, lw=0)


def _save(figure: Any, path: Path) -> None:
    figure.tight_layout()
    write_whole(path, lambda file: figure.savefig(file, format="png", dpi=110))
    plt.close(figure)
