"""A run's folder on disk: whole files, what is in them, and one line for whatever is damaged."""

import io
import json
import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from folders import a_run, episode, row
from pegasus_jax.checks import ConfigError, RunError
from pegasus_jax.cli.runs import paths_and
from pegasus_jax.runs import display, files, store
from pegasus_jax.runs.best import best_trial, judging


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return a_run(tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture
def run(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "run"))


def refused(function: Any, *arguments: Any) -> str:
    with pytest.raises(RunError) as caught:
        function(*arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("mask", [0o022, 0o077, 0o000])
def test_files_have_the_umasks_mode_and_replace_links(mask: int, tmp_path: Path) -> None:
    target = tmp_path / "mine"
    target.write_text("mine")
    (tmp_path / "link").symlink_to(target)
    before = os.umask(mask)
    try:
        files.write_whole(tmp_path / "link", lambda file: file.write(b"theirs"))
    finally:
        os.umask(before)
    assert target.read_text() == "mine"
    assert not (tmp_path / "link").is_symlink()
    assert (tmp_path / "link").stat().st_mode & 0o777 == 0o666 & ~mask
    assert {path.name for path in tmp_path.iterdir()} == {"mine", "link"}


def test_a_write_that_fails_leaves_what_was_there(tmp_path: Path) -> None:
    def full(file: Any) -> None:
        file.write(b"half")
        raise OSError(28, "No space left on device")

    (tmp_path / "a").write_text("whole")
    with pytest.raises(OSError, match="No space"):
        files.write_whole(tmp_path / "a", full)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["whole"]


def test_json_has_null_for_what_is_no_number(run: Path) -> None:
    store.write_trials(run, [row(1, episode_cost=float("nan"), seconds={"fit": float("inf")}, calibration=[1, np.nan])])
    text = (run / "trials.jsonl").read_text()
    told = json.loads(text, parse_constant=lambda name: pytest.fail(name))
    assert (told["episode_cost"], told["seconds"], told["calibration"]) == (None, {"fit": None}, [1, None])


def test_an_episode_is_read_back_with_who_ran_it(run: Path) -> None:
    task = store.task_of(run)
    for trial, length, policy, ended in ((4, 7, 2, "terminated"), (5, 0, 0, "interrupted"), (6, 25, 5, "horizon")):
        one = episode(task, trial)._replace(length=np.int32(length))
        store.save_episode(run, trial, one, task, policy=policy, ended=ended)
        other = store.load_episode(run, trial)
        assert other is not None
        assert other.ended == ended
        np.testing.assert_array_equal(other.trajectory.x, one.x[: length + 1])
        np.testing.assert_array_equal(other.trajectory.u, one.u[:length])
        np.testing.assert_array_equal(other.trajectory.cost, one.cost[:length])
        assert store.origin(run, trial) == (policy, ended)
    assert (store.load_episode(run, 7), store.origin(run, 7)) == (None, None)


def wrong_episodes(run: Path) -> dict[str, dict[str, Any]]:
    """What is put in the place of some arrays of an episode that is right otherwise."""
    with np.load(store.episode_path(run, 2)) as file:
        x, u, cost = (file[name] for name in ("x", "u", "cost"))
    far, nan = u.copy(), x.copy()
    far[3], nan[3, 1] = 10.5, np.nan
    return {
        "another trial": {"trial": 3},
        "another task": {"task": "pendulum"},
        "a state less": {"x": x[:, :3]},
        "a row less": {"x": x[:-1]},
        "a control more": {"u": np.concatenate([u, u], 1)},
        "longer": {
            "x": np.concatenate([x, x[:3]]),
            "u": np.concatenate([u, u[:3]]),
            "cost": np.concatenate([cost, cost[:3]]),
        },
        "flat": {"x": x.ravel()},
        "a number": {"u": np.float32(1)},
        "texts": {"x": x.astype(str)},
        "integers": {"u": u.astype(int)},
        "mixed": {"cost": cost.astype(float)},
        "complex": {"x": x.astype(complex)},
        "nan": {"x": nan},
        "beyond the limits": {"u": far},
        "unknown end": {"ended": "somehow"},
        "later policy": {"policy": 2},
        "no policy": {"policy": "last"},
        "no cost": {"cost": None},
        "objects": {"cost": np.array([None] * 25)},
    }


def test_an_episode_that_cannot_be_is_one_line(run: Path) -> None:
    path = store.episode_path(run, 2)
    with np.load(path) as file:
        whole = dict(file)
    for name, changes in wrong_episodes(run).items():
        arrays = {key: value for key, value in (whole | changes).items() if value is not None}
        np.savez(path, **arrays)
        assert str(path) in refused(store.load_episode, run, 2), name


def test_a_file_that_is_no_episode_is_one_line(run: Path) -> None:
    path = store.episode_path(run, 2)
    whole, array = path.read_bytes(), io.BytesIO()
    np.save(array, np.zeros(3))
    for content in (b"", b"no episode", array.getvalue(), whole[:-100], whole[:60], bytes(len(whole)), os.urandom(500)):
        path.write_bytes(content)
        assert "it is damaged, or no .npz file" in refused(store.load_episode, run, 2)
    for place in range(30, len(whole), len(whole) // 40):  # a flipped bit is seen, or changes no number
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        with suppress(RunError):
            store.load_episode(run, 2)
    path.unlink()
    path.mkdir()
    assert "cannot be read" in refused(store.load_episode, run, 2)


ROWS = [json.dumps(row(trial)) for trial in (1, 2, 3)]
DAMAGED_ROWS = {
    "missing": ([ROWS[0], ROWS[2]], 1),
    "twice": ([ROWS[0], ROWS[0], ROWS[1]], 1),
    "out of order": ([ROWS[1], ROWS[0]], 0),
    "cut short": ([ROWS[0], ROWS[1][:20]], 1),
    "list": ([ROWS[0], "[1]"], 1),
    "null": (["null"], 0),
    "no UTF-8": ([ROWS[0], b"\xff\xfe".decode("latin1")], 1),
    "text for a number": ([ROWS[0], json.dumps(row(2, mean_cost="low"))], 1),
    "no trial": ([json.dumps({"cost": 1})], 0),
}


@pytest.mark.parametrize("name", DAMAGED_ROWS)
def test_rows_that_cannot_be_are_named(run: Path, name: str) -> None:
    lines, whole = DAMAGED_ROWS[name]
    (run / "trials.jsonl").write_bytes("".join(f"{line}\n" for line in lines).encode("latin1"))
    said = refused(store.trials, run)
    assert f"trials.jsonl line {whole + 1} " in said
    rows, problem = store.readable_trials(run)
    assert [row["trial"] for row in rows] == list(range(1, whole + 1))
    assert problem is not None
    assert problem in said


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"null", b'{"commands": 3}', b"\xff", b'{"task": {"name": 3}}'])
def test_a_damaged_run_json_is_named(run: Path, content: bytes) -> None:
    (run / "run.json").write_bytes(content)
    said = refused(store.task_of, run)
    assert "run.json is damaged" in said or "noted no facts of its task" in said


