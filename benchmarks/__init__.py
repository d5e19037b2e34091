"""Measurements; benchmarks/README.md says what each command measures."""

import sys
from collections.abc import Callable
from pathlib import Path

from pegasus_jax.checks import ConfigError, RunError
from pegasus_jax.cli import help

RESULTS = Path(__file__).parent / "results"


def command(main: Callable[[list[str]], int | None], what: str | None) -> None:
    """Run a benchmark with the words of its command line; `--help` prints `what`, the docstring of its module.

    What cannot be run is one line and the exit status 1.
    """
    words = sys.argv[1:]
    try:
        if help.asked(words):
            print(what)
            return
        status = main(words)
    except (ConfigError, RunError) as error:
        sys.exit(f"{_name(Path(sys.argv[0]))}: {error}")
    if status:
        sys.exit(status)


def _name(file: Path) -> str:
    return file.parent.name if file.stem in ("__main__", "__init__") else file.stem


def named(words: list[str], what: str) -> tuple[str, list[str]]:
    """The first word of a command, which names something, and the others. Raises ConfigError where it does not."""
    if not words or "=" in words[0]:
        raise ConfigError(f"the first word is missing; expected {what}")
    return words[0], words[1:]


def once(*words: object) -> list[str]:
    """The words of a command, which takes each once: of those that are there twice the last."""
    return list({word.partition("=")[0]: word for word in map(str, words)}.values())


def beside_runs(out: str) -> tuple[Path, Path]:
    """(file of the results, folder of the runs that they are of). Raises ConfigError unless `out` ends in .json."""
    path = Path(out).absolute()
    if path.suffix != ".json":
        raise ConfigError(f"out={out} is a folder's name; expected that of a file: out={out}.json")
    return path, path.with_suffix("")
