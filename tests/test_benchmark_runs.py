"""The benchmarks that start many runs: what a file has is kept, and is of the settings that were asked for."""

import json
import os
import time
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from benchmarks import each, study, unfinished
from benchmarks.plants_suite import __main__ as suite
from benchmarks.plants_suite import native
from benchmarks.robot import costs, limits, logs, seeds, sensors, transfer
from benchmarks.speed import newcomer
from pegasus_jax.checks import ConfigError, RunError


@pytest.fixture
def learned(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """The plants and seeds that the suite would have learned."""
    begun: list[tuple[str, int]] = []

    def one(name: str, seed: int, *_: Any) -> dict[str, Any]:
        begun.append((name, seed))
        return {"plant": name, "seed": seed, "seconds": 0.0, "error": None, "trials": []}

    monkeypatch.setattr(suite, "one", one)
    return begun


def runs(out: Path) -> set[tuple[str, int]]:
    return {(run["plant"], run["seed"]) for run in json.loads(out.read_text())["runs"]}


def test_runs_of_other_settings_are_not_shown_as_those_that_were_asked_for(learned: Any, tmp_path: Path) -> None:
    """A run that goes on keeps its settings: model=gp was once answered with the runs of another model."""
    out, words = tmp_path / "suite.json", ["plants=[Car]", "seeds=100-101", f"out={tmp_path}/suite.json"]
    suite.main(words)
    before = out.read_bytes()
    with pytest.raises(ConfigError, match=r"has runs of other settings, none; expected those, or another out="):
        suite.main([*words, "model=gp"])
    assert out.read_bytes() == before
    assert len(learned) == 2
    suite.main([*words, "jobs=1", "minutes=1"])  # the same settings go on
    assert len(learned) == 4


def test_the_runs_of_other_plants_and_seeds_stay_in_the_file(learned: Any, tmp_path: Path) -> None:
    out = tmp_path / "suite.json"
    for plant, seed in (("Car", 100), ("Quadrotor", 101)):
        suite.main([f"plants=[{plant}]", f"seeds={seed}", f"out={out}"])
    assert runs(out) == {("Car", 100), ("Quadrotor", 101)}


def test_a_file_of_something_else_is_not_written_over(learned: Any, tmp_path: Path) -> None:
    out = tmp_path / "mine.json"
    out.write_text('{"name": "mine"}')
    robot = tmp_path / "robot.py"
    robot.touch()
    for main, words in (
        (suite.main, ["plants=[Car]", "seeds=100"]),
        (limits.main, [f"furuta={tmp_path}", "seeds=100"]),
        (logs.main, [f"furuta={tmp_path}", "seeds=100"]),
        (sensors.main, ["furuta", f"furuta={tmp_path}", "seeds=100"]),
        (sensors.main, ["cartpole", "seeds=100"]),
        (costs.main, ["plain", "seeds=100"]),
        (transfer.main, ["seeds=100"]),
    ):
        with pytest.raises(ConfigError, match=r"mine\.json"):
            main([*words, f"out={out}"])
        assert out.read_text() == '{"name": "mine"}'
    assert not learned


def test_after_ctrl_c_no_further_run_begins() -> None:
    begun = []

    def run(number: int) -> int:
        begun.append(number)
        if number == 1:
            raise KeyboardInterrupt
        time.sleep(0.1)
        return number

    found = each(2, [partial(run, number) for number in range(40)])
    with pytest.raises(KeyboardInterrupt):
        list(found)
    assert len(begun) < 10


def test_ctrl_c_ends_the_suite_and_judges_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The children of a terminal get it too, and end with 130: the runs that wait were once begun, one by one."""
    monkeypatch.setattr(suite, "PROGRAM", ["sh", "-c", "echo begun >> $0/begun; sleep 0.2; exit 130", str(tmp_path)])
    with pytest.raises(KeyboardInterrupt):
        suite.main(["plants=[Car]", "seeds=100-119", "jobs=1", f"out={tmp_path}/suite.json"])
    assert (tmp_path / "begun").read_text().count("begun") <= 2
    assert not (tmp_path / "suite.json").exists()


def test_more_trials_of_the_same_settings_go_on(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    given: list[list[str]] = []
    monkeypatch.setattr(seeds, "one", lambda run, words, seed, *_: given.append(words) or {"seed": seed, "trials": []})
    options = {"out": f"{tmp_path}/logs.json", "seeds": "101"}
    seeds.learned(options | {"trials": "3"}, ["task=gym", "model=gp"], "")
    seeds.learned(options | {"trials": "5", "seeds": "100"}, ["task=gym", "model=gp"], "")
    assert [words[-1] for words in given] == ["trials=3", "trials=5"]
    assert [run["seed"] for run in json.loads((tmp_path / "logs.json").read_text())["runs"]] == [100, 101]
    with pytest.raises(ConfigError, match="has runs of other settings, model=gp task=gym;"):
        seeds.learned(options | {"trials": "5"}, ["task=gym"], "")


@pytest.mark.parametrize("words", [["seeds=1"], ["seeds=0", "trials=2"], ["seeds=0", "model.hidden=[9]"]])
def test_a_transfer_of_other_seeds_or_settings_is_not_shown_as_the_one_asked_for(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def transferred(config: Any, seeds: Any, old: Any, keep: Any) -> None:
        keep([dict.fromkeys(transfer.KEPT, 0.5) for _ in seeds])

    monkeypatch.setattr(transfer, "transferred", transferred)
    monkeypatch.setattr(transfer, "share_cpus", lambda seeds: None)  # JAX has begun
    given = ["ways=[none]", f"out={tmp_path}/found.json"]
    transfer.main([*given, "seeds=0"])
    before = (tmp_path / "found.json").read_bytes()
    transfer.main([*given, "seeds=0"])
    with pytest.raises(ConfigError, match="has none off=low with another "):
        transfer.main([*given, *words])
    assert (tmp_path / "found.json").read_bytes() == before


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["task=cartpol"], "task=cartpol is unknown"),
        (["eval_episodes=0"], "eval_episodes=0 says nothing of success"),
        (["jobs=0"], "jobs=0 is not a whole number from 1 on"),
    ],
)
def test_a_newcomers_command_that_cannot_be_is_refused(words: list[str], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        newcomer.main(words)


def test_a_newcomers_command_that_fails_is_no_result(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """It was once the result `0 of 1 solved`, written over the stored one."""
    monkeypatch.setattr(newcomer, "RESULTS", tmp_path)
    monkeypatch.setattr(newcomer, "PROGRAM", ["sh", "-c", "echo the robot is off >&2; exit 2"])
    with pytest.raises(RunError, match="seed 7 ended with status 2: the robot is off"):
        newcomer.main(["seeds=7"])
    assert not os.listdir(tmp_path)


@pytest.mark.parametrize("main", [study.main, partial(study.main, module="benchmarks.own_cost")])
def test_a_finished_study_is_not_written_over(main: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(study, "RESULTS", tmp_path)
    file = tmp_path / "mine.json"
    file.write_text('{"seeds": [0], "about": {}}')
    with pytest.raises(ConfigError, match=r"mine\.json is there; expected the name of a new file"):
        main(["mine", "seeds=0", "task=cartpole"])
    file.write_text('{"seeds": [0]}')  # Ctrl-C ended it
    assert unfinished(file) == file


def test_what_a_run_is_worth_needs_a_run_and_an_environment() -> None:
    with pytest.raises(ConfigError, match="name a run and an environment"):
        native.main([])