@pytest.mark.parametrize("bound", ["x", None, [0.1], {}])
def test_a_constraint_whose_bound_is_no_number_is_damage(run: Path, bound: Any) -> None:
    told = json.loads((run / "run.json").read_text())
    told["task"]["constraint_bound"] = bound
    (run / "run.json").write_text(json.dumps(told))
    assert "run.json is damaged" in refused(store.task_of, run)


def test_a_run_of_an_older_version_says_which(run: Path) -> None:
    told = json.loads((run / "run.json").read_text())
    del told["task"]
    (run / "run.json").write_text(json.dumps(told | {"versions": {"pegasus-jax": "0.0.7"}}))
    assert "of pegasus-jax 0.0.7" in refused(store.load_episode, run, 1)


@pytest.mark.parametrize("name", [*store.FILES, *store.FOLDERS])
def test_a_file_for_a_folder_or_the_reverse_is_named(run: Path, name: str) -> None:
    path = run / name
    if name in store.FOLDERS:
        shutil.rmtree(path, ignore_errors=True)
        path.write_text("")
    else:
        path.unlink(missing_ok=True)
        path.mkdir()
    assert f"{name} is not a f" in refused(store.existing, run)


def test_copies_are_not_counted(run: Path) -> None:
    for name in ("0003 (copy).json", "0003.json.bak", "3.json", "²³.json", "00003.json"):
        (run / "checkpoints" / name).write_text("{}")
    assert store.numbered(run / "checkpoints", ".json") == [1, 2, 3]


