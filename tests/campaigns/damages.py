"""Damaged run folders: python -m tests.campaigns.damages cases=200

A run that has its last trial still to learn from (episode 3 is there, checkpoint 3 is not) is damaged in one way, and
pegasus-eval, pegasus-plot and pegasus-train resume= are called. Each must work, or refuse in one line that names what
is wrong; a resume that works must end as that of the whole run.
"""

from __future__ import annotations

import json
import random
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

from tests.campaigns import common
from tests.campaigns.common import RUN, Outcome
from tests.campaigns.damage_kinds import DAMAGES, Damage
from tests.campaigns.kills import fingerprint, rows_of

COMMANDS = ("eval", "plot", "resume")


def made(folder: Path) -> None:
    """The run that damages are done to, `base`, and how it ends, `end`."""
    if not (folder / "base" / "config.yaml").exists():
        ended = common.command("pegasus-train", *RUN, "out=base", cwd=folder, limit=300)
        assert not ended.status, ended.err
    if not (folder / "end").exists():
        ended = common.command("pegasus-plot", "base", cwd=folder)
        assert not ended.status, ended.err
        shutil.copytree(folder / "base", folder / "end", dirs_exist_ok=True)
        for path in (folder / "base" / "checkpoints").glob("0003*"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        rows = (folder / "base" / "trials.jsonl").read_text().splitlines(keepends=True)
        (folder / "base" / "trials.jsonl").write_text("".join(rows[:2]))
        prints = [fingerprint(folder / name) for name in ("base", "end")]
        (folder / "fingerprints").write_text(json.dumps(prints))


def called(what: str, run: Path) -> Outcome:
    """One of the commands on the damaged run."""
    if what == "resume":
        return common.command("pegasus-train", f"resume={run.name}", cwd=run.parent)
    return common.command(
        f"pegasus-{what}", run.name, *(["trial=last", "episodes=1"] if what == "eval" else []), cwd=run.parent
    )


def names_it(damage: Damage, line: str) -> bool:
    """Whether a refusal says which file is damaged, or for a checkpoint, of which trial it is."""
    return Path(damage.path).name in line or damage.path.split("/")[0] in line


def judged(damage: Damage, run: Path, what: str, ended: Outcome, right: str) -> str | None:
    """What is wrong with how a command ended, or None."""
    if ended.traceback or ended.late:
        return "traceback" if ended.traceback else "too long"
    if ended.status not in (0, 2):
        return "status"
    if ended.status == 2:
        if ended.refusal is None:
            return "not one line"
        return None if names_it(damage, ended.refusal) else "damage not named"
    if what != "resume" or damage.other_end:
        return None
    if fingerprint(run) != right:
        return "different end"
    said = names_it(damage, ended.err + ended.out) or "trials.jsonl" in ended.err + ended.out
    rows, right_rows = (rows_of(run) if (run / "trials.jsonl").is_file() else []), rows_of(run.parent.parent / "end")
    if damage.path == "trials.jsonl" and "bit flipped" in damage.how:  # another digit is a number too
        rows, right_rows = ([row.get("trial") for row in table] for table in (rows, right_rows))
    return None if said or rows == right_rows else "trials.jsonl lost rows or differs"


def one(case: tuple[int, Damage], folder: Path, right: str) -> dict[str, Any]:
    """Damage a copy of the run, call the commands on copies of it, judge."""
    number, damage = case
    home, found, problems = folder / f"case{number}", Counter(), []
    for what in COMMANDS:
        run = home / "run"
        shutil.rmtree(home, ignore_errors=True)
        shutil.copytree(folder / "base", run)
        damage.do(run)
        ended = called(what, run)
        wrong = judged(damage, run, what, ended, right)
        found["refused" if ended.status == 2 else "went on"] += 1
        if damage.outside(home):
            wrong = "file outside the run changed"
        if wrong:
            found[wrong] += 1
            line = common.last_line(ended.err)
            problems.append(f"{damage.path}, {damage.how}: {what}: {wrong} (status {ended.status}; {line})")
    shutil.rmtree(home, ignore_errors=True)
    return {"found": found, "problems": problems}


WRONG = (
    "traceback",
    "too long",
    "status",
    "not one line",
    "damage not named",
    "different end",
    "trials.jsonl lost rows or differs",
    "file outside the run changed",
)


def run(folder: Path, cases: int, seed: int, jobs: int) -> dict[str, Any]:
    """`cases` damages, drawn from all without repetition."""
    common.load()
    made(folder)
    _, right = json.loads((folder / "fingerprints").read_text())
    drawn = random.Random(seed).sample(DAMAGES, min(cases, len(DAMAGES)))
    rows = common.shared(list(enumerate(drawn)), lambda case: one(case, folder, right), jobs)
    found = sum((Counter(row["found"]) for row in rows), Counter())
    figures = {"damages": len(rows), "commands on them": len(rows) * len(COMMANDS)}
    figures |= {f"commands that {what}": found[key] for what, key in (("refused", "refused"), ("went on", "went on"))}
    figures |= {what: found[what] for what in WRONG}
    return {"figures": figures, "problems": [problem for row in rows for problem in row["problems"]]}


if __name__ == "__main__":
    common.campaign("damages", run, cases=200)
