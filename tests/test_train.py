"""Runs as a user makes them: real processes, killed at any moment, resumed, damaged, contended for."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import forked
from pegasus_jax.checks import ConfigError, RunError
from pegasus_jax.cli.runs import evaluate
from pegasus_jax.runs import checkpoint, config_io, store
from pegasus_jax.runs.best import best_trial
from pegasus_jax.runs.restore import restored

# A run of seconds: the model that compiles soonest, the smallest networks and searches that go through every part.
TINY = ["task=cartpole", "model=log_normal", "trials=3", "model.hidden=[16]", "policy.hidden=[8]"]
TINY += ["fit.steps=20", "search.steps=20", "search.particles=10"]


def program(name: str) -> list[str]:
    """The installed console script, run by this interpreter."""
    return [sys.executable, "-c", f"from pegasus_jax.cli.main import {name}; {name}()"]


def call(name: str, *words: object, cwd: Path, **env: str) -> subprocess.CompletedProcess[str]:
    return forked.command(name, *words, cwd=cwd, env=env)


def fingerprint(run: Path) -> str:
    """Of the newest state; in this process, because a command would take most of the time of these tests."""
    _, _, state = restored(run)
    return checkpoint.fingerprint(state)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An uninterrupted run."""
    run = tmp_path_factory.mktemp("runs") / "whole"
    words = [*program("train"), *TINY, f"out={run}"]
    done = subprocess.run(words, cwd=run.parent, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return run


def timeless(run: Path) -> list[dict[str, object]]:
    """The rows of a run without what the clock says."""
    return [{name: value for name, value in row.items() if name != "seconds"} for row in store.trials(run)]


def copy_until(whole: Path, run: Path, trial: int) -> Path:
    """A run as a kill would leave it after `trial`: what comes later is not there."""
    run.mkdir()
    for path in sorted(whole.rglob("*")):
        number = next((int(p[:4]) for p in path.relative_to(whole).parts if p[:4].isdecimal()), 0)
        if path.is_file() and number <= trial and path.name != ".lock":
            target = run / path.relative_to(whole)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(path.read_bytes())
    return run


def test_a_run_leaves_everything(whole: Path) -> None:
    rows = store.trials(whole)
    assert [row["trial"] for row in rows] == [1, 2, 3]
    assert [row["plant_seconds"] for row in rows] == [2.5, 5.0, 7.5]
    assert [row["random"] for row in rows] == [True, False, False]
    for row in rows:
        assert {"collect", "fit", "search", "compile"} <= row["seconds"].keys()
        assert 0 <= row["mean_cost"] <= 1
        assert 0 <= row["success_rate"] <= 1
        for name in ("fit_loss", "objective_first", "objective_last", "objective_fresh", "gradient_norm"):
            assert np.isfinite(row[name]), name
        assert row["skipped_updates"] == 0
    assert rows[0]["calibration"] is None  # there was no model yet
    assert all(row["calibration"] > 0 for row in rows[1:])
    assert sum(row["seconds"]["compile"] for row in rows[1:]) == 0  # nothing recompiles from trial to trial
    assert list((whole / "tensorboard").glob("events*"))
    assert not (whole / "tracked.json").exists()  # it asks for no trackers
    about = json.loads((whole / "run.json").read_text())
    assert "task=cartpole" in about["command"]
    assert "jax" in about["versions"]


@pytest.mark.campaign
def test_nothing_is_learned_between_random_episodes(tmp_path: Path) -> None:
    run = tmp_path / "run"
    done = call("train", *TINY, "explore.trials=2", "track=tensorboard", f"out={run}", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads((run / "tracked.json").read_text()) == {"tensorboard": {"known": {}, "told": 3}}
    rows = store.trials(run)
    assert [row["fit_loss"] is None for row in rows] == [True, False, False]
    assert [row["objective_last"] is None for row in rows] == [True, False, False]
    assert [row["calibration"] is None for row in rows] == [True, True, False]
    assert [path.stem for path in sorted((run / "imagined").iterdir())] == ["0002", "0003"]
    assert call("plot", run, cwd=tmp_path).returncode == 0


def test_episodes_can_be_read_without_us(whole: Path) -> None:
    with np.load(whole / "episodes" / "0002.npz") as file:
        assert file["x"].shape == (26, 4)
        assert file["u"].shape == (25, 1)
        assert file["cost"].shape == (25,)
        assert list(file["control_names"])
        assert len(file["state_names"]) == 4
        assert float(file["dt"]) == pytest.approx(0.1)
        assert np.all(np.abs(file["u"]) <= 10)


@pytest.mark.parametrize(
    "moment",
    [
        "second imagined",
        *(pytest.param(f"{n} episode", marks=pytest.mark.campaign) for n in ("first", "second", "third")),
    ],
)
def test_killed_and_resumed_is_bit_equal(whole: Path, tmp_path: Path, moment: str) -> None:
    """kill -9 as soon as a certain file appears, at several points of a trial."""
    run = tmp_path / "killed"
    awaited = {
        "first episode": run / "episodes" / "0001.npz",  # durable, but nothing has been learned from it
        "second episode": run / "episodes" / "0002.npz",
        "second imagined": run / "imagined" / "0002.npz",  # before that trial's row and checkpoint
        "third episode": run / "episodes" / "0003.npz",
    }[moment]
    process = subprocess.Popen([*program("train"), *TINY, f"out={run}"], cwd=tmp_path, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while not awaited.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.002)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert awaited.exists()
    kept = awaited.read_bytes()
    done = call("train", f"resume={run}", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert awaited.read_bytes() == kept or "imagined" in str(
        awaited
    )  # an episode once collected is never collected again
    assert fingerprint(run) == fingerprint(whole)
    assert timeless(run) == timeless(whole)
    assert not [path for path in run.rglob(".*") if path.name != ".lock"]


@pytest.mark.slow
def test_an_episode_on_disk_takes_the_place_of_the_plant(whole: Path, tmp_path: Path) -> None:
    """After a crash the episode that was run is used, though the plant could not repeat it."""
    run = copy_until(whole, tmp_path / "run", 1)
    other = store.load_episode(whole, 3)
    assert other is not None
    store.save_episode(run, 2, other.trajectory, store.task_of(run), policy=1, ended="horizon")
    assert call("train", f"resume={run}", cwd=tmp_path).returncode == 0
    used = store.load_episode(run, 2)
    assert used is not None
    np.testing.assert_array_equal(used.trajectory.x, other.trajectory.x)
    assert fingerprint(run) != fingerprint(whole)


@pytest.mark.slow
def test_a_damaged_checkpoint_is_named_and_the_one_before_used(whole: Path, tmp_path: Path) -> None:
    run = copy_until(whole, tmp_path / "run", 2)
    victim = max((run / "checkpoints" / "0002").rglob("*"), key=lambda p: p.stat().st_size if p.is_file() else -1)
    victim.write_bytes(victim.read_bytes()[:-10])
    done = call("train", f"resume={run}", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert victim.name in done.stderr
    assert "checkpoint 2 is not usable" in done.stderr
    assert fingerprint(run) == fingerprint(whole)


@pytest.mark.slow
def test_all_checkpoints_damaged_starts_from_the_episodes(whole: Path, tmp_path: Path) -> None:
    run = copy_until(whole, tmp_path / "run", 2)
    for sums in (run / "checkpoints").glob("*.json"):
        sums.unlink()
    assert call("train", f"resume={run}", cwd=tmp_path).returncode == 0
    assert fingerprint(run) == fingerprint(whole)


@pytest.mark.campaign
def test_checkpoints_of_another_structure_leave_the_episodes(whole: Path, tmp_path: Path) -> None:
    """As those of an older version may be, whose model was another. Resuming begins with the data."""
    run = copy_until(whole, tmp_path / "run", 2)
    config = config_io.load(run / "config.yaml")
    config_io.save(config_io.override(config, {"model.hidden": [17]}), run / "config.yaml")
    refused = call("evaluate", str(run), "trial=last", cwd=tmp_path)
    assert refused.returncode == 2
    assert "no checkpoint that this version can use" in refused.stderr
    assert re.search(
        r"model.params\S+ is float32 \[.*16.*\], and these settings make it float32 \[.*17", refused.stderr
    )
    assert refused.stderr.count("\n") == 1
    done = call("train", f"resume={run}", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "of another version, or of other settings than config.yaml" in done.stderr
    for trial in (1, 2):
        one, other = store.load_episode(run, trial), store.load_episode(whole, trial)
        assert one is not None
        assert other is not None
        np.testing.assert_array_equal(one.trajectory.x, other.trajectory.x)
    assert fingerprint(run) != fingerprint(whole)


@pytest.mark.slow
@pytest.mark.parametrize(
    "lines",
    [
        pytest.param([0, 2], id="a row less"),
        *(
            pytest.param(lines, id=id, marks=pytest.mark.campaign)
            for lines, id in (([], "gone"), ([0, 0, 1, 2], "a row twice"))
        ),
    ],
)
def test_rows_that_were_lost_are_found_again(lines: list[int], whole: Path, tmp_path: Path) -> None:
    """That is said; the trials are done again, from the episodes, with the same result."""
    run = copy_until(whole, tmp_path / "run", 9)
    rows = (run / "trials.jsonl").read_text().splitlines(keepends=True)
    (run / "trials.jsonl").write_text("".join(rows[i] for i in lines))
    drawn = call("plot", run, cwd=tmp_path)
    assert (drawn.returncode, drawn.stderr.count("\n")) == (2, 1)
    assert "trials.jsonl" in drawn.stderr or "no finished trial" in drawn.stderr
    done = call("train", f"resume={run}", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "trials.jsonl" in done.stderr
    assert "there were 3 trials" in done.stderr
    assert timeless(run) == timeless(whole)
    assert fingerprint(run) == fingerprint(whole)


@pytest.mark.slow
def test_a_file_that_the_disk_refuses_ends_the_command_in_one_line(whole: Path, tmp_path: Path) -> None:
    """A limit on the size of files stops the first large one; without it the run goes on."""
    command = shlex.join([*program("train"), *TINY, "out=run"])
    places = {**os.environ, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "1e6"}  # it leaves no half of a program
    done = subprocess.run(
        ["sh", "-c", f"ulimit -f 8; {command}"], cwd=tmp_path, env=places, capture_output=True, text=True
    )
    assert (done.returncode, "Traceback" in done.stderr) == (2, False), done.stderr
    assert re.fullmatch(r"pegasus: run/imagined/0001.npz: File too large; .*resume=.*", done.stderr.splitlines()[-1])
    done = call("train", "resume=run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert fingerprint(tmp_path / "run") == fingerprint(whole)
    assert timeless(tmp_path / "run") == timeless(whole)


@pytest.mark.slow
def test_pilco_learns_by_a_command(tmp_path: Path) -> None:
    """It alone computes in 64 bits: whatever looks at its task before must too."""
    pilco = ["model=ssgp", "policy=rbf", "algorithm=pilco", "trials=1", "fit.steps=3", "search.steps=3"]
    done = call("train", "task=cartpole", *pilco, "eval_episodes=1", "out=run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert len(store.trials(tmp_path / "run")) == 1


@pytest.mark.slow
def test_a_run_of_more_rows_takes_no_program_of_a_shorter_one(tmp_path: Path) -> None:
    long = [*(word for word in TINY if word != "trials=3"), "explore.trials=41", "eval_episodes=0"]
    for trials in (2, 41):  # of 25 rows: 41 have no room in 1024
        done = call("train", *long, f"trials={trials}", f"out=of{trials}", cwd=tmp_path, XDG_CACHE_HOME=str(tmp_path))
        assert done.returncode == 0, done.stderr
    done = call("train", "resume=of2", "trials=41", cwd=tmp_path, XDG_CACHE_HOME=str(tmp_path))
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_the_policy_of_a_trial_is_evaluated(whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for asked, trial in (("trial=1", 1), ("trial=best", best_trial(store.trials(whole)))):
        evaluate([str(whole), asked, "episodes=1", "json=true"])
        assert json.loads(capsys.readouterr().out)["trial"] == trial
    for asked, says in (
        ("trial=7", "choose from 1, 2, 3, best, last"),
        ("trial=worst", "expected a number, best or last"),
    ):
        with pytest.raises((ConfigError, RunError), match=says) as refused:
            evaluate([str(whole), asked])
        assert "\n" not in str(refused.value)


@pytest.mark.slow
def test_more_trials_after_the_end(whole: Path, tmp_path: Path) -> None:
    run = copy_until(whole, tmp_path / "run", 9)
    done = call("train", f"resume={run}", "trials=4", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert [row["trial"] for row in store.trials(run)] == [1, 2, 3, 4]
    fewer = call("train", f"resume={run}", "trials=2", cwd=tmp_path)
    assert fewer.returncode == 2
    assert "trials=2 is fewer than the 4 that are done" in fewer.stderr


@pytest.mark.campaign
def test_a_run_goes_on_with_another_search(whole: Path, tmp_path: Path) -> None:
    """Also with one whose optimizer remembers more; what was learned and written before stays as it is."""
    run = copy_until(whole, tmp_path / "run", 9)
    done = call("train", f"resume={run}", "trials=4", "search.steps=3", "search.num_starts=2", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "not usable" not in done.stderr
    rows = store.trials(run)
    assert rows[:3] == store.trials(whole)
    assert rows[3]["trial"] == 4
    assert np.isfinite(rows[3]["objective_last"])
    about = json.loads((run / "run.json").read_text())
    assert [command["done"] for command in about["commands"]] == [0, 3]
    assert "search.num_starts=2" in about["commands"][1]["command"]
    now = config_io.leaves(config_io.load(run / "config.yaml"))
    assert (now["search.steps"], now["search.num_starts"]) == (3, 2)


def test_two_processes_cannot_write_to_one_run(whole: Path, tmp_path: Path) -> None:
    run = copy_until(whole, tmp_path / "run", 9)
    with store.lock(run):
        done = call("train", f"resume={run}", cwd=tmp_path)
    assert done.returncode == 2
    assert "another process" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.slow
def test_eval_and_plot_work_while_a_run_goes_on(whole: Path, tmp_path: Path) -> None:
    run = copy_until(whole, tmp_path / "run", 2)
    with store.lock(run):
        evaluated = call("evaluate", run, "trial=last", "episodes=2", "json=true", cwd=tmp_path)
        plotted = call("plot", run, cwd=tmp_path)
    told = json.loads(evaluated.stdout)
    assert (told["trial"], told["fingerprint"]) == (2, fingerprint(run))
    assert plotted.returncode == 0, plotted.stderr
    drawn = {Path(line).name for line in plotted.stdout.split()}
    assert {"learning.png", "trial_0001.png", "trial_0002.png"} <= drawn
    assert all((run / "plots" / name).read_bytes().startswith(b"\x89PNG") for name in drawn)


@pytest.mark.parametrize(
    ("name", "words", "message"),
    [
        ("train", ["task=cartpol"], "did you mean 'cartpole'"),
        ("train", ["task=cartpole", "serch.steps=3"], "did you mean 'search.steps'"),
        ("train", ["task=cartpole", "search.steps=many"], "a whole number"),
        ("train", ["task=cartpole", "policy.dropout=1.5"], "the nearest is 0.99"),
        ("train", ["task=cartpole", "search.particles=4"], "the nearest is search.particles=5"),
        ("train", ["task=cartpole", "out=/proc/nowhere"], "out=/proc/nowhere cannot be written"),
        ("train", ["resume=nowhere"], "nowhere is not a run"),
        ("train", ["resume=nowhere", "seed=3"], "seed cannot be changed"),
        ("train", ["resume=nowhere", "policy.hidden=[3]"], "policy.hidden cannot be changed"),
        ("evaluate", ["nowhere"], "nowhere is not a run"),
        ("evaluate", ["nowhere", "episode=3"], "did you mean 'episodes'"),
        ("plot", [], "name one run"),
    ],
)
def test_bad_input_is_one_clear_line(name: str, words: list[str], message: str, tmp_path: Path) -> None:
    if not words:
        words = ["a", "b"]
    done = call(name, *words, cwd=tmp_path)
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())  # nothing was written


def test_a_folder_that_holds_a_run_is_not_overwritten(whole: Path) -> None:
    done = call("train", *TINY, f"out={whole}", cwd=whole.parent)
    assert done.returncode == 2
    assert f"resume={whole}" in done.stderr


def test_help_shows_the_settings_that_the_words_beside_it_leave(tmp_path: Path) -> None:
    shown = {words: call("train", "--help=all", *words.split(), cwd=tmp_path) for words in ("", "task=gym policy=rbf")}
    own, guest = (done.stdout for done in shown.values())
    assert all(text in own for text in ("search.matching=always ", "model.substeps=1 ", "with policy.kind=rbf"))
    assert all(text in guest for text in ("search.matching=narrow ", "policy.num_centers=30 ", "with policy.kind=mlp"))
    wrong = call("train", "--help", "task=gim", cwd=tmp_path)
    assert (wrong.returncode, wrong.stdout) == (2, "")
    assert "did you mean 'gym'" in wrong.stderr


@pytest.mark.parametrize(("name", "words"), [("evaluate", "episodes"), ("plot", "RUN")])
def test_help_is_there(name: str, words: str, tmp_path: Path) -> None:
    done = call(name, "--help", cwd=tmp_path)
    assert done.returncode == 0
    assert words in done.stdout
