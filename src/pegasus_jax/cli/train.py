"""pegasus-train and pegasus-check: from words to a run."""

import math
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from pegasus_jax.checks import ConfigError, whole
from pegasus_jax.config import Config, Search, label

OPTIONS = (
    "out",
    "resume",
    "final",
    "seeds",
    "mesh",
    "distributed",
    "coordinator",
    "processes",
    "process",
)  # of pegasus-train

begun: list[Path] = []  # the folder of what this process learns, for whoever stops it


class Asked(NamedTuple):
    """What a command line asks for."""

    config: Config
    home: Path  # the run's folder, or that of the runs of many seeds
    runs: dict[int, Path]  # seed -> folder
    options: dict[str, str]
    resumed: Path | None  # of a run that goes on, its folder, or the first one's
    given: bool  # whether it says where episodes start, so that nobody resets a robot to find out


def train(words: Sequence[str]) -> None:
    """pegasus-train."""
    asked = understood(words)
    begun.append(asked.home)
    over = _configured(asked)
    config = _checked(asked, over)
    from pegasus_jax.runs import store
    from pegasus_jax.runs.programs import is_main_process
    from pegasus_jax.runs.train import train_seeds

    if asked.resumed is None and is_main_process():
        if store.seeds_of(asked.home):
            free = store.free(asked.home)
            raise ConfigError(f"out={asked.home} holds runs already; resume={asked.home} goes on, out={free} is free")
        for run in asked.runs.values():
            store.create(run)
    train_seeds(
        config,
        asked.runs,
        resume=asked.resumed is not None,
        command=shlex.join(["pegasus-train", *words]),
        final=asked.options.get("final") == "true",
        mesh=over,
    )
    if is_main_process():
        _summed_up(asked)


def understood(words: Sequence[str]) -> Asked:
    """What the words ask for. Raises ConfigError for what cannot be; nothing of the user's is imported for that."""
    from pegasus_jax.runs import config_io

    options, rest = config_io.split(words, OPTIONS)
    for name in ("out", "resume"):
        if options.get(name) == "":
            raise ConfigError(f"{name}= names no folder; for example {name}=runs/demo")
    asked = _resumed(options, rest) if "resume" in options else _new(options, rest)
    if len(asked.runs) > 1 and asked.config.env is not None:
        task = asked.config.task
        raise ConfigError(
            f"seeds={len(asked.runs)} is too many for task={task}, whose environment is one object; seeds=1"
        )
    if options.get("final", "false") not in ("true", "false"):
        raise ConfigError(f"final={options['final']} is neither true nor false")
    return asked


def _resumed(options: dict[str, str], rest: dict[str, str]) -> Asked:
    from pegasus_jax.runs import config_io, store

    free = {"resume", "final", "mesh", "distributed", "coordinator", "processes", "process"}
    if wrong := sorted(key for key in {*rest, *options} - free if not _changeable(key)):
        raise ConfigError(
            f"{wrong[0]} cannot be changed by resume=; only trials=, eval_episodes=, fit.*, search.* can, and mjcf= if"
            " the file was moved"
        )
    home = Path(options["resume"])
    runs = store.seeds_of(home)
    first = store.existing(next(iter(runs.values()), home))
    moved = {"mjcf": rest.pop("mjcf")} if "mjcf" in rest else {}
    config = config_io.override(config_io.load(first / "config.yaml"), config_io.values(rest))
    return Asked(config, home, runs or {config.seed: home}, options | moved, first, True)


def _new(options: dict[str, str], rest: dict[str, str]) -> Asked:
    from pegasus_jax.runs import config_io

    config = config_io.parse(rest, options=OPTIONS)
    from pegasus_jax.runs import store  # it imports NumPy, which a refused command does not wait for

    seeds = range(config.seed, config.seed + whole("seeds", options.get("seeds", "1")))
    name = f"seed{seeds[0]}" if len(seeds) == 1 else f"seeds{seeds[0]}-{seeds[-1]}"
    home = Path(options["out"]) if "out" in options else store.free(Path(f"runs/{label(config)}-{name}"))
    runs = {config.seed: home} if len(seeds) == 1 else {seed: home / f"seed{seed}" for seed in seeds}
    return Asked(config, home, runs, options, None, "start_mean" in rest)


