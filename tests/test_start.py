"""`train` and `preset` in Python: what the command does, with functions where the command has their names."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pegasus_jax as pg
from folders import a_run
from pegasus_jax import start, tasks
from pegasus_jax.assembly.experiments import build
from pegasus_jax.cli import train as cli_train
from pegasus_jax.runs import checkpoint, config_io, programs, restore, store
from pegasus_jax.runs.collect import other_cost

TINY: dict[str, Any] = {
    "model.hidden": (4,),
    "policy.hidden": [4],
    "search.steps": 2,
    "fit.steps": "3",
    "search.particles": 8,
    "trials": 2,
    "eval_episodes": 1,
}
PENDULUM: dict[str, Any] = TINY | {"env": "Pendulum-v1", "horizon": 5, "eval_episodes": 0}


def upright(x: jax.Array) -> jax.Array:
    """Of an observation of Pendulum-v1: cosine, sine, rate."""
    assert x.shape == (3,)
    return 1 - jnp.exp(-((x[0] - 1) ** 2 + x[1] ** 2))


def half(x: jax.Array) -> jax.Array:
    return upright(x) / 2


def fingerprint(run: Path) -> str:
    return checkpoint.fingerprint(restore.restored(run)[2])


@pytest.mark.slow
def test_python_leaves_what_the_command_leaves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(programs, "share_cpus", lambda *_: None)  # JAX has its devices by now
    words = [f"{key}={config_io.shown(value)}" for key, value in TINY.items()]
    cli_train.train(["task=cartpole", "model=log_normal", "seed=3", *words, f"out={tmp_path / 'words'}"])
    said = capsys.readouterr().out
    config = pg.preset("cartpole", model="log_normal", settings=TINY | {"seed": 3})
    assert pg.train(config, out=tmp_path / "python") == tmp_path / "python"
    assert capsys.readouterr().out == said.replace("words", "python")
    one, other = tmp_path / "words", tmp_path / "python"
    files = [sorted(str(path.relative_to(run)) for path in run.rglob("*.npz")) for run in (one, other)]
    assert files[0] == files[1] != []
    assert (one / "config.yaml").read_text() == (other / "config.yaml").read_text()
    assert fingerprint(one) == fingerprint(other)
    assert store.stored(other)["commands"][0]["command"] == "pegasus_jax.train"
    assert pg.controller(other)(np.zeros(4)).shape == (1,)
    with pytest.raises(pg.ConfigError, match=r"holds a run already; resume="):
        pg.train(config, out=other)
    pg.train(resume=other, settings={"trials": 3})
    assert len(store.trials(other)) == 3
    with pytest.raises(pg.ConfigError, match=r"model\.hidden cannot be changed by resume="):
        pg.train(resume=other, settings={"model.hidden": [5]})


def test_a_folder_that_is_taken_is_refused_before_a_robot_moves(tmp_path: Path, monkeypatch) -> None:
    def checked(*_: Any) -> None:
        raise AssertionError("the robot was reset")

    monkeypatch.setattr(start, "_checked", checked)
    (tmp_path / "config.yaml").touch()
    with pytest.raises(pg.ConfigError, match=r"holds a run already; resume="):
        pg.train("cartpole", out=tmp_path)


@pytest.mark.slow
def test_a_cost_is_a_function_of_an_observation(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Cosine and sine, though the policy has their angle. The run is read without it, and goes on with one alone."""
    run = pg.train("gym", out=tmp_path / "run", settings=PENDULUM, cost=upright)
    ran = store.load_episode(run, 2)
    assert ran is not None
    with np.load(store.episode_path(run, 2)) as file:
        expected = [float(upright(x)) for x in file["observation"][1:]]
        assert file["x"].shape == (6, 2)
    np.testing.assert_allclose(ran.trajectory.cost, expected, rtol=1e-5)
    stored = config_io.load(run / "config.yaml").cost
    assert stored == f"{__name__}:upright"
    assert pg.controller(run)(np.array([1.0, 0.0, 0.0])).shape == (1,)
    config = config_io.load(run / "config.yaml")
    assert other_cost(run, tasks.of_config(replace(config, cost=upright))) is None  # type: ignore[arg-type]
    capfd.readouterr()
    pg.train(resume=run, settings={"trials": 3}, cost=half)
    told = [line for line in capfd.readouterr().err.splitlines() if "today's cost" in line]
    numbers = [float(found) for found in re.findall(r"(\d*\.\d+)", told[0])]
    assert "those of trials 1 to 2 were counted with another one" in told[0]
    np.testing.assert_allclose(numbers, [np.mean(expected), np.mean(expected) / 2], rtol=1e-2)
    pg.train(resume=run, settings={"trials": 4}, cost=half)
    assert [store.cost_since(row) for row in store.trials(run)] == [1, 1, 3, 3]


