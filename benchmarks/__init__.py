"""Measurements; benchmarks/README.md says what each command measures."""

from pathlib import Path

from pegasus_jax.checks import ConfigError

RESULTS = Path(__file__).parent / "results"


def once(*words: object) -> list[str]:
    """The words of a command, which takes each once: of those that are there twice the last."""
    return list({word.partition("=")[0]: word for word in map(str, words)}.values())


def beside_runs(out: str) -> tuple[Path, Path]:
    """(file of the results, folder of the runs that they are of). Raises ConfigError unless `out` ends in .json."""
    path = Path(out).absolute()
    if path.suffix != ".json":
        raise ConfigError(f"out={out} is a folder's name; expected that of a file: out={out}.json")
    return path, path.with_suffix("")
