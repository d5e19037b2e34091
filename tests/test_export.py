"""A policy that runs anywhere: every format of every policy is the policy, and says what it needs to be used."""

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import folders
import pegasus_jax
from folders import a_run
from pegasus_jax import tasks
from pegasus_jax.checks import ConfigError, RunError
from pegasus_jax.cli import export as cli
from pegasus_jax.config import KINDS
from pegasus_jax.exports import as_c, parity, write
from pegasus_jax.exports.learned import Learned, for_comment
from pegasus_jax.exports.parity import observations
from pegasus_jax.math.circles import to_observation
from pegasus_jax.runs import restore, store
from pegasus_jax.task import Task
from pegasus_jax.tasks.circled import of_angles

FORMATS = ("numpy", "c", "onnx", "stablehlo")
needs_cc = pytest.mark.skipif(not any(map(as_c.shutil.which, as_c.COMPILERS)), reason="needs a C compiler")
EACH = [pytest.param(name, marks=needs_cc if name == "c" else ()) for name in FORMATS]


def round_arm() -> Task:
    """An arm with two joints, of which one is seen as sine and cosine, the other as an angle; it has two motors."""
    base = tasks.make("cartpole")
    size = dict(start_mean=np.array([0.1, 0, 1, 0.5, 0]), start_std=np.full(5, 0.1), sensor_std=np.zeros(5))
    limits = dict(control_low=np.array([-1.0, 0.0]), control_high=np.array([3.0, 0.5]))
    names = dict(state_names=tuple(f"x{i}" for i in range(5)), control_names=("first [N m]", "second"))
    return of_angles(base._replace(angles=(3,), rates=(), **size, **limits, **names), ((2, 1),))


POLICIES: dict[str, dict[str, str]] = {
    "mlp": {},
    "mlp, everything": {"policy__dropout": "0.2", "policy__squash": "sine", "policy__input_units": "[2,3,4]"},
    "mlp of circles": {},
    "mlp, found units": {"policy__input_units": "null"},
    "linear of circles": {"policy": "linear", "policy__squash": "tanh"},
    "rbf of circles": {"policy": "rbf", "policy__num_centers": "7"},
    "mlp, double": {"x64": "true"},
    "linear, double": {"policy": "linear", "x64": "true"},
    "rbf, double": {"policy": "rbf", "x64": "true"},
}


def learned_by(home: Path, name: str) -> Path:
    """A run of a policy of POLICIES; of circles, with a task that has some."""
    changes: dict[str, Any] = {**POLICIES[name]}
    if "circles" in name:
        changes |= {"made": round_arm(), "model": "log_normal"}
    with pytest.MonkeyPatch.context() as patch:
        if "policy" in changes:  # its own settings are not those of a network
            patch.setattr(folders, "TINY", {k: v for k, v in folders.TINY.items() if k != "policy.hidden"})
        return a_run(home / name.replace(", ", "-").replace(" ", "_"), trials=2, **changes)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    home = tmp_path_factory.mktemp("runs")
    return {name: learned_by(home, name) for name in POLICIES}


def fresh(run: Path) -> np.ndarray:
    """Observations [60, O] that the parity check did not see: near, far, and of angles beyond a turn."""
    task, draw = store.task_of(run), np.random.default_rng(7)
    states = draw.normal(size=(60, len(task.state_names))) * draw.choice([0.01, 1, 5], size=(60, 1))
    return to_observation(states, task.circles) * (1.3 if task.circles else 1)  # a sensor that is off its circle


def test_every_kind_of_policy_is_tried() -> None:
    assert {changes.get("policy", "mlp") for changes in POLICIES.values()} == {*KINDS["policy"]}


@pytest.mark.parametrize("format", EACH)
@pytest.mark.parametrize("name", POLICIES)
def test_a_file_is_the_policy(runs: dict[str, Path], name: str, format: str, tmp_path: Path) -> None:
    run, suffix = runs[name], write.FORMATS[format].suffix
    control = pegasus_jax.controller(run, trial=2)
    file = pegasus_jax.export(run, trial=2, format=format, out=tmp_path / f"act{suffix}")
    x = fresh(run)
    expected = np.stack([control(row) for row in x])
    found = write.FORMATS[format].run(file, x.astype(expected.dtype), parity.EPISODE)
    assert found.dtype == expected.dtype
    span = np.asarray(store.task_of(run).control_high) - np.asarray(store.task_of(run).control_low)
    single = 2e-5 if name.startswith("rbf") else 2e-6
    assert np.max(np.abs(found - expected) / span) < (1e-12 if name.endswith("double") else single)
    assert np.ptp(found, axis=0).min() > 0.01 * span.min()  # not all the same

    contract = json.loads(Path(f"{file}.json").read_text())
    assert contract["parity"]["largest_difference"] <= (1e-12 if name.endswith("double") else 1e-5)
    assert contract["parity"]["observations"] == 1000
    assert sorted(path.name for path in tmp_path.iterdir()) == [file.name, f"{file.name}.json"]