def test_left_over_files_go_and_no_others(run: Path) -> None:
    names = [
        "episodes/.0003.npz.0a1b2c3d",
        ".trials.jsonl.abcdef01",
        "checkpoints/.0001.json.tmp_x1y2",
        "checkpoints/0003.orbax-checkpoint-tmp-7",
        ".play.0a1b2c3d",
    ]
    for name in names:
        (run / name).write_text("half")
    (run / ".vscode.settings").write_text("mine")
    before = {
        path
        for path in run.rglob("*")
        if "half" not in (path.read_bytes()[:4].decode("latin1") if path.is_file() else "")
    }
    store.remove_unfinished(run)
    assert {*run.rglob("*")} == before


def test_a_folder_is_taken_once(made: Path, tmp_path: Path) -> None:
    """Two processes have both made it; the first finishes before the second asks for the lock."""
    store.create(tmp_path / "run")
    store.create(tmp_path / "run")
    with store.lock(tmp_path / "run", new=True):
        with pytest.raises(RunError, match="another process"):
            store.lock(tmp_path / "run", new=True)
        shutil.copy(made / "config.yaml", tmp_path / "run")
    with pytest.raises(ConfigError, match="holds a run already"):
        store.lock(tmp_path / "run", new=True)
    with store.lock(tmp_path / "run"):
        pass
    (tmp_path / "run" / "config.yaml").unlink()
    shutil.copytree(made / "episodes", tmp_path / "run" / "episodes")
    with pytest.raises(ConfigError, match="holds episodes of a run without"):
        store.create(tmp_path / "run")


def measured(*pairs: tuple[float, float]) -> list[dict[str, Any]]:
    return [row(trial, success_rate=rate, mean_cost=cost) for trial, (rate, cost) in enumerate(pairs, start=1)]


def ran(*rows: tuple[int, float | None, str]) -> list[dict[str, Any]]:
    """Rows of (policy, cost of its episode, how that ended); those that cost less than .1 succeeded."""
    return [
        row(trial, policy=policy, episode_cost=cost, episode_success=(cost or 1) < 0.1, ended=ended)
        for trial, (policy, cost, ended) in enumerate(rows, start=1)
    ]


def other_cost(rows: list[dict[str, Any]], since: int) -> list[dict[str, Any]]:
    """Rows whose costs are of another function from that trial on."""
    return [row | {"cost_since": since} if row["trial"] >= since else row for row in rows]


