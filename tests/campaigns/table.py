"""Prints the table of docs/reliability.md from benchmarks/results/campaign-*.json: python -m tests.campaigns.table"""

from __future__ import annotations

import json
from typing import Any

from tests.campaigns.common import RESULTS

HEAD = "| campaign | measured | |\n|---|---|---|"


def rows(name: str, result: dict[str, Any]) -> str:
    """One campaign's lines of the table."""
    lines = [f"| {name} | {what} | {value} |" for what, value in result["figures"].items()]
    return "\n".join(lines)


def table() -> str:
    """The whole table, and the commands that made it."""
    results = {path.stem.removeprefix("campaign-"): json.loads(path.read_text()) for path in files()}
    made = [f"    {result['command']}    # {result['minutes']} minutes" for result in results.values()]
    return "\n".join([HEAD, *(rows(name, result) for name, result in results.items()), "", *made])


def files() -> list[Any]:
    """The results that there are."""
    return sorted(RESULTS.glob("campaign-*.json"))


if __name__ == "__main__":
    print(table())
