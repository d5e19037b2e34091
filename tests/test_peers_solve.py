"""The comparison of whole programs: when a plant is solved, what is on the clock, and what is shown of the runs."""

import json
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest

from benchmarks import RESULTS
from benchmarks.peers.solve import __main__ as solve
from benchmarks.peers.solve.attempt import PLANTS, Attempt, judge
from benchmarks.peers.solve.shown import picture, table
from benchmarks.plants_suite.native import returns
from benchmarks.results_page import END
from pegasus_jax.checks import ConfigError


def plant_of(costs: dict[int, list[float]]) -> Any:
    """A plant whose episodes have these costs, the first ones those of `costs`, the others none."""
    now = SimpleNamespace(action_space=gymnasium.spaces.Box(-1, 1, (1,)))

    def reset(seed: int) -> tuple[np.ndarray, dict]:
        now.left = list(costs.get(seed - 10_000, [0.0] * 25))
        return np.zeros(4), {}

    def step(u: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        cost = now.left.pop(0)
        return np.zeros(4), -cost, False, not now.left, {"cost": cost}

    now.reset, now.step = reset, step
    return now


@pytest.mark.parametrize(
    ("failing", "value"),
    [([], 1.0), ([3, 19], 0.9), ([0, 4, 9], 0.7)],  # after the third failure of ten episodes 90 % of 20 is out of reach
)
def test_the_cart_pole_is_solved_when_nine_of_ten_episodes_end_upright(failing: list[int], value: float) -> None:
    late, early = [0.0] * 20 + [0.21] * 5, [1.0] * 20 + [0.19] * 5  # only the last five steps count
    costs = dict.fromkeys(range(20), early) | dict.fromkeys(failing, late)
    found = judge(lambda x: 0.0, plant_of(costs), PLANTS["cartpole"])
    assert found == pytest.approx(value)
    assert (found >= PLANTS["cartpole"].bar) == (len(failing) < 3)


def test_pendulum_is_judged_by_its_own_return() -> None:
    env = gymnasium.make("Pendulum-v1")
    totals, _ = returns(lambda x: np.zeros(1), env, 10, 10)
    found = judge(lambda x: 0.0, env, PLANTS["pendulum"])
    assert any(found == pytest.approx(np.mean(totals[:count]), abs=1e-3) for count in range(1, 11))
    assert found < PLANTS["pendulum"].bar


def test_judging_is_on_no_clock_and_the_policy_in_hand_is_judged_when_time_is_over(tmp_path: Path) -> None:
    attempt = Attempt(PLANTS["pendulum"], 0, 0.5, tmp_path / "rows")
    attempt.other = attempt.env.env
    attempt.at_end = lambda x: np.zeros(1)
    attempt.begin()
    for _ in range(40):
        attempt.env.step(np.zeros(1, np.float32))

    def work(seconds: float) -> np.ndarray:
        until = time.process_time() + seconds
        while time.process_time() < until:
            pass
        return np.zeros(1)

    attempt.judged(lambda x: work(2.5e-3))
    with pytest.raises(SystemExit):
        work(5)
    first, last = (json.loads(line) for line in (tmp_path / "rows").read_text().splitlines())
    assert first["plant_seconds"] == last["plant_seconds"] == 2.0
    assert first["cpu_seconds"] < last["cpu_seconds"]
    assert 0.45 < last["cpu_seconds"] < 0.95  # judging took 1 s and more; other threads of this process count too


def run(program: str, seed: int, plant: float, cpu: float, solved: bool = True) -> dict[str, Any]:
    policy = {"plant_seconds": plant, "cpu_seconds": cpu, "wall_seconds": 2 * cpu, "value": float(solved)}
    told = {"plant": "cartpole", "seed": seed, "program": program, "limit": 600.0, "error": None}
    return told | {"solved": solved, "policies": [policy]}


def test_a_table_has_every_seed_and_how_often_our_median_goes_into_theirs(tmp_path: Path) -> None:
    ours = [run("pegasus_jax", seed, plant, 50.0) for seed, plant in enumerate([2.5, 10.0, 2.5])]
    theirs = [run("sac", 0, 300.0, 90.0), run("sac", 1, 250.0, 100.0), run("sac", 2, 400.0, 120.0, solved=False)]
    never = [run("mc_pilco", seed, 2.5, 590.0, solved=False) for seed in range(3)]
    failed = run("crossq", 0, 1.0, 1.0) | {"error": "ModuleNotFoundError: No module named 'sbx'"}
    rows = [line.strip("| ").split(" | ") for line in table([*ours, *theirs, *never, failed]).splitlines()]
    assert [row[:3] for row in rows[2:]] == [
        ["cart-pole", "pegasus_jax", "3 of 3"],
        ["cart-pole", "MC-PILCO", "0 of 3 within 600 s"],
        ["cart-pole", "SAC (SBX)", "2 of 3 within 600 s"],
    ]
    assert rows[2][3:6] == ["2.5, 2.5, 10", "50, 50, 50", "100, 100, 100"]
    assert rows[3][6:] == [">1", ">12"]
    assert rows[4][3:5] == ["250, 300, >400", "90, 100, >600"]
    assert rows[4][6:] == ["120", "2"]
    picture([*ours, *theirs, *never], tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["plants=cartpol"], "plants=cartpol is unknown; did you mean"),
        (["programs=SAC"], "programs=SAC is unknown; choices: pegasus_jax"),
        (["pythn=x"], "pythn= is unknown; did you mean"),
        (["limit=soon"], "limit=soon is not a whole number"),
        (["core=1.5"], "core=1.5 is not a whole number"),
        (["mc_pilco=nowhere"], "mc_pilco=nowhere is not a checkout of it"),
        (["programs=prob_mbrl"], "prob_mbrl= is not a checkout of it"),
    ],
)
def test_what_cannot_be_run_is_one_line(words: list[str], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        solve.asked(words)


def test_a_file_of_something_else_is_not_written_over(tmp_path: Path) -> None:
    file = tmp_path / "mine.json"
    file.write_text("[1, 2]")
    with pytest.raises(ConfigError, match=r"mine\.json has no runs of this command"):
        solve.main(["seeds=0", f"out={file}"])
    assert file.read_text() == "[1, 2]"


def test_programs_without_a_checkout_are_left_out() -> None:
    _, runs = solve.asked(["seeds=0"])
    assert {program for _, _, program in runs} == {"pegasus_jax", "sac", "crossq"}


def test_the_page_has_the_table_of_the_stored_runs() -> None:
    runs = json.loads((RESULTS / "peers-solve.json").read_text())["runs"]
    assert f"{solve.BEGIN}\n{table(runs)}\n\n{END}" in solve.PAGE.read_text()
