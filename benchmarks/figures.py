"""The paper's experiments as data: what varies, over how many seeds and trials, and one picture of each.

    python -m benchmarks.figures NAME [seeds=0-9] [setting=value ...]

Runs each variant as one vmapped study, writes benchmarks/results/NAME-VARIANT.json and draws results/NAME.png: every
seed's raw curve thin, the interquartile mean over seeds thick with its 95 % bootstrap interval. A study that is there
already is not run again; delete its JSON to repeat it. On two CPU cores a variant of ten seeds takes most of an hour.
"""

import json
import shlex
import sys
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from scipy.stats import bootstrap, trim_mean

from benchmarks.study import RESULTS, seed_list, study
from pegasus_jax import settings
from pegasus_jax.record import about


class Figure(NamedTuple):
    """One comparison."""

    title: str
    common: tuple[str, ...]  # settings of every variant
    variants: dict[str, tuple[str, ...]]  # label -> its own settings


FIGURES = {
    "cartpole": Figure("Cart-pole swing-up, default settings", ("trials=15",), {"default": ()}),
    "crn": Figure(
        "Fixed against fresh random numbers (paper, fig. 3a)",
        ("trials=25", "algorithm=paper", "search.learning_rate=1e-4"),
        {
            "fixed": (),
            "fresh": tuple(f"search.period.{block}=1" for block in ("start", "dynamics", "policy", "sensor", "match")),
        },
    ),
    "clip": Figure(
        "Gradient clipping (paper, fig. 3b)",
        ("trials=25", "algorithm=paper"),
        {str(clip): (f"search.clip={clip}",) for clip in ("null", 1000, 100, 10, 1, 0.1, 0.01, 0.001)},
    ),
    "nn": Figure(
        "Network policies (paper, fig. 4b)",
        ("trials=25", "algorithm=paper"),
        {
            f"{model}-{policy}": (f"model={model}", f"policy={policy}")
            for model in ("binary", "log_normal")
            for policy in ("mlp", "dropout_mlp")
        },
    ),
}


def main(words: list[str]) -> None:
    """The command line of this module."""
    if not words or words[0] not in FIGURES:
        raise SystemExit(f"name a figure: {', '.join(FIGURES)}")
    name, *rest = words
    figure = FIGURES[name]
    options, dotted = settings.split(rest, ("seeds",))
    results = {}
    for label, own in figure.variants.items():
        path = RESULTS / f"{name}-{label}.json"
        if not path.exists():
            _, varied = settings.split([*figure.common, *own])
            result = study(settings.parse(varied | dotted), seed_list(options.get("seeds", "0-9")))
            result["about"] = about(shlex.join(["python", "-m", "benchmarks.figures", *words]))
            RESULTS.mkdir(exist_ok=True)
            path.write_text(json.dumps(result) + "\n")
        results[label] = json.loads(path.read_text())
    draw(figure.title, results, RESULTS / f"{name}.png")


def draw(title: str, results: dict[str, dict[str, Any]], path: Path) -> None:
    """Cost and success of every seed of every variant against plant time."""
    figure, (top, bottom) = plt.subplots(2, 1, sharex=True, figsize=(7, 6))
    for colour, (label, result) in enumerate(results.items()):
        curves(top, result["plant_seconds"], np.asarray(result["mean_cost"]), f"C{colour}", label)
        curves(bottom, result["plant_seconds"], np.asarray(result["success_rate"]), f"C{colour}", label)
    top.set(title=title, ylabel="mean cost a step")
    bottom.set(ylabel="success rate", xlabel="plant time [s]")
    if len(results) > 1:
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


if __name__ == "__main__":
    main(sys.argv[1:])
