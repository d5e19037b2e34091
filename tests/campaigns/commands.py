"""Bad commands: python -m tests.campaigns.commands cases=400

Each must be refused in one line with exit status 2, or, where its words turn out to be fine, do its work.
"""

from __future__ import annotations

import shutil
from collections import Counter
from pathlib import Path
from typing import Any

from tests.campaigns import common
from tests.campaigns.command_kinds import BASE, Command, chosen
from tests.campaigns.common import RUN, Outcome

HERE = Path(__file__).parent
# What lies in the folder that a command works in, beside a run.
FILES = {
    "broken.py": "def cost(x)\n    return x[0]\n",
    "leaving.py": "import sys\nsys.exit(7)\n",
    "raising.py": "raise OSError('no such board\\nsecond line')\n",
    "empty.xml": "",
}


def judged(command: Command, ended: Outcome) -> str | None:
    """What is wrong with how a command ended, or None."""
    if ended.late:
        return "too long"
    if ended.traceback:
        return "traceback"
    if ended.status == 2:
        return None if ended.refusal or "pegasus-train task=NAME" in ended.out else "not one line"
    if ended.status == 0:
        return "not refused" if command.refused else None
    return "status"


def one(case: tuple[int, Command], folder: Path) -> dict[str, Any]:
    """One command in a folder of its own."""
    number, command = case
    home = folder / f"command{number}"
    shutil.copytree(folder / "home", home)
    command = Command(*command)
    ended = common.command(command.name, *command.words, cwd=home, limit=command.limit)
    wrong = judged(command, ended)
    shutil.rmtree(home)
    words = [word for word in command.words if word not in BASE]
    words = " ".join(word if len(word) < 60 else f"{word[:40]}... ({len(word)} letters)" for word in words)
    told = [f"{command.name} {words}: {wrong} (status {ended.status}; {common.last_line(ended.err)})"] if wrong else []
    return {"wrong": wrong, "status": ended.status, "problems": told}


WRONG = ("traceback", "not one line", "status", "not refused", "too long")


def run(folder: Path, cases: int, seed: int, jobs: int) -> dict[str, Any]:
    """`cases` bad commands, drawn."""
    common.load()
    home = folder / "home"
    if not (home / "run" / "config.yaml").exists():
        home.mkdir(exist_ok=True)
        for name in ("robots.py", "faults.py"):
            shutil.copy(HERE / name, home / name)
        for name, text in FILES.items():
            (home / name).write_text(text)
        ended = common.command("pegasus-train", *RUN, "out=run", cwd=home, limit=300)
        assert not ended.status, ended.err
    commands = [command for command in chosen(cases, seed) if common.entry(command.name) is not None]
    rows = common.shared(list(enumerate(commands)), lambda case: one(case, folder), jobs)
    ends, found = Counter(row["status"] for row in rows), Counter(row["wrong"] for row in rows)
    figures = {"bad commands": len(rows), "refused": ends[2], "whose words were fine": ends[0]}
    figures |= {what: found[what] for what in WRONG}
    return {"figures": figures, "problems": [problem for row in rows for problem in row["problems"]]}


if __name__ == "__main__":
    common.campaign("commands", run, cases=400)
