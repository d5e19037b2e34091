"""Hold one run of the suite against a stored one, by ratios to the matrix products of the same process.

    python -m benchmarks.speed.compare NEW.json [STORED.json]

Fails when a row that both have has become slower by more than LIMIT, or when they have none in common. A quick run may
be held against a full one. Both must have been made with as many CPUs.
"""

from pathlib import Path
from typing import Any

from benchmarks import RESULTS, command, written
from pegasus_jax.checks import ConfigError

STORED = RESULTS / "speed.json"
LIMIT = 1.3

Rows = dict[str, dict[str, Any]]


def ratios(new: Rows, stored: Rows) -> dict[str, float]:
    """How many times slower each row that both runs have has become, machine speed taken out."""
    shared = [name for name in stored if "of_matmul" in stored[name] and "of_matmul" in new.get(name, {})]
    return {name: new[name]["of_matmul"] / stored[name]["of_matmul"] for name in shared}


def read(path: str | Path) -> dict[str, Any]:
    """A run of the suite. Raises ConfigError for another file."""
    return written(path, "speed.suite", lambda run: {"rows": dict(run["rows"]), "about": dict(run["about"])})


def main(words: list[str]) -> int:
    """The command line of this module; the exit code. Raises ConfigError for what it cannot use."""
    if len(words) not in (1, 2):
        raise ConfigError(f"name a run of the suite, and at most one to hold it against, not {len(words)} files")
    new, stored = map(read, [*words, STORED][:2])
    here, there = (run["about"].get("processor") for run in (new, stored))
    if here and there and here != there:
        print(f"made on {here}, held against a run on {there}: their vectors and caches may differ too")
    found = ratios(new["rows"], stored["rows"])
    if not found:
        print("the two runs have no row in common")
        return 1
    for name, ratio in found.items():
        print(f"{name:40s} {ratio:6.2f} {'slower than ' + str(LIMIT) if ratio > LIMIT else ''}".rstrip())
    return int(max(found.values()) > LIMIT)


if __name__ == "__main__":
    command(main, __doc__)
