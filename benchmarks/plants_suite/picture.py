"""The suite's results as one picture: the share of seeds at the bar against plant time, a panel for each plant.

    python -m benchmarks.plants_suite.picture [FILE ...] [out=benchmarks/results/plants_suite.png]

FILE is what `python -m benchmarks.plants_suite` wrote; without one, the stored results of the usual settings.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from benchmarks import RESULTS, command
from benchmarks.plants_suite.__main__ import share
from benchmarks.plants_suite.plants import PLANTS
from pegasus_jax.checks import ConfigError
from pegasus_jax.runs import config_io
from pegasus_jax.runs.files import write_whole

USUAL = [
    "pendulum",
    "inverted_pendulum",
    "mountain_car",
    "double_pendulum",
    "reacher",
    "dm_cartpole",
    "dm_pendulum",
    "cartpole",
    "pendubot",
    "by_hand",
]
COLUMNS = 4
Run = dict[str, Any]


def shares(runs: Sequence[Run], bar: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Plant times [T], the share of runs whose newest policy then is at the bar [T], and of those that ever were [T].

    A run that was stopped keeps its last policy.
    """
    times = np.unique([row["plant_seconds"] for run in runs for row in run["trials"]])
    reached = [[row["plant_seconds"] for row in run["trials"] if row["native"] >= bar] for run in runs]
    first = np.array([min(seconds, default=np.inf) for seconds in reached])
    return times, np.array([share(runs, bar, until) for until in times]), np.mean(first[:, None] <= times, 0)


def draw(runs: Sequence[Run], path: Path) -> None:
    """A panel for each plant of the runs, in the order of the suite."""
    names = [name for name in PLANTS if any(run["plant"] == name for run in runs)]
    rows = -(-len(names) // COLUMNS)
    figure, panels = plt.subplots(rows, COLUMNS, sharey=True, squeeze=False, figsize=(2.8 * COLUMNS, 2.2 * rows))
    for panel in panels.flat[len(names) :]:
        panel.set_axis_off()
    for name, panel in zip(names, panels.flat, strict=False):
        own = [run for run in runs if run["plant"] == name]
        times, newest, ever = (np.concatenate([[0.0], line]) for line in shares(own, PLANTS[name].bar))
        panel.step(times, ever, where="post", color="C0", lw=1, ls=":", label="at the bar at some trial")
        panel.step(times, newest, where="post", color="C0", lw=2, label="newest policy at the bar")
        panel.axvline(PLANTS[name].by, color="0.6", lw=1, ls="--", label="time for it")
        panel.set_title(f"{name}, {len(own)} seeds", fontsize=9)
        panel.set(xlim=(0, max(times[-1], 1.05 * PLANTS[name].by)), ylim=(-0.03, 1.03))
        panel.tick_params(labelsize=8)
        panel.grid(alpha=0.25)
    figure.supxlabel("plant time [s]", fontsize=9)
    figure.supylabel("share of seeds", fontsize=9)
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="upper center", ncol=3, frameon=False, fontsize=9)
    figure.tight_layout(rect=(0, 0, 1, 0.96))
    write_whole(path, lambda file: figure.savefig(file, format="png", dpi=110))
    plt.close(figure)


def main(words: Sequence[str]) -> None:
    """The command line of this module. Raises ConfigError for a file that is not the suite's."""
    files = [Path(word) for word in words if "=" not in word]
    options, rest = config_io.split([word for word in words if "=" in word], ("out",))
    if rest:
        raise ConfigError(f"{next(iter(rest))}= is not a word of this; expected files and out=FILE")
    runs = list[Run]()
    for file in files or [RESULTS / f"plants_suite-{name}.json" for name in USUAL]:
        try:
            runs += json.loads(file.read_text())["runs"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"{file} is not what python -m benchmarks.plants_suite writes") from error
    draw(runs, Path(options.get("out", str(RESULTS / "plants_suite.png"))))


if __name__ == "__main__":
    command(main, __doc__)
