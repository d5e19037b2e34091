"""Measurements; benchmarks/README.md says what each command measures."""

from pathlib import Path

RESULTS = Path(__file__).parent / "results"


def once(*words: object) -> list[str]:
    """The words of a command, which takes each once: of those that are there twice the last."""
    return list({word.partition("=")[0]: word for word in map(str, words)}.values())
