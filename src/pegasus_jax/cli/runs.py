"""The commands that look at runs: pegasus-eval, -plot, -play."""

import json
from collections.abc import Sequence
from pathlib import Path

from pegasus_jax.checks import ConfigError, whole


def evaluate(words: Sequence[str]) -> None:
    run, rest = run_and(words, {"episodes": "20", "seed": "0", "json": "false", "trial": "last", "mjcf": ""})
    episodes, seed = (whole(name, rest[name]) for name in ("episodes", "seed"))
    if rest["json"] not in ("true", "false"):
        raise ConfigError(f"json={rest['json']} is neither true nor false")
    from pegasus_jax.runs.evaluation import evaluate_run

    result = evaluate_run(run, episodes, seed, trial_of(rest["trial"]), rest["mjcf"] or None)
    if rest["json"] == "true":
        print(json.dumps(result))
    else:
        print("\n".join(f"{name:>13}  {value}" for name, value in result.items()))


def plot(words: Sequence[str]) -> None:
    run, _ = run_and(words, {}, many=True)
    from pegasus_jax.runs import store
    from pegasus_jax.viz.learning_curves import seeds_picture
    from pegasus_jax.viz.run_plots import run_pictures

    if runs := store.seeds_of(run):
        print(seeds_picture(list(runs.values()), run / "learning.png"))
        return
    for path in run_pictures(run, store.task_of(run)):
        print(path)


def play(words: Sequence[str]) -> None:
    run, rest = run_and(words, {"episodes": "1", "seed": "0", "trial": "last", "mjcf": ""})
    episodes, seed = (whole(name, rest[name]) for name in ("episodes", "seed"))
    from pegasus_jax.viz.video import film

    print(film(run, episodes, seed, trial_of(rest["trial"]), rest["mjcf"] or None))


def run_and(words: Sequence[str], defaults: dict[str, str], many: bool = False) -> tuple[Path, dict[str, str]]:
    """The run's folder, or with `many` maybe that of several seeds, and the options of a command that reads it."""
    from pegasus_jax.checks import did_you_mean
    from pegasus_jax.runs import config_io, store

    named = [word for word in words if "=" not in word]
    if len(named) != 1:
        raise ConfigError(f"name one run, not {len(named)}; for example runs/cartpole-seed0")
    _, rest = config_io.split([word for word in words if "=" in word])
    for key in rest:
        if key not in defaults:
            raise ConfigError(
                f"{key} is not an option here; {did_you_mean(key, defaults) if defaults else 'there are none'}"
            )
    path = Path(named[0])
    if runs := store.seeds_of(path):
        if not many:
            raise ConfigError(f"{path} holds the runs of {len(runs)} seeds; name one, for example {runs[min(runs)]}")
        return path, defaults | rest
    return store.existing(path), defaults | rest


def trial_of(text: str) -> int | str:
    """The trial whose policy is asked for. Raises ConfigError for a text that names none."""
    if text in ("last", "best"):
        return text
    if not text.isdecimal():
        raise ConfigError(f"trial={text} is not a trial; expected a number, best or last")
    return int(text)