def test_a_contract_says_what_a_robot_needs(runs: dict[str, Path], tmp_path: Path) -> None:
    said = json.loads(Path(f"{pegasus_jax.export(runs['mlp'], out=tmp_path / 'a.py')}.json").read_text())
    assert [(entry["name"], entry["unit"]) for entry in said["observation"]] == [
        ("x", "m"),
        ("x'", "m/s"),
        ("theta'", "rad/s"),
        ("theta", "rad"),
    ]
    assert said["control"] == [{"name": "force", "unit": "N", "low": -10.0, "high": 10.0}]
    assert (said["period_s"], said["numbers"], said["trial"], said["run"]) == (0.1, "float32", 1, "mlp")
    assert (said["filter"], said["history"]) == ("none", "none")
    assert said["parity"]["stored"] == 52  # two episodes of 25 periods
    assert said["versions"]["pegasus-jax"] == pegasus_jax.__version__
    again = said["command"].split()
    assert again[:4] == ["pegasus-export", str(runs["mlp"]), "trial=1", "format=numpy"]


def test_entries_are_in_the_order_of_the_observation(runs: dict[str, Path], tmp_path: Path) -> None:
    said = json.loads(Path(f"{pegasus_jax.export(runs['mlp of circles'], out=tmp_path / 'a.py')}.json").read_text())
    assert [entry["name"] for entry in said["observation"]] == ["x0", "x1", "x2", "x3", "x4"]
    assert [entry.get("is") for entry in said["observation"]][1:3] == ["sine of an angle", "cosine of an angle"]
    assert said["control"][0] == {"name": "first", "unit": "N m", "low": -1.0, "high": 3.0}
    assert said["control"][1]["unit"] is None


def test_observations_are_stored_ones_and_others_around(runs: dict[str, Path]) -> None:
    task = store.task_of(runs["mlp"])
    given, stored = observations(runs["mlp"], task)
    episodes = np.concatenate([store.load_episode(runs["mlp"], trial).trajectory.x for trial in (1, 2)])  # type: ignore[union-attr]
    assert stored == len(episodes) == len({*map(tuple, given[:stored])} & {*map(tuple, episodes.astype(float))})
    assert np.all(np.ptp(given[stored:], axis=0) > 1.5 * np.ptp(episodes, axis=0))