def _configured(asked: Asked) -> Any:
    """The mesh of devices. JAX is configured here, before any of the user's code, which may use it when imported."""
    from pegasus_jax.runs import display, store

    config, options = asked.config, asked.options
    done = None if asked.resumed is None else len(store.readable_trials(asked.resumed)[0])
    print(display.announcement(config, asked.home, len(asked.runs), done), flush=True)
    _join(options)
    from pegasus_jax.runs.programs import is_main_process, share_processors

    if not {"mesh", "distributed", "coordinator"} & {*options}:
        search = config.search
        particles = search.particles * search.num_starts if isinstance(search, Search) else None
        share_processors(len(asked.runs), particles)
    over = _mesh(options.get("mesh"), len(asked.runs))
    if is_main_process():
        print(display.devices(), flush=True)
    return over


def _checked(asked: Asked, over: Any) -> Config:
    """The config with all that is known of its task. Impossible settings end here, before anything is written."""
    from pegasus_jax.assembly.experiments import build
    from pegasus_jax.runs import restore
    from pegasus_jax.runs.check import RESETS, before_training, circles_found
    from pegasus_jax.tasks import resolve

    if asked.resumed is not None:
        config = restore.moved(asked.resumed, asked.config, asked.options.get("mjcf"))
        restore.announce(asked.resumed, config)
        build(replace(config, seed=0), over)
        return config
    config = resolve(asked.config)
    task = build(replace(config, seed=0), over).task
    for note in circles_found(asked.config, config) + before_training(config, task, 1 if asked.given else RESETS):
        print(f"note: {note}", file=sys.stderr)
    return config


def _summed_up(asked: Asked) -> None:
    """Say which policy is the best, and where it is."""
    from pegasus_jax.runs import display, restore, store

    for seed, run in asked.runs.items():
        told = display.best_line(store.trials(run), restore.best(run))
        print(f"seed {seed}: {told}" if len(asked.runs) > 1 else told)
    home = asked.home
    print(f"done: {home} (pegasus-plot {home}, pegasus-eval {next(iter(asked.runs.values()))})")


def check(words: Sequence[str]) -> None:
    from pegasus_jax.runs import config_io

    options, rest = config_io.split(words, OPTIONS)
    if "resume" in options:
        raise ConfigError(f"resume={options['resume']} was checked when it began; give the words of a new run")
    config = config_io.parse(rest, options=OPTIONS)
    from pegasus_jax.runs.check import report

    print("\n".join(report(config)))


def _changeable(key: str) -> bool:
    """Whether a run can go on with another value of this setting: what it has learned stays what it is."""
    return key in ("trials", "eval_episodes", "mjcf") or key.startswith(("fit.", "search."))


def _join(options: dict[str, str]) -> None:
    """Join the other processes of a study, if there are any, through jax.distributed."""
    import jax

    given = {name for name in ("coordinator", "processes", "process") if name in options}
    if not given and options.get("distributed", "false") == "false":
        return
    if given and len(given) < 3:
        raise ConfigError("coordinator=HOST:PORT, processes=N and process=I (from 0) go together")
    if options.get("distributed", "true") != "true":
        raise ConfigError(f"distributed={options['distributed']} is neither true nor false")
    try:
        if given:
            count, index = (whole(name, options[name]) for name in ("processes", "process"))
            jax.distributed.initialize(options["coordinator"], count, index)
        else:
            jax.distributed.initialize()  # SLURM, Open MPI and others say where the coordinator is
    except (RuntimeError, ValueError) as error:
        raise ConfigError(f"distributed=true: {str(error).splitlines()[0]}; or give coordinator=HOST:PORT") from error


def _mesh(text: str | None, seeds: int) -> Any:
    """The mesh that mesh=SEEDSxPARTICLES asks for; by default as many devices as share the seeds evenly."""

    from pegasus_jax.sharding import evenly, mesh

    if text is None:
        return evenly(seeds)
    first, cross, second = text.partition("x")
    if not (cross and first.isdecimal() and second.isdecimal() and int(first) and int(second)):
        raise ConfigError(f"mesh={text} is not of the form SEEDSxPARTICLES; for example mesh=4x1")
    if seeds % int(first):
        raise ConfigError(f"mesh={text} cannot share {seeds} seeds evenly; mesh={math.gcd(seeds, int(first))}x{second}")
    try:
        return mesh(int(first), int(second))
    except ValueError as error:
        raise ConfigError(f"mesh={text} {error}") from error
