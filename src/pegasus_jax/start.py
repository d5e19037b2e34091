"""How a run begins, by a command or from Python: its folder, the checks before it, the loop, and what is said of it.

A command speaks before JAX is there, so whatever imports JAX is imported where it is needed.
"""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from pegasus_jax.checks import ConfigError, brief, shown, size
from pegasus_jax.config import Config, label
from pegasus_jax.config_used import check_config, check_used, leaves
from pegasus_jax.runs import trackers
from pegasus_jax.shell import typed

Mesh = Any  # a jax.sharding.Mesh; None: one device


class Asked(NamedTuple):
    """What a command line, or a call, asks for."""

    config: Config
    home: Path  # the run's folder, or that of the runs of many seeds
    runs: dict[int, Path]  # seed -> folder
    resumed: Path | None = None  # of a run that goes on, its folder, or the first one's
    mjcf: str | None = None  # where the file of a run that goes on is now
    final: bool = False  # whether the last policy runs once more
    track: tuple[str, ...] | None = None  # the trackers; None: those of before


@brief
def preset(
    name: str = "cartpole",
    *,
    model: str | None = None,
    policy: str | None = None,
    algorithm: str | None = None,
    effort: str | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Config:
    """The config of a command with these words: preset("cartpole") is that of `pegasus-train task=cartpole`.

    `model`, `policy`, `algorithm` and `effort` are the command's words. `settings` are its other ones, by name, each
    with its text or its value: {"search.steps": 200, "explore.kind": "walk"}. An env_args.NAME is given as it is, "5"
    as a text and a tuple as a list; {"env_args": {"NAME": "5"}} is the same. Raises ConfigError as the command would,
    in one line with the nearest choice.
    """
    from pegasus_jax.runs import config_io

    said = {"preset": name, "model": model, "policy": policy, "algorithm": algorithm, "effort": effort}
    words = {word: value for word, value in said.items() if value is not None}
    return config_io.parse(words | config_io.of_python(settings or {}))


@brief
def train(
    config: Config | str | None = None,
    *,
    out: str | Path | None = None,
    resume: str | Path | None = None,
    settings: Mapping[str, Any] | None = None,
    cost: Callable[[Any], Any] | None = None,
    seeds: int = 1,
    final: bool = False,
    mesh: Mesh = None,
    data: str | Sequence[str] | None = None,
    track: str | Sequence[str] | None = None,
) -> Path:
    """Learn what `pegasus-train` would, by the same loop and with the same files; returns the run's folder.

    config: of a new run, or the name of a preset; None: "cartpole"
    out: the folder of a new run, or of those of many seeds; None: a free one in runs/
    resume: the folder of a run that goes on, instead of config and out
    settings: by name, as for `preset`; of a run that goes on those that may change
    cost: of a gym's or an mjcf's task a function of one observation, instead of the setting cost="module:function"
    seeds: so many, from config.seed on, as one program
    final: whether the last policy runs for one more episode
    data: files or patterns of logs that the run begins with, as the setting `data`
    mesh: the devices that share seeds and particles (sharding.py); None: as many as share the seeds evenly
    track: where numbers, settings and pictures also go, as the command's word: "wandb", ("wandb", "mlflow") or "none"

    Raises ConfigError for what cannot be, and RunError where a run cannot go on. JAX has the config's precision while
    it runs; its devices are the caller's.
    """
    named = {"cost": cost, "data": data}
    given = dict(settings or {}) | {name: value for name, value in named.items() if value is not None}
    if resume is None:
        asked = new(_config_of(config, given), out, seeds)
    elif config is None and out is None:
        asked = going_on(Path(resume), given)
    else:
        raise ConfigError(f"resume={resume} goes on with a run; leave out config and out")
    asked = asked._replace(final=final, track=trackers.asked(track))
    with _precision_kept():
        start(asked, "pegasus_jax.train", lambda: mesh or _evenly(len(asked.runs)))
    return asked.home


def _config_of(config: Config | str | None, given: dict[str, Any]) -> Config:
    from pegasus_jax.runs import config_io

    if isinstance(config, Config):
        check_config(config)
        given = config_io.of_python(given)
        check_used(config.task, given)
        return config_io.override(config, config_io.values(config_io.without_random(given)))
    if config is not None and not isinstance(config, str):
        kind = type(config).__name__
        raise ConfigError(
            f"train takes a Config or the name of a preset, not a {kind}; run(compose(config, task)) learns one"
        )
    return preset(config or "cartpole", settings=given)


def new(config: Config, out: str | Path | None, seeds: int) -> Asked:
    """A new run, or one of each of so many seeds, from config.seed on. Raises ConfigError for more than can be."""
    from pegasus_jax.runs import store  # it imports NumPy, which a refused command does not wait for

    size("seeds", seeds)
    _one_environment(config, seeds)
    name = f"seed{config.seed}" if seeds == 1 else f"seeds{config.seed}-{config.seed + seeds - 1}"
    home = Path(out) if out is not None else store.free(Path(f"runs/{label(config)}-{name}"))
    every = range(config.seed, config.seed + seeds)
    return Asked(config, home, {config.seed: home} if seeds == 1 else {seed: home / f"seed{seed}" for seed in every})


def going_on(home: Path, changes: dict[str, Any]) -> Asked:
    """A run that goes on, or those of many seeds. Raises ConfigError for a setting with which it could not.

    A function, which from Python takes the place of one that nobody else can import, is the caller's word.
    """
    from pegasus_jax.runs import config_io, store
    from pegasus_jax.runs.removed import refuse

    if wrong := sorted(key for key, value in changes.items() if not (_changeable(key) or callable(value))):
        refuse(wrong[0])
        raise config_io.misspelt(wrong[0], ("out", "seeds")) or ConfigError(
            f"{wrong[0]} cannot be changed by resume=; only trials=, eval_episodes=, fit.*, search.* can, and mjcf= if"
            " the file was moved"
        )
    runs = store.seeds_of(home)
    first = store.existing(next(iter(runs.values()), home))
    mjcf = changes.pop("mjcf", None)
    configs = {
        run: config_io.override(config_io.load(run / "config.yaml"), config_io.values(changes))
        for run in runs.values() or [first]
    }
    config = configs[first]
    _alike(configs)
    check_used(config.task, changes)
    _one_environment(config, len(runs))
    return Asked(config, home, runs or {config.seed: home}, first, mjcf)


def _alike(configs: dict[Path, Config]) -> None:
    """Raises ConfigError where runs that are to go on together differ in more than their seeds."""
    (first, one), *others = configs.items()
    for run, other in others:
        wanted, found = leaves(replace(one, seed=other.seed)), leaves(other)
        for key in (key for key in found if found[key] != wanted.get(key)):
            raise ConfigError(
                f"{run} has {key}={shown(found[key])}, and {first} {shown(wanted.get(key))}; go on with each by itself,"
                f" for example resume={run}"
            )


def _changeable(key: str) -> bool:
    """Whether a run can go on with another value of this setting: what it has learned stays what it is."""
    return key in ("trials", "eval_episodes", "mjcf") or key.startswith(("fit.", "search."))


def _one_environment(config: Config, seeds: int) -> None:
    if seeds > 1 and config.env is not None:
        raise ConfigError(f"seeds={seeds} is too many for task={config.task}, whose environment is one object; seeds=1")


def start(asked: Asked, command: str, configure: Callable[[], Mesh]) -> None:
    """Learn what is asked for, and say so. `configure` makes the mesh of devices, before any code of the user runs."""
    from pegasus_jax.runs import display, store

    done = None if asked.resumed is None else len(store.readable_trials(asked.resumed)[0])
    store.enough(asked.config.trials, done or 0)
    print(display.announcement(asked.config, asked.home, len(asked.runs), done), flush=True)
    mesh = configure()
    from pegasus_jax.runs.programs import is_main_process
    from pegasus_jax.runs.train import train_seeds

    if is_main_process():
        print(display.devices(), flush=True)
    new = asked.resumed is None and is_main_process()
    if new:  # before a robot moves
        if store.seeds_of(asked.home):
            free = store.free(asked.home)
            raise ConfigError(f"out={asked.home} holds runs already; resume={asked.home} goes on, out={free} is free")
        for run in asked.runs.values():
            store.unused(run)
    config, logs = _checked(asked, mesh)
    if new:
        for run in asked.runs.values():
            store.create(run)
    told: dict[str, Any] = dict(command=command, final=asked.final, mesh=mesh, logs=logs)
    told |= dict(track=asked.track, draw=_pictures)
    train_seeds(config, asked.runs, resume=asked.resumed is not None, **told)
    if is_main_process():
        _summed_up(asked)


def _pictures(run: Path, task: Any, trial: int) -> Mapping[str, Path]:
    from pegasus_jax.viz.run_plots import trial_pictures

    return trial_pictures(run, task, trial)


def _checked(asked: Asked, mesh: Mesh) -> tuple[Config, Any]:
    """(the config with all that is known of its task, the logs of a new run).

    Impossible settings and logs end here, before anything is written.
    """
    from pegasus_jax.assembly.experiments import build, set_precision
    from pegasus_jax.runs import check, first, restore
    from pegasus_jax.tasks import resolve

    set_precision(asked.config)  # before anything is built
    if asked.resumed is not None:
        config = restore.moved(asked.resumed, asked.config, asked.mjcf)
        restore.announce(asked.resumed, config)
        build(config, mesh)
        return config, None
    config = first.found(resolve(asked.config))
    _, logs, notes = check.checked(asked.config, config, mesh)
    for note in notes:
        print(f"note: {note}", file=sys.stderr)
    return config, logs


def _summed_up(asked: Asked) -> None:
    """Say which policy is the best, and where it is."""
    from pegasus_jax.runs import display, restore, store

    for seed, run in asked.runs.items():
        told = restore.chosen(run, restore.BEST, restore.best(run))
        for line in filter(None, (display.limits_line(store.trials(run)), told)):
            print(f"seed {seed}: {line}" if len(asked.runs) > 1 else line)
    home, one = asked.home, next(iter(asked.runs.values()))
    print(f"done: {home} ({typed(['pegasus-report', str(home)])}, {typed(['pegasus-eval', str(one)])})")


def _evenly(seeds: int) -> Mesh:
    from pegasus_jax.sharding import evenly

    return evenly(seeds)


@contextmanager
def _precision_kept() -> Iterator[None]:
    """JAX's precision after the block is what it was before."""
    import jax

    names = ("jax_enable_x64", "jax_default_matmul_precision")
    before = {name: getattr(jax.config, name) for name in names}
    try:
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
