"""The commands that look at runs: pegasus-eval, -plot, -play."""

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from pegasus_jax.checks import ConfigError, true, whole
from pegasus_jax.cli.words import OF_RUN


def evaluate(words: Sequence[str]) -> None:
    run, rest = run_and(words, OF_RUN["pegasus-eval"])
    episodes, seed = (whole(name, rest[name]) for name in ("episodes", "seed"))
    as_json = true("json", rest["json"])
    from pegasus_jax.runs.evaluation import evaluate_run
    from pegasus_jax.runs.restore import chosen

    trial = trial_of(rest["trial"])
    result = evaluate_run(run, episodes, seed, trial, rest["mjcf"] or None)
    if as_json:
        print(json.dumps(result))
    else:
        print(chosen(run, trial, result["trial"]))
        many = f"{episodes} episode{'s' * (episodes != 1)}"
        print(f"{many}: mean cost {result['mean_cost']:.3f}, success {result['success_rate']:.0%}")


def plot(words: Sequence[str]) -> None:
    paths, _ = paths_and(words, OF_RUN["pegasus-plot"])
    if len(paths) > 1:
        raise ConfigError(f"name one run, or one folder of runs, not {len(paths)}; pegasus-report takes several")
    from pegasus_jax.runs import groups, store

    runs = groups.found(paths)
    if len(runs) == 1:
        from pegasus_jax.viz.run_plots import run_pictures

        for path in run_pictures(runs[0], store.task_of(runs[0])):
            print(path)
        return
    from pegasus_jax.viz.learning_curves import groups_picture

    compared, problems = groups.readable(runs)
    for problem in problems:
        print(f"note: left out: {problem}", file=sys.stderr)
    print(groups_picture(groups.grouped(compared), paths[0] / "learning.png"))


def play(words: Sequence[str]) -> None:
    run, rest = run_and(words, OF_RUN["pegasus-play"])
    episodes, seed = (whole(name, rest[name]) for name in ("episodes", "seed"))
    from pegasus_jax.viz.video import film

    print(film(run, episodes, seed, trial_of(rest["trial"]), rest["mjcf"] or None))


def run_and(words: Sequence[str], defaults: dict[str, str]) -> tuple[Path, dict[str, str]]:
    """The run's folder, and the options of a command that reads it."""
    from pegasus_jax.runs import store

    paths, options = paths_and(words, defaults)
    if len(paths) != 1:
        raise ConfigError(f"name one run, not {len(paths)}; for example runs/cartpole-seed0")
    (path,) = paths
    if runs := store.seeds_of(path):
        raise ConfigError(f"{path} holds the runs of {len(runs)} seeds; name one, for example {runs[min(runs)]}")
    return store.existing(path), options


def paths_and(words: Sequence[str], defaults: dict[str, str]) -> tuple[list[Path], dict[str, str]]:
    """The folders that are named, and the options. Raises ConfigError for words that cannot be."""
    from pegasus_jax.checks import did_you_mean
    from pegasus_jax.runs import config_io

    def nearest(word: str) -> str:
        return did_you_mean(word, defaults) if defaults else "there are none"

    for word in words:
        if word.startswith("-") and not Path(word).exists():
            raise ConfigError(f"'{word}' is not an option here, key=value; {nearest(word.lstrip('-'))}")
    named = [
        word for word in words if "=" not in word or (word.partition("=")[0] not in defaults and Path(word).exists())
    ]
    if not named:
        raise ConfigError("no run is named; for example runs/cartpole-seed0")
    _, rest = config_io.split([word for word in words if word not in named])
    for key in rest:
        if key not in defaults:
            raise ConfigError(f"{key} is not an option here; {nearest(key)}")
    return [Path(word) for word in named], defaults | rest


def trial_of(text: str) -> int | str:
    """The trial whose policy is asked for. Raises ConfigError for a text that names none."""
    if text in ("last", "best"):
        return text
    if not text.isdecimal():
        raise ConfigError(f"trial={text} is not a trial; expected a number, best or last")
    return int(text)
