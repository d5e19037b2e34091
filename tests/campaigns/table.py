"""Prints the table of docs/reliability.md from benchmarks/results/campaign-*.json: python -m tests.campaigns.table

A campaign's words out=benchmarks/results/campaign-NAME.json replace its figures.
"""

from __future__ import annotations

import json
from typing import Any

from tests.campaigns.common import RESULTS

HEAD = "| campaign | |\n|---|---|"
ORDER = ("kills", "damages", "commands", "stops")


def rows(result: dict[str, Any]) -> list[str]:
    """One campaign's lines of the table: its command, then what it counted."""
    head = f"| **`{result['command']}`**, {result['minutes']} minutes | |"
    return [head, *(f"| {what} | {value} |" for what, value in result["figures"].items())]


def table() -> str:
    """The whole table, of the campaigns that have left their results."""
    files = [path for name in ORDER if (path := RESULTS / f"campaign-{name}.json").exists()]
    lines = [line for path in files for line in rows(json.loads(path.read_text()))]
    return "\n".join([HEAD, *lines])


if __name__ == "__main__":
    print(table())
