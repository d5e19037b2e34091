"""pegasus-sweep: every combination once, each checked before anything starts, each an ordinary run in the end."""

import itertools
import shlex
import signal
import string
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import once
from pegasus_jax.checks import ConfigError
from pegasus_jax.cli import sweep as cli_sweep
from pegasus_jax.cli.sweep import Job, check, handle, jobs_of, values
from pegasus_jax.runs import config_io, store
from test_train import TINY

PROGRAM = [sys.executable, "-c", "from pegasus_jax.cli.sweep import sweep; sweep()"]


def call(*words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*PROGRAM, *words], cwd=cwd, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("3", ["3"]),
        ("1,10,100", ["1", "10", "100"]),
        ("0-3", ["0", "1", "2", "3"]),
        ("0-2,7", ["0", "1", "2", "7"]),
        ("[50,50]", ["[50,50]"]),
        ("[50,50],[200]", ["[50,50]", "[200]"]),
        ("1e-3,2e-3", ["1e-3", "2e-3"]),
        ("Pendulum-v1", ["Pendulum-v1"]),
    ],
)
def test_values(text: str, found: list[str]) -> None:
    assert values(text) == found


lists = st.lists(st.integers(0, 99), max_size=3).map(lambda found: f"[{','.join(map(str, found))}]")


@given(st.lists(lists | st.integers(0, 10**6).map(str), min_size=1, max_size=5, unique=True))
def test_what_is_joined_by_commas_is_split_there(found: list[str]) -> None:
    assert values(",".join(found)) == found


def test_every_combination_has_its_own_run() -> None:
    words = {"task": "cartpole", "search.grad_clip": "1,10", "policy.hidden": "[5,5],[7]", "seed": "0-1"}
    jobs = jobs_of(words, Path("out"))
    told = [config_io.split(job.words, ("out",)) for job in jobs]
    assert [options["out"] for options, _ in told] == [str(job.run) for job in jobs]
    assert len({job.run for job in jobs}) == 8
    combinations = itertools.product(("1", "10"), ("[5,5]", "[7]"), ("0", "1"))
    assert [tuple(chosen.values())[1:] for _, chosen in told] == list(combinations)
    assert jobs[1].run == Path("out/search.grad_clip-1_policy.hidden-5-5/seed1")


def test_values_that_differ_in_signs_or_in_letters_alone_have_folders_of_their_own() -> None:
    found = values("[1,0],[-1,0],[1,-0],1.0,[[1],[0]],x,X,a/b,+1,1,-1,1e-3,1e3," + "y" * 300 + "," + "y" * 301)
    names = [job.run.name for job in jobs_of({"start_mean": ",".join(found)}, Path("out"))]
    assert len({name.casefold() for name in names}) == len(found)
    assert names[:3] == ["start_mean-1-0", "start_mean--1-0", "start_mean-1--0"]
    for name in names:  # what Windows takes too
        assert set(name) <= {*"-._~+", *string.ascii_letters, *string.digits}
        assert len(name) < 100
        assert not name.endswith((".", " "))
    with pytest.raises(ConfigError, match="10 settings make a folder's name too long"):
        jobs_of({f"setting_{i}": f"{'x' * 30},{'y' * 30}" for i in range(10)}, Path("out"))


def test_seeds_alone_lie_as_those_of_one_study(tmp_path: Path) -> None:
    """So that pegasus-plot draws them together."""
    jobs = jobs_of({"task": "cartpole", "seed": "3-5"}, tmp_path)
    for job in jobs:
        job.run.mkdir()
        (job.run / "config.yaml").touch()
    assert store.seeds_of(tmp_path) == dict(zip((3, 4, 5), (job.run for job in jobs), strict=True))
    with pytest.raises(ConfigError, match="holds a run already"):
        check(jobs[0])