@pytest.mark.parametrize("format", EACH)
def test_a_file_that_is_not_the_policy_is_not_kept(
    runs: dict[str, Path], format: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = write.FORMATS[format]

    def wrong(learned: Learned, name: str) -> bytes:
        """A limit, or the last bias, is 1e-3 of its size off."""
        off = learned.task._replace(control_high=np.asarray(learned.task.control_high) * 1.001)
        apply = learned.policy.apply
        policy = learned.policy._replace(apply=lambda *given: apply(*given) + 1e-3)
        return made.write(learned._replace(task=off, policy=policy), name)

    monkeypatch.setitem(write.FORMATS, format, made._replace(write=wrong))
    with pytest.raises(RunError, match=r"differ from the policy's by [\d.e-]+ of the control range.* was not kept"):
        pegasus_jax.export(runs["mlp"], format=format, out=tmp_path / f"act{made.suffix}")
    assert not [*tmp_path.iterdir()]


def test_controls_that_are_no_numbers_or_too_many_are_not_kept(
    runs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for run, complaint in (
        (lambda _, x, n: np.full((len(x), 1), np.nan), "by nan"),
        (lambda _, x, n: x, r"controls \[1000"),
    ):
        monkeypatch.setitem(write.FORMATS, "numpy", write.FORMATS["numpy"]._replace(run=run))
        with pytest.raises(RunError, match=complaint):
            pegasus_jax.export(runs["mlp"], out=tmp_path / "act.py")
    assert not [*tmp_path.iterdir()]


def test_a_policy_of_another_kind_is_stablehlo_only(runs: dict[str, Path], tmp_path: Path) -> None:
    config, experiment, state = restore.restored(runs["mlp"])
    policy = experiment.policy._replace(apply=lambda params, noise, x: 3 * jnp.cos(x[:1]))
    own: Any = SimpleNamespace(policy="a function of its user", x64=False, state_names=())
    learned = Learned("run", 1, own, experiment.task, policy, state.policy.params)
    for format in ("numpy", "c", "onnx"):
        with pytest.raises(ConfigError, match=f"format={format} cannot write .* the nearest is format=stablehlo"):
            write.FORMATS[format].write(learned, "act")
    (file := tmp_path / "act").write_bytes(write.FORMATS["stablehlo"].write(learned._replace(config=config), "act"))
    x = np.float32([[0.5, 0, 0, 0]])
    np.testing.assert_allclose(write.FORMATS["stablehlo"].run(file, x, parity.EPISODE), [[3 * np.cos(0.5)]], rtol=1e-6)


# What a user does wrong


def test_a_file_that_is_there_is_kept(runs: dict[str, Path], tmp_path: Path) -> None:
    file = tmp_path / "act.py"
    file.write_text("mine")
    with pytest.raises(ConfigError, match=r"act.py is there already; overwrite=true replaces it"):
        pegasus_jax.export(runs["mlp"], out=file)
    assert file.read_text() == "mine"
    assert pegasus_jax.export(runs["mlp"], out=file, overwrite=True) == file
    assert "NumPy" in file.read_text()
    file.unlink()
    with pytest.raises(ConfigError, match=r"act.py.json is there already"):
        pegasus_jax.export(runs["mlp"], out=file)


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ({"format": "tflite"}, "format=tflite is not a choice; .*numpy, c, onnx, stablehlo"),
        ({"out": "my-arm.py"}, r"out=my-arm.py is no name for format=numpy; the nearest is out=my_arm.py"),
        ({"out": "arm.py", "format": "c"}, "out=arm.py is no name for format=c; the nearest is out=arm.h"),
        ({"out": "2.h", "format": "c"}, "the nearest is out=_2.h"),
        ({"out": "class.py"}, "the nearest is out=class_.py"),
        ({"out": "numpy.py"}, "the nearest is out=numpy_.py"),
        ({"out": "math.h", "format": "c"}, "the nearest is out=math_.h"),
        ({"trial": 9}, "has no checkpoint of trial=9; choose from 1, 2, best, last"),
    ],
)
def test_what_cannot_be_is_refused(
    runs: dict[str, Path], given: dict[str, Any], complaint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises((ConfigError, RunError), match=complaint):
        pegasus_jax.export(runs["mlp"], **{"out": None, **given})
    assert not [*tmp_path.iterdir()]


def test_without_a_compiler_or_a_package_it_says_so(
    runs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(ConfigError, match="format=c needs a C compiler"):
        pegasus_jax.export(runs["mlp"], format="c", out=tmp_path / "act.h")
    for package, format in (("onnx", "onnx"), ("onnxruntime", "onnx")):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, package, None)
            with pytest.raises(ConfigError, match=rf"{package} is missing: pip install 'pegasus-jax\[export\]'"):
                pegasus_jax.export(runs["mlp"], format=format, out=tmp_path / f"act.{format}")
    assert not [*tmp_path.iterdir()]


def test_a_name_cannot_end_a_comment() -> None:
    assert for_comment('arm */ #include "x" \\ """') == "arm _/ _include _x_ _ ___"


# The command


def test_the_command_says_what_it_wrote(runs: dict[str, Path], capsys: pytest.CaptureFixture[str]) -> None:
    run = runs["linear, double"]
    cli.handle([str(run), "trial=last", "overwrite=true"])
    said = capsys.readouterr()
    assert said.err == f"exporting {run}, and comparing the file with its policy on 1,000 observations\n"
    lines = said.out.splitlines()
    assert lines[0] == f"{run}/controller.py: The controller after trial 2 of linear-double, task cartpole"
    assert lines[1] == "newest policy: trial 2"
    assert lines[2] == f"{run}/controller.py.json: its contract"
    assert lines[3].startswith("1,000 observations, 52 of them stored: it differs from the policy by at most ")
    for words, complaint in (
        (["trial=x"], "trial=x is not a trial"),
        (["overwrite=yes"], "overwrite=yes is neither"),
        (["fomat=c"], "did you mean 'format'"),
        ([f"out={run}/kept.py", "overwrite=true"], "kept.py.json is a folder; another out= is free"),
    ):
        (run / "kept.py.json").mkdir(exist_ok=True)
        with pytest.raises(ConfigError, match=complaint):
            cli.handle([str(run), *words])
    assert not (run / "kept.py").exists()


def test_the_command_ends_in_one_line(tmp_path: Path) -> None:
    for words, code, text in (([str(tmp_path)], 2, "is not a run"), (["--help"], 0, "overwrite=false")):
        done = subprocess.run(
            [sys.executable, "-m", "pegasus_jax.cli.export", *words], capture_output=True, text=True, check=False
        )
        assert (done.returncode, text in done.stdout + done.stderr) == (code, True)
        assert len(done.stderr.splitlines()) == (1 if code else 0)