@pytest.mark.parametrize(
    ("rows", "last", "best"),
    [
        (measured((0.1, 0.1), (1.0, 0.3), (1.0, 0.2), (0.9, 0.1)), None, 3),  # success first, then cost
        (measured((0.0, 0.5), (0.0, 0.5)), None, 2),
        (ran((0, 0.0, "horizon"), (1, 0.9, "horizon"), (2, 0.2, "horizon"), (3, 0.8, "horizon")), None, 2),
        (ran((0, 0.0, "horizon"), (1, 0.5, "horizon"), (1, 0.9, "horizon"), (2, 0.6, "horizon")), None, 2),  # its mean
        (ran((0, 0.0, "horizon"), (1, 0.5, "horizon"), (2, 0.1, "error"), (2, 0.8, "horizon")), None, 1),
        # Of two episodes one succeeded; of another's one none, though it cost less than their mean.
        (ran((0, 0.0, "horizon"), (1, 0.05, "horizon"), (1, 0.9, "horizon"), (2, 0.3, "horizon")), None, 1),
        (ran((0, 0.0, "horizon"), (1, 0.5, "horizon"), (2, 0.1, "interrupted")), None, 1),
        (ran((0, 0.0, "horizon"), (1, 0.5, "horizon"), (2, None, "horizon")), None, 1),
        (ran((0, 0.0, "horizon"), (0, 0.5, "horizon")), None, 2),  # none ran: the last one
        (ran((0, 0.0, "horizon"), (1, 0.5, "horizon")), ran((2, 0.4, "horizon"))[0], 2),
        (ran((0, 0.0, "horizon"), (1, 0.5, "horizon")), ran((2, 0.4, "error"))[0], 1),
        (ran((0, 0.0, "horizon"), (1, 0.5, "horizon")), ran((2, 0.6, "terminated"))[0], 1),
        (other_cost(measured((1.0, 0.1), (0.9, 0.2), (0.0, 0.9), (0.0, 0.8)), 3), None, 4),  # costs of two functions
        (other_cost(ran((0, 0.9, "horizon"), (1, 0.2, "horizon"), (2, 0.7, "horizon")), 3), None, 2),
        (other_cost(ran((0, 0.9, "horizon"), (1, 0.2, "horizon")), 2), ran((2, 0.7, "horizon"))[0], 1),
    ],
)
def test_the_best_policy(rows: list[dict[str, Any]], last: dict[str, Any] | None, best: int) -> None:
    assert best_trial(rows, last) == best


@pytest.mark.parametrize(
    ("rows", "policy", "costs"),
    [
        (ran((0, 0.9, "horizon"), (1, 0.2, "horizon"), (1, 0.7, "error")), 1, [0.2]),
        (other_cost(ran((0, 0.9, "horizon"), (1, 5.0, "horizon"), (1, 0.2, "horizon")), 3), 1, [0.2]),
        ([one | {"random": one["trial"] == 1} for one in ran((0, 1.0, "horizon"), (0, 0.1, "horizon"))], 0, [0.1]),
    ],
)
def test_a_policys_cost_is_that_of_the_episodes_that_judge_it(rows, policy, costs) -> None:
    """Not one that a fault cut short, of another cost, or of random controls."""
    assert [one["episode_cost"] for one in judging(rows, policy)] == costs
    told = display.best_line([one | {"objective_fresh": 0.3} for one in rows], policy)
    assert told.startswith(f"best policy: trial {policy} (cost {costs[0]:.3f}, ran in 1 episode)")


def test_logs_are_no_episode_of_the_policy_of_before() -> None:
    """A run with init= and data= has a policy of trial 0, which did not drive what the logs hold."""
    rows = ran((0, 0.0, "horizon"), (1, 0.5, "horizon"))
    for one, best in ((rows[0] | {"random": False}, 0), (rows[0] | {"random": False, "logs": 2}, 1)):
        assert best_trial([one, rows[1]], first=0) == best
        assert display.best_line([one, rows[1]], 0).startswith(f"best policy: trial 0 ({'not' if best else 'cost'}")


def test_a_folder_may_have_an_equals_sign(tmp_path: Path) -> None:
    """`pegasus-train out=runs/x=1` makes one, and says what reads it."""
    (tmp_path / "x=1").mkdir()
    words = [str(tmp_path / "x=1"), "trial=2"]
    assert paths_and(words, {"trial": "best"}) == ([tmp_path / "x=1"], {"trial": "2"})