def beyond(x: Any) -> Any:
    return 1 - jnp.exp(-(x[7] ** 2))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["seed=0,0"], "give each value once"),
        (["seed=0,"], "empty value"),
        (["seed=4-2"], "4-2 counts down; type 2-4"),
        (["seed=0-99999999"], "0-99999999 is a range of more than 10,000 numbers"),
        (["seed=0-999", "trials=1-999"], "999,000 combinations; a sweep has at most 10,000"),
        (["seeds=99999999999999999999"], "the nearest is 10000"),
        (["search.grad_clip=1,x"], "search.grad_clip=x is not a number"),
        (["search.particles=3,100"], "the nearest is search.particles=5"),
        (["search.grad_clip=1", "clipp=2"], "clipp is not a setting"),
        (["seeds=1,2"], "seeds=1,2 is not a whole number"),
        (["seeds=4", "mesh=3x1"], "mesh=3x1 cannot share 4 seeds evenly; give mesh=1x1"),
        (["mesh=1x1,4"], "mesh=4 is not of the form SEEDSxPARTICLES"),
        (["track=none,wanb"], "track=wanb is unknown; did you mean 'wandb'"),
        (["data=nowhere.csv", "seed=0-1"], r"data=nowhere\.csv: there is no such file"),
        (["init=nowhere,null"], "init=nowhere: nowhere is not a run"),
        (["explore.policy=nowhere"], r"explore\.policy=nowhere is neither a run's folder nor a function"),
        ([f"cost={__name__}:beyond", "trials=1-2"], "reads entry 7 of an array of 4"),
        (["resume=runs/demo"], "resume is not a setting"),
        (["jobs=0"], "jobs=0 is out of range"),
        (["launcher=slrm"], "did you mean 'slurm'"),
        (["out="], "out= names no folder; for example out=runs/sweep"),
        (["seed=0-2", "seeds=2"], "seeds=2 of each of seed=0-2 would learn some twice; give one of them"),
        (["launcher=slurm"], "launcher="),  # neither the extra nor SLURM, or only one of them
    ],
)
def test_what_cannot_be_is_said_before_anything_starts(words: list[str], message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=message) as said:
        handle(["task=cartpole", f"out={tmp_path / 'sweep'}", *words])
    assert "\n" not in str(said.value)
    assert not list(tmp_path.rglob("config.yaml"))


def test_a_mistake_is_one_line(tmp_path: Path) -> None:
    done = call("task=cartpole", "search.grad_clip=1,x", "launcher=local", cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert not list(tmp_path.iterdir())


def test_printed_commands_are_those_of_the_runs(tmp_path: Path) -> None:
    done = call("task=cartpole", "policy.hidden=[5,5],[7]", "seeds=2", "out=my runs", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert [shlex.split(line) for line in done.stdout.splitlines()] == [
        ["pegasus-train", "task=cartpole", f"policy.hidden={value}", "seeds=2", f"out=my runs/policy.hidden-{name}"]
        for value, name in (("[5,5]", "5-5"), ("[7]", "7"))
    ]
    assert not list(tmp_path.iterdir())


@pytest.mark.campaign
def test_a_sweep_on_this_machine_leaves_ordinary_runs(tmp_path: Path) -> None:
    done = call(*once(*TINY, "trials=1"), "seed=1,2", "jobs=1", "launcher=local", "out=sweep", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("done: ") == 2
    for seed in (1, 2):
        run = tmp_path / "sweep" / f"seed{seed}"
        assert [row["trial"] for row in store.trials(run)] == [1]
        assert config_io.load(run / "config.yaml").seed == seed


def test_the_runs_of_a_sweep_end_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun = []

    class Popen(subprocess.Popen):
        def __init__(self, *given: Any, **more: Any) -> None:
            super().__init__(*given, **more)
            begun.append(self)

    def stop(_: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli_sweep, "PROGRAM", [sys.executable, "-c", "import time; time.sleep(60)"])
    monkeypatch.setattr(cli_sweep.subprocess, "Popen", Popen)
    monkeypatch.setattr(cli_sweep.time, "sleep", stop)
    with pytest.raises(KeyboardInterrupt):
        cli_sweep.local([Job(tmp_path / name, []) for name in "abc"], 2, tmp_path, {})
    assert [one.returncode for one in begun] == [-signal.SIGTERM, -signal.SIGTERM]
