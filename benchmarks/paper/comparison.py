"""A figure's studies: those that are missing are run, all are drawn. OUT/FIGURE-VARIANT.json is a study's file."""

import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.paper.figures import Figure
from pegasus_jax import tasks
from pegasus_jax.assembly.experiments import build
from pegasus_jax.checks import ConfigError, RunError, did_you_mean
from pegasus_jax.config import Config
from pegasus_jax.runs import config_io
from pegasus_jax.runs.machine import about
from pegasus_jax.runs.study import seed_list, study, write
from pegasus_jax.viz.learning_curves import areas_picture, picture

Result = dict[str, Any]  # a study's JSON

OPTIONS = ("out", "seeds", "variants")  # of the command; other words are settings


def configs(figure: Figure, changes: Sequence[str] = ()) -> dict[str, Config]:
    """The config of each variant, `changes` (words of a command line) in all of them. Raises ConfigError, naming it.

    Later words win: the figure's trials, what is common, the variant's own, `changes`.
    """
    found = {}
    for label, own in figure.variants.items():
        try:
            words = [f"trials={figure.trials}", *shlex.split(figure.common), *shlex.split(own), *changes]
            config = config_io.parse(config_io.split(words)[1], options=OPTIONS)
            with jax.enable_x64(config.x64):
                build(config)  # so that impossible settings end here, before an hour's work
        except ValueError as error:  # a ConfigError is one
            raise ConfigError(f"figure {figure.name}, variant {label}: {error}") from error
        found[label] = config
    return found


def run(
    figure: Figure, out: Path, *, seeds: str = "", only: Sequence[str] = (), changes: Sequence[str] = (), command: str
) -> dict[str, Result]:
    """Run the variants (those of `only`, or all) whose study is not in `out` yet; the studies that are there then.

    Raises ConfigError for an impossible one before the first is run.
    """
    for label in only:
        if label not in figure.variants:
            raise ConfigError(
                f"{label} is not a variant of figure {figure.name}; {did_you_mean(label, figure.variants)}"
            )
    chosen, wanted = seed_list(seeds or figure.seeds), configs(figure, changes)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"out={out} cannot be written: {error.strerror}") from error
    for label in only or figure.variants:
        if stored(out, f"{figure.name}-{label}") is None:
            path = out / f"{figure.name}-{label}.json"
            print(f"{path}: {len(chosen)} seeds, {wanted[label].trials} trials", file=sys.stderr, flush=True)
            write(path, study(wanted[label], chosen, path) | {"about": about(command)})
    return results(figure, out)


def results(figure: Figure, out: Path) -> dict[str, Result]:
    """Label -> study, of the variants whose studies are in `out`."""
    there = {label: stored(out, f"{figure.name}-{label}") for label in figure.variants}
    return {label: result for label, result in there.items() if result is not None}


def stored(out: Path, stem: str) -> Result | None:
    """The study OUT/STEM.json, or None where there is none that came to its end. Raises RunError for another file."""
    path = out / f"{stem}.json"
    if not path.exists():
        return None
    try:
        result = json.loads(path.read_text())
        np.asarray(result["mean_cost"], float)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RunError(f"{path} is not the JSON of a study: {error!r}") from error
    return result if "about" in result else None  # written at the end


def draw(figure: Figure, there: dict[str, Result], out: Path) -> Path:
    """OUT/FIGURE.png of the studies that are there."""
    path = out / f"{figure.name}.png"
    lines = {
        label: (np.asarray(result["mean_cost"], float), np.asarray(result["success_rate"], float))
        for label, result in there.items()
    }
    seconds = max((result["plant_seconds"] for result in there.values()), key=len)
    {"curves": picture, "area": areas_picture}[figure.picture](lines, seconds, path, figure.title)
    return path


def measured(result: Result) -> Config:
    """The config of a stored study, with the numbers of its model."""
    return numbered(config_io.stored_config(result["config"]))


def numbered(config: Config) -> Config:
    """The config with what null is on its plant: a study has the numbers that it was made with."""
    return config_io.numbered(config, len(tasks.of_config(config).state_names))


def differences(figure: Figure, there: dict[str, Result], seeds: str = "", changes: Sequence[str] = ()) -> list[str]:
    """A line for each study that was made with other seeds or settings than the figure now asks for."""
    lines, chosen = [], seed_list(seeds or figure.seeds)
    for label, config in configs(figure, changes).items():
        asked = {key: value for key, value in config_io.plain(numbered(config)).items() if key != "seed"}
        kept = there[label]["config"] if label in there else {}  # of an older version, without younger settings
        had = config_io.plain(measured(there[label])) if kept else {}
        other = [f"{key}={had[key]}, not {value}" for key, value in asked.items() if key in kept and had[key] != value]
        if label in there and there[label]["seeds"] != chosen:
            other.append(f"seeds={there[label]['seeds']}, not {chosen}")
        if other:
            lines.append(f"{figure.name}-{label}.json was made with {', '.join(other)}; delete it to run it again")
    return lines
