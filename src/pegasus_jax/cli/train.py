"""pegasus-train and pegasus-check: from words to a run."""

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pegasus_jax import start
from pegasus_jax.checks import ConfigError, true, whole
from pegasus_jax.cli.words import NEW
from pegasus_jax.cli.words import OPTIONS as WORDS
from pegasus_jax.config import Search
from pegasus_jax.runs import trackers
from pegasus_jax.start import Asked

OPTIONS = tuple(WORDS)  # words that are no settings
TOGETHER = {"coordinator", "processes", "process"}  # options, all or none

begun: list[Path] = []  # the folder of what this process learns, for whoever stops it


def train(words: Sequence[str]) -> None:
    """pegasus-train."""
    asked, options = understood(words)
    begun.append(asked.home)
    start.start(asked, shlex.join(["pegasus-train", *words]), lambda: _configured(asked, options))


def understood(words: Sequence[str]) -> tuple[Asked, dict[str, str]]:
    """What the words ask for, and the options. Raises ConfigError for what cannot be; imports nothing of the user's."""
    from pegasus_jax.runs import config_io

    options, rest = config_io.split(words, OPTIONS)
    for name in ("out", "resume"):
        if options.get(name) == "":
            raise ConfigError(f"{name}= names no folder; for example {name}=runs/demo")
    if "resume" in options:
        asked = start.going_on(Path(options["resume"]), {**rest, **{n: options[n] for n in NEW if n in options}})
        return _settled(asked, options), options
    return new(options, rest, OPTIONS), options


def new(options: Mapping[str, str], settings: Mapping[str, str], known: Sequence[str]) -> Asked:
    """The new run, or runs, that options and settings ask for; `known` are the options that a message may name.

    Raises ConfigError for what cannot be.
    """
    from pegasus_jax.runs import config_io

    config = config_io.parse(settings, options=known)
    return _settled(start.new(config, options.get("out"), whole("seeds", options.get("seeds", "1"))), options)


def _settled(asked: Asked, options: Mapping[str, str]) -> Asked:
    """What is asked for, with the options of any run. Raises ConfigError for what they cannot be; opens no device."""
    final = true("final", options.get("final", "false"))
    if "mesh" in options:
        _shape(options["mesh"], len(asked.runs))
    if (given := TOGETHER & {*options}) and given != TOGETHER:
        raise ConfigError("coordinator=HOST:PORT, processes=N and process=I (from 0) go together")
    return asked._replace(final=final, track=trackers.asked(options.get("track")))


def _configured(asked: Asked, options: dict[str, str]) -> Any:
    """The mesh of devices. JAX is configured here, before any of the user's code, which may use it when imported."""
    _join(options)
    from pegasus_jax.runs.programs import share_cpus

    if not {"mesh", "distributed", "coordinator"} & {*options}:
        search = asked.config.search
        particles = search.particles * search.num_starts if isinstance(search, Search) else None
        share_cpus(len(asked.runs), particles)
    return _mesh(options.get("mesh"), len(asked.runs))


def check(words: Sequence[str]) -> None:
    from pegasus_jax.runs import config_io

    options, _ = config_io.split(words, OPTIONS)
    if "resume" in options:
        raise ConfigError(f"resume={options['resume']} was checked when it began; give the settings of a new run")
    asked, _ = understood(words)
    from pegasus_jax.runs.check import report

    print("\n".join(report(asked.config)))


def _join(options: dict[str, str]) -> None:
    """Join the other processes of a study, if there are any, through jax.distributed."""
    import jax

    given = TOGETHER & {*options}
    if not (true("distributed", options.get("distributed", "false")) or given):
        return
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
    shape = _shape(text, seeds)
    try:
        return mesh(*shape)
    except ValueError as error:
        raise ConfigError(f"mesh={text} {error}") from error


def _shape(text: str, seeds: int) -> tuple[int, int]:
    """The two numbers of mesh=SEEDSxPARTICLES. Raises ConfigError where they are none, or cannot share the seeds."""
    first, cross, second = text.partition("x")
    if not (cross and first.isdecimal() and second.isdecimal() and int(first) and int(second)):
        raise ConfigError(f"mesh={text} is not of the form SEEDSxPARTICLES; for example mesh=4x1")
    if seeds % int(first):
        raise ConfigError(
            f"mesh={text} cannot share {seeds} seeds evenly; give mesh={math.gcd(seeds, int(first))}x{second}"
        )
    return int(first), int(second)
