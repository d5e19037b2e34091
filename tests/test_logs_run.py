"""A run that begins with logs, as its user makes it: learned from before the plant moves, and never lost."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import forked
import pegasus_jax as pg
from benchmarks import once
from pegasus_jax.checks import ConfigError
from pegasus_jax.runs import begin, checkpoint, config_io, store
from pegasus_jax.runs.restore import restored
from probes import PLAIN_WORDS

TINY = "task=gym env=Pendulum-v1 cost=mymodule:cost horizon=8 trials=3 eval_episodes=1 explore.trials=0"
TINY += " model.hidden=[8] policy.hidden=[8] fit.steps=5 search.steps=4 search.particles=8"
COST = "import jax.numpy as jnp\ndef cost(x):\n    return 1 - jnp.exp(-((x[0] - 1) ** 2 + x[1] ** 2))\n"
DT = 0.05  # Pendulum-v1 says so
LENGTHS = (12, 5)  # control periods of the logs; the first is longer than a horizon


def command(*words: object) -> list[str]:
    program = "from pegasus_jax.cli.main import train; train()"
    return [sys.executable, "-P", "-c", program, *words_of(*words)]


def words_of(*words: object) -> list[str]:
    return once(*TINY.split(), *words)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of a user with a cost, and logs of a pendulum that was driven at random."""
    folder = tmp_path_factory.mktemp("user")
    (folder / "mymodule.py").write_text(COST)
    (folder / "logs").mkdir()
    env = gymnasium.make("Pendulum-v1")
    env.action_space.seed(0)
    for number, length in enumerate(LENGTHS):
        x, _ = env.reset(seed=number)
        with open(folder / "logs" / f"{number}.csv", "w") as file:
            print("time,x0,x1,x2,u0", file=file)
            for t in range(length + 1):
                u = env.action_space.sample() if t < length else [np.nan]
                print(*(f"{value:.7g}" for value in (DT * t, *x, *u)), sep=",", file=file)
                if t < length:
                    x = env.step(u)[0]
    return folder


@pytest.fixture(scope="module")
def whole(place: Path) -> Path:
    done = subprocess.run(command("data=logs/*.csv", "out=whole"), cwd=place, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert f"note: logs of {17 * DT:g} s from 2 files are the first data" in done.stderr
    assert "trial  1/3 | 0.0 s of plant time | 3 episodes of logs, 0.85 s: cost" in done.stderr
    return place / "whole"


@pytest.mark.slow
def test_the_first_policy_is_learned_from_logs_and_all_goes_on_as_after_an_episode(whole: Path) -> None:
    rows = store.trials(whole)
    assert [row["random"] for row in rows] == [False] * 3
    assert [row["policy"] for row in rows][:2] == [0, 1]  # the first episode is by the policy of the logs
    assert [row["plant_seconds"] for row in rows] == pytest.approx([0, 8 * DT, 16 * DT], abs=1e-6)
    assert (rows[0]["logs"], rows[0]["steps"], rows[0]["log_seconds"]) == (3, 17, pytest.approx(17 * DT, abs=1e-6))
    assert all(row["objective_last"] is not None and row["mean_cost"] is not None for row in rows)
    assert rows[0]["calibration"] is None
    assert all(row["calibration"] > 0 for row in rows[1:])
    assert rows[2]["seconds"]["compile"] == 0  # nothing recompiles
    _, _, state = restored(whole)
    assert int(state.data.size) == 17 + 2 * 8
    assert store.numbered(whole / "episodes", ".npz") == [2, 3]
    kept = [store.arrays(whole / "logged" / f"000{n}.npz", *store.EPISODE, "source") for n in (1, 2, 3)]
    assert [len(one["u"]) for one in kept] == [8, 4, 5]
    assert [str(one["source"]) for one in kept] == ["logs/0.csv", "logs/0.csv", "logs/1.csv"]
    assert restored(whole, "best")[2].trial in (1, 2, 3)


@pytest.mark.slow
def test_killed_before_its_first_trial_it_needs_the_logs_no_more(place: Path, whole: Path, tmp_path: Path) -> None:
    """kill -9 as soon as config.yaml is there; then the files are gone, and the run ends bit-equal."""
    shutil.copytree(place, tmp_path, dirs_exist_ok=True, ignore=shutil.ignore_patterns("whole"))
    run = tmp_path / "killed"
    words = command("data=logs/*.csv", f"out={run}")
    process = subprocess.Popen(words, cwd=tmp_path, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while not (run / "config.yaml").exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.002)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert store.numbered(run / "logged", ".npz") == [1, 2, 3]
    assert not (run / "trials.jsonl").exists() or store.trials(run) == []
    shutil.rmtree(tmp_path / "logs")
    done = forked.command("train", f"resume={run}", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    states = [checkpoint.fingerprint(restored(one)[2]) for one in (run, whole)]
    assert states[0] == states[1]


@pytest.mark.slow
def test_another_run_begins_with_what_was_learned_from_logs(whole: Path, tmp_path: Path) -> None:
    """The logs say how much room the data of the first run have."""
    begin.copy(config_io.parse({"init": str(whole)}), tmp_path)
    found, copied = (restored(run)[2].data.x.shape for run in (whole, tmp_path / begin.FOLDER))
    assert found == copied


@pytest.mark.parametrize(
    "word",
    [
        "sensors.delay=1",
        *(pytest.param(word, marks=pytest.mark.campaign) for word in ("control_rate=100", "history=2")),
    ],
)
def test_logs_begin_a_run_whose_controller_remembers(place: Path, tmp_path: Path, word: str) -> None:
    words = words_of("data=logs/*.csv", f"out={tmp_path / 'run'}", "trials=1", word, *PLAIN_WORDS)
    done = forked.command("train", *words, cwd=place)
    assert done.returncode == 0, done.stderr
    assert "trial  1/1 | 0.0 s of plant time | 3 episodes of logs" in done.stderr


def test_bad_logs_end_the_command_before_a_folder_is_there(place: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(place))
    (tmp_path / "bad.csv").write_text("x0,x1,x2,u0\n1,0,0,0\n1,0,0,3\n")
    settings = dict(word.split("=", 1) for word in TINY.split()[1:])
    with pytest.raises(ConfigError, match=r"bad.csv line 3: u0 is 3, beyond its limits -2 to 2"):
        pg.train("gym", settings=settings, data="bad.csv")
    assert [path.name for path in tmp_path.iterdir()] == ["bad.csv"]


def test_a_run_keeps_its_logs_when_it_goes_on(tmp_path: Path) -> None:
    config = config_io.parse({"data": "logs/*.csv"})
    (tmp_path / "run").mkdir()
    config_io.save(config, tmp_path / "run" / "config.yaml")
    assert config_io.load(tmp_path / "run" / "config.yaml") == config
    with pytest.raises(ConfigError, match="data cannot be changed by resume="):
        pg.train(resume=tmp_path / "run", data="others.csv")