@pytest.mark.slow
def test_a_function_that_nobody_can_import_is_refused_in_a_line(tmp_path: Path) -> None:
    run = pg.train("gym", out=tmp_path / "run", settings=PENDULUM | {"trials": 1}, cost=lambda x: upright(x))
    with pytest.raises(
        pg.ConfigError, match=r"<lambda> is a function of the Python program .*train\(resume=RUN, cost="
    ):
        restore.ready(run)
    with pytest.raises(pg.ConfigError, match=r"cost=.*<lambda> is -3, negative"):
        pg.train("gym", out=tmp_path / "other", settings=PENDULUM, cost=lambda x: -x[0] - 2)
    assert not (tmp_path / "other").exists()


ARM = """<mujoco><option timestep="0.01"/><worldbody><body>
<joint name="elbow" type="hinge" axis="0 1 0"/><geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.5"/>
</body></worldbody><actuator><motor joint="elbow" ctrlrange="-2 2"/></actuator></mujoco>"""


def test_a_config_of_an_mjcf_file_takes_functions_too(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    low, high = lambda x: 1 - jnp.exp(-x @ x), lambda x: x[0] > 1
    settings = dict(mjcf=str(tmp_path / "arm.xml"), cost=low, stop=high, dt=0.05, horizon=4, angles=[0])
    config = pg.preset("mjcf", settings=settings)
    x = jnp.array([0.3, -0.2])
    task = build(config).task
    assert task.cost.of_state(x) == low(x)
    assert task.stop is not None
    assert bool(task.stop(2 * jnp.ones(2)))
    other = pg.compose(config, task, cost=lambda x: 2 * low(x)).task
    assert other.cost.of_state(x) == pytest.approx(2 * float(low(x)))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"search.lr": 1e-3}, r"search\.lr is not a setting; did you mean '"),
        ({"search.steps": 2.5}, r"search\.steps=2\.5 is not a whole number"),
        ({"search.steps": "many"}, r"search\.steps=many is not a whole number"),
        ({"search.steps": 0}, r"search\.steps=0 is out of range"),
        ({"search.widen": 2}, r"search\.widen is now called search\.cost_width_start"),
        ({"fit.reset": True}, r"fit\.reset was removed"),
        ({"model": "gpp"}, r"model=gpp is unknown; did you mean 'gp'"),
        ({"mjcf": "arm.xml"}, r"mjcf=arm.xml is of no use with task=cartpole"),
        ({"trials": upright}, r"trials=.*upright is not a whole number"),
    ],
)
def test_bad_words_are_refused_as_by_the_command(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(pg.ConfigError, match=f"^{message}") as refused:
        pg.preset("cartpole", settings=settings)
    assert "\n" not in str(refused.value)


def test_settings_are_the_commands_words() -> None:
    assert pg.preset("cartpole") == config_io.parse({"task": "cartpole"})
    said = pg.preset("cartpole", algorithm="paper", settings={"search.learning_rate": 1e-3, "explore.kind": "walk"})
    words = {"task": "cartpole", "algorithm": "paper", "search.learning_rate": "1e-3", "explore.kind": "walk"}
    assert said == config_io.parse(words)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        (dict(config="cartpol"), r"preset=cartpol is unknown; did you mean 'cartpole'"),
        (dict(settings={"env": "Pendulum-v1"}), r"env=Pendulum-v1 is of no use with task=cartpole"),
        (dict(config="gym", settings=PENDULUM, cost=upright, seeds=2), r"seeds=2 is too many for task=gym"),
        (dict(seeds=0), r"seeds=0 is out of range"),
        (dict(config="cartpole", resume="run"), r"resume=run goes on with a run; leave out config and out"),
    ],
)
def test_what_cannot_be_learned_is_refused_before_a_folder_is_made(how: Any, message: str, tmp_path: Path) -> None:
    with pytest.raises(pg.ConfigError, match=f"^{message}"):
        pg.train(**{"out": None if "resume" in how else tmp_path / "run", **how})
    assert not (tmp_path / "run").exists()


def test_fewer_trials_than_are_done_are_refused_before_anything_else_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = a_run(tmp_path / "run", trials=3)
    with pytest.raises(pg.ConfigError, match=r"^trials=2 is fewer than the 3 that are done; expected at least that$"):
        pg.train(resume=run, settings={"trials": 2})
    assert capsys.readouterr().out == ""


def test_the_callers_precision_comes_back() -> None:
    with start._precision_kept():
        jax.config.update("jax_enable_x64", True)
        jax.config.update("jax_default_matmul_precision", "float32")
    assert not jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    assert jax.config.jax_default_matmul_precision is None  # pyright: ignore[reportAttributeAccessIssue]
