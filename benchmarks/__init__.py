"""Measurements; benchmarks/README.md says what each command measures."""

from pathlib import Path

RESULTS = Path(__file__).parent / "results"
