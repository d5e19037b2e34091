"""A few cases of two campaigns (make test-slow), all of each (make campaigns), and that each can fail."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from tests.campaigns import commands, common, damages, kills, stops, table
from tests.campaigns.command_kinds import Command
from tests.campaigns.common import ROOT, Outcome
from tests.campaigns.damage_kinds import DAMAGES, Damage, gone

SHORT = {"commands": 12, "stops": 2}  # of kills and damages other slow tests have a few
LONG = {"kills": 1000, "damages": 200, "commands": 400, "stops": 100}
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked, and watched through /proc")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One for all campaigns, so that programs are compiled once."""
    return tmp_path_factory.mktemp("campaigns")


def result(name: str, cases: int, folder: Path) -> dict[str, Any]:
    """A campaign's JSON; it fails with what the campaign found."""
    if name == "kills" and not shutil.which("cc"):
        pytest.skip("no C compiler")
    out = folder / f"{name}.json"
    words = [f"cases={cases}", f"folder={folder}", f"out={out}"]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    program = [sys.executable, "-m", f"tests.campaigns.{name}", *words]
    ended = subprocess.run(program, cwd=folder, env=env, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return json.loads(out.read_text())


@pytest.mark.slow
@pytest.mark.parametrize("name", SHORT)
def test_short(name: str, folder: Path) -> None:
    assert result(name, SHORT[name], folder)["problems"] == []


@pytest.mark.campaign
@pytest.mark.parametrize("name", LONG)
def test_long(name: str, folder: Path) -> None:
    assert result(name, LONG[name], folder)["problems"] == []


def ended(status: int, err: str = "", out: str = "") -> Outcome:
    return Outcome(status, out, err, 1.0, False)


def test_a_refusal_is_one_line_at_the_end() -> None:
    assert ended(2, "pegasus: no\n").refusal == "pegasus: no"
    assert ended(2, "trial 1/3 ...\npegasus: no\n").refusal == "pegasus: no"
    assert ended(2, "pegasus: no\nand more\n").refusal is None
    assert ended(2, "pegasus: no\npegasus: no\n").refusal is None
    assert ended(1, "pegasus: no\n").refusal is None


@pytest.mark.parametrize(
    ("outcome", "wrong"),
    [
        (ended(2, "pegasus: no"), None),
        (ended(0), "not refused"),
        (ended(7), "status"),
        (ended(2, "no"), "not one line"),
        (ended(1, "Traceback (most recent call last):\nValueError"), "traceback"),
        (Outcome(-9, "", "", 90.0, True), "too long"),
    ],
)
def test_bad_commands_can_fail(outcome: Outcome, wrong: str | None) -> None:
    assert commands.judged(Command("pegasus-train", (), refused=True), outcome) == wrong


def test_damages_can_fail(tmp_path: Path) -> None:
    damage = Damage("episodes/0003.npz", "deleted", gone)
    named, other = ended(2, "pegasus: episodes/0003.npz is gone"), ended(2, "pegasus: something is gone")
    assert damages.judged(damage, tmp_path, "plot", named, "") is None
    assert damages.judged(damage, tmp_path, "plot", other, "") == "damage not named"
    assert damages.judged(damage, tmp_path, "plot", ended(1), "") == "status"
    assert len({(damage.path, damage.how) for damage in DAMAGES}) == len(DAMAGES) >= 200


def test_a_lost_episode_and_a_temporary_file_are_seen(tmp_path: Path) -> None:
    (tmp_path / "episodes").mkdir()
    (tmp_path / "episodes" / "0001.npz").write_bytes(b"1")
    before = kills.episodes(tmp_path)
    (tmp_path / "episodes" / ".0002.npz.abc").touch()
    (tmp_path / ".lock").touch()
    assert kills.leftovers(tmp_path) == ["episodes/.0002.npz.abc"]
    os.utime(tmp_path / "episodes" / "0001.npz", ns=(1, 1))
    assert kills.episodes(tmp_path) != before


def test_a_stop_can_fail(tmp_path: Path) -> None:
    case = stops.Case(0, "SIGTERM", "search", "Arm", 20)
    calls = "1 open True\n2 step True\n2.1 stepped True\n3.2 step True\n4.5 close True\n5 close True\n"
    (tmp_path / "robot.log").write_text(calls)
    latency, wrong = stops.judged(case, tmp_path, {"sent": 3.0, "status": 1, "out": "", "err": ""})
    assert latency == 1.5
    assert wrong == ["closed 2 times", "close too late", "controls after the stop", "exit status"]


def test_the_documented_table_is_that_of_the_results() -> None:
    """Figures in docs/reliability.md are those of the JSON files, once there are any."""
    page = (ROOT / "docs" / "reliability.md").read_text()
    assert table.HEAD in page
    assert table.table() in page


@pytest.mark.parametrize("words", [[], ["out=figures.json"]])
def test_figures_are_written_only_where_they_are_asked_for(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A short campaign once replaced the documented figures."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["kills", "cases=1", *words])
    monkeypatch.setattr(common, "prepare", lambda folder: None)
    monkeypatch.setattr(common, "RESULTS", tmp_path)
    with pytest.raises(SystemExit):
        common.campaign("kills", lambda folder, **chosen: {"figures": {}, "problems": []}, 1000)
    assert [path.name for path in tmp_path.iterdir()] == [word.split("=")[1] for word in words]


@pytest.mark.slow
def test_a_child_ends_as_its_command_does() -> None:
    assert common.forked(lambda: sys.exit(3), 10).status == 3
    assert common.forked(lambda: print("said"), 10).out == "said\n"
    assert common.forked(lambda: 1 / 0, 10).traceback
    assert common.forked(lambda: time.sleep(60), 0.1).late
