"""The function that a run leaves: from its folder alone, in anybody's process."""

import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pegasus_jax
from folders import a_run
from pegasus_jax.checks import ConfigError, RunError, brief
from pegasus_jax.runs import store
from pegasus_jax.runs.restore import precision, restored

X = np.array([0.1, -0.2, 0.3, 3.0])


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    home = tmp_path_factory.mktemp("runs")
    return {name: a_run(home / name, x64=wide) for name, wide in (("single", "false"), ("double", "true"))}


@pytest.mark.parametrize("name", ["single", "double"])
@pytest.mark.parametrize("host", [False, True])
def test_it_changes_nothing_of_its_host_and_is_the_policy(runs: dict[str, Path], name: str, host: bool) -> None:
    config, experiment, state = restored(runs[name], "best")
    with precision(config):
        expected = np.asarray(experiment.policy.apply(state.policy.params, None, jnp.asarray(X, float)))
    with jax.enable_x64(host):
        before = {**jax.config.values}
        control = pegasus_jax.controller(runs[name])
        control.reset()
        u = control(X)
        assert {**jax.config.values} == before
        assert jnp.zeros(()).dtype == (jnp.float64 if host else jnp.float32)
    assert u.dtype == (np.float64 if name == "double" else np.float32)
    np.testing.assert_allclose(u, expected, rtol=1e-6 if name == "single" else 1e-14)


def test_the_host_keeps_its_precision_for_good(runs: dict[str, Path]) -> None:
    """In a process of its own, set as users set it."""
    code = f"""
import jax, jax.numpy as jnp, pegasus_jax
jax.config.update("jax_enable_x64", True)
control = pegasus_jax.controller({str(runs["single"])!r})
assert control({X.tolist()}).dtype == "float32"
assert jnp.zeros(()).dtype == "float64"
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_mistake_is_told_without_the_calls_inside(tmp_path: Path) -> None:
    """A user sees his own line and the message; what caused an error of his own code stays."""
    with pytest.raises(RunError, match="hovr is not a run") as caught:
        pegasus_jax.controller(tmp_path / "hovr")
    ours = [entry for entry in caught.traceback if "pegasus_jax" in str(entry.path) and "src" in entry.path.parts]
    assert (len(ours), caught.value.__cause__) == (1, None)

    @brief
    def fails() -> None:
        raise ConfigError("cost=mine:cost cannot be traced") from ZeroDivisionError("of the user")

    with pytest.raises(ConfigError) as refused:
        fails()
    assert isinstance(refused.value.__cause__, ZeroDivisionError)


def test_a_trial_is_chosen(runs: dict[str, Path]) -> None:
    """The rows say that the policies after trials 1 and 2 ran, and the second cost less; the third never did."""
    run = runs["single"]
    chosen = {trial: pegasus_jax.controller(run, trial=trial) for trial in (1, 2, 3, "best", "last")}
    assert [chosen[trial].trial for trial in chosen] == [1, 2, 3, 2, 3]
    np.testing.assert_array_equal(chosen["best"](X), chosen[2](X))
    assert np.all(chosen["last"](X) != chosen[2](X))
    for wrong in (4, "first", "1"):
        with pytest.raises(RunError, match=f"no checkpoint of trial={wrong!r}; choose from 1, 2, 3, best, last"):
            pegasus_jax.controller(run, trial=wrong)


def test_no_cost_environment_or_model_file_is_needed(tmp_path: Path) -> None:
    """The folder of a task of the user's own, alone on another computer: what it names is not there."""
    run = a_run(tmp_path / "run")
    config = (run / "config.yaml").read_text().replace("task: cartpole", "task: gym")
    (run / "config.yaml").write_text(
        config.replace("env: null", "env: absent:Arm-v0").replace("cost: null", "cost: absent:cost")
    )
    assert pegasus_jax.controller(run)(X).shape == (1,)
    with pytest.raises(RunError, match="which was not imported"):
        store.task_of(run).cost.of_state(jnp.zeros(4))


def test_wrong_observations_are_refused(runs: dict[str, Path]) -> None:
    control = pegasus_jax.controller(runs["single"])
    for wrong in ([1.0], [0, 0, 0, np.nan], [[0.0] * 4]):
        with pytest.raises(ValueError, match="4 finite numbers"):
            control(wrong)


def test_what_is_no_run_says_so(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="is not a run"):
        pegasus_jax.controller(tmp_path)
    run = a_run(tmp_path / "run", trials=1)
    shutil.rmtree(run / "checkpoints")
    with pytest.raises(RunError, match="holds no checkpoint"):
        pegasus_jax.controller(run, trial="last")


def test_the_controller_is_where_scripts_on_robots_look_for_it():
    assert import_module("pegasus_jax.deploy").controller is pegasus_jax.controller
