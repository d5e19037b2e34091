"""The paper's experiments as data: what varies, over how many seeds and trials, and one picture of each.

    python -m benchmarks.figures NAME [seeds=0-9] [setting=value ...]

Runs each variant as one vmapped study, writes benchmarks/results/NAME-VARIANT.json and draws results/NAME.png: every
seed's raw curve thin, the interquartile mean over seeds thick with its 95 % bootstrap interval. A study that is there
already is not run again; delete its JSON to repeat it. On two CPU cores a variant of ten seeds takes most of an hour.
"""

import json
import shlex
import sys
from typing import NamedTuple

import numpy as np

from benchmarks.study import RESULTS, seed_list, study
from pegasus_jax import settings
from pegasus_jax.record import about
from pegasus_jax.report.curves import picture


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
    curves = {label: (np.asarray(r["mean_cost"]), np.asarray(r["success_rate"])) for label, r in results.items()}
    seconds = max((result["plant_seconds"] for result in results.values()), key=len)
    picture(curves, seconds, RESULTS / f"{name}.png", figure.title)


if __name__ == "__main__":
    main(sys.argv[1:])
