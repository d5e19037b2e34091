"""What lies in a run's folder, made usable again; and what of it is never executed."""

import inspect
import json
import os
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from folders import a_run
from pegasus_jax import start, tasks
from pegasus_jax.assembly.experiments import build
from pegasus_jax.checks import ConfigError, RunError
from pegasus_jax.cli import runs as commands
from pegasus_jax.cli.words import OF_RUN
from pegasus_jax.exports.drive import drives
from pegasus_jax.exports.write import export
from pegasus_jax.learn.data import grow
from pegasus_jax.runs import checkpoint, config_io, evaluation, groups, restore, store
from pegasus_jax.runs.controller import controller
from pegasus_jax.viz.video import film
from probes import same
from test_train import call


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return a_run(tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture
def run(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "run"))


def change(run: Path, **changes: object) -> None:
    config = config_io.load(run / "config.yaml")
    config_io.save(
        config_io.override(config, {k.replace("__", "."): v for k, v in changes.items()}), run / "config.yaml"
    )


def test_the_facts_of_a_task_make_the_same_experiment(run: Path) -> None:
    """As far as a policy and its model go: the same state, and the same functions of it."""
    config, experiment, state = restore.restored(run)
    real = build(config)
    like = jax.eval_shape(real.init, jax.random.key(0))
    assert jax.tree.structure(like) == jax.tree.structure(state)
    x = np.array([0.1, 0.2, -0.3, 2.0], np.float32)
    u, expected = (e.policy.apply(state.policy.params, None, x) for e in (experiment, real))
    np.testing.assert_array_equal(u, expected)
    assert restore.same(run, real.task, config) is None
    with pytest.raises(RunError, match="its control_high was"):
        restore.same(run, real.task._replace(control_high=np.array([11.0])), config)


def test_a_run_whose_rates_had_the_units_of_positions_is_the_same_run(run: Path) -> None:
    """As versions before called them."""
    about = json.loads((run / "run.json").read_text())
    now = about["task"] | {"state_names": ["a [m]", "rate of a [m/s]", "b", "rate of b"]}
    about["task"] = now | {"state_names": ["a [m]", "rate of a [m]", "b", "rate of b"]}
    (run / "run.json").write_text(json.dumps(about))
    assert store.stored(run)["task"] == now
    assert store.task_of(run).state_names[1] == "rate of a [m/s]"


def test_a_state_of_other_settings_is_refused_with_the_difference(run: Path) -> None:
    change(run, model__hidden=[4])
    with pytest.raises(RunError, match=r"network.*is float32 \[3.*and these settings make it float32 \[4"):
        restore.restored(run, 2)
    with pytest.raises(RunError, match="no checkpoint that this version can use"):
        restore.restored(run)
    change(run, model__hidden=[3], task="double_cartpole")
    with pytest.raises(RunError, match="is not that of run"):
        restore.planted(run, config_io.load(run / "config.yaml"))


def test_another_optimizer_leaves_what_was_learned(run: Path) -> None:
    _, _, before = restore.restored(run, 2)
    change(run, search__num_starts=2, trials=9)
    _, experiment, state = restore.restored(run, 2)
    assert state.policy.optimizer is None
    assert state.model.optimizer is not None
    assert checkpoint.fingerprint(state) == checkpoint.fingerprint(before)
    whole = restore.suited(state, jax.jit(experiment.init)(jax.random.key(0)))
    like = jax.eval_shape(experiment.init, jax.random.key(0))
    assert jax.tree.structure(whole) == jax.tree.structure(like)


def test_a_checkpoint_may_have_more_room_than_a_shorter_run_needs(run: Path) -> None:
    _, _, state = restore.restored(run, 2)
    roomy = grow(state.data, 2 * len(state.data.x))
    checkpoint.save(run, 2, state._replace(data=roomy))
    assert checkpoint.fingerprint(restore.restored(run, 2)[2]) == checkpoint.fingerprint(state)
    checkpoint.save(run, 2, state._replace(data=roomy._replace(size=jnp.int32(len(roomy.x)))))
    with pytest.raises(RunError, match=r"data.x is"):
        restore.restored(run, 2)


def test_damaged_checkpoints_are_named(run: Path) -> None:
    sums = run / "checkpoints" / "0003.json"
    for content in ("", "[1]", "null", "{}", "3", '{"a": 1}'):
        sums.write_text(content)
        problem = checkpoint.damage(run, 3)
        assert problem is not None
        assert "\n" not in problem
    sums.unlink()
    sums.mkdir()
    shutil.copy(run / "checkpoints" / "0002.json", run / "checkpoints" / "0003 (copy).json")
    assert int(restore.restored(run)[2].trial) == 2
    with pytest.raises(RunError, match=r"0003.json is missing or unreadable"):
        restore.restored(run, 3)


def test_a_run_goes_on_from_where_its_rows_end(run: Path) -> None:
    """Rows that checkpoints prove are not lost: their trials are done again, and that is said."""
    experiment = build(config_io.load(run / "config.yaml"))
    for lines, begins in (([0, 1, 2], 3), ([0, 1], 2), ([0, 2], 1), ([0, 0, 1, 2], 1), ([], None)):
        whole = [json.dumps(row) for row in store.trials(run)]
        (run / "trials.jsonl").write_text("".join(whole[i] + "\n" for i in lines))
        said: list[str] = []
        state = restore.together([run], experiment, said.append)
        assert (None if state is None else int(state.trial[0])) == begins
        assert len(said) == (begins != 3)
        assert all("trials.jsonl" in line and "there were 3 trials" in line for line in said)
        (run / "trials.jsonl").write_text("".join(line + "\n" for line in whole))


def test_the_last_episode_counts_though_it_has_no_row(run: Path) -> None:
    """The policy after the last trial is the best as soon as its own episode says so."""
    assert restore.best(run) == 2
    told = "best policy: trial 2 (cost 0.700, ran in 1 episode); that of trial 3 has not run yet: trial=last takes it"
    assert restore.chosen(run, "best", 2) == told
    assert [restore.chosen(run, asked, 3) for asked in ("last", 3)] == [
        "newest policy: trial 3",
        "policy of trial 3, as asked",
    ]
    task, cheap = store.task_of(run), store.load_episode(run, 3)
    assert cheap is not None
    good = cheap.trajectory._replace(cost=0.01 * cheap.trajectory.cost)
    store.save_episode(run, 4, good, task, policy=3, ended="horizon")
    assert restore.best(run) == 3
    assert restore.chosen(run, "best", 3) == f"best policy: trial 3 (cost {good.cost.mean():.3f}, ran in 1 episode)"
    store.save_episode(run, 4, good, task, policy=3, ended="error")
    assert restore.best(run) == 2
    # One that ended early pays for what it left out.
    short = good._replace(x=good.x[:3], u=good.u[:2], cost=good.cost[:2])
    store.save_episode(run, 4, short, task, policy=3, ended="terminated")
    assert restore.best(run) == 2
    store.save_episode(run, 4, good, task, policy=3, ended="horizon")
    shutil.rmtree(run / "checkpoints" / "0003")
    (run / "checkpoints" / "0003.json").unlink()
    assert restore.best(run) == 2  # while a run goes on, its newest row is there before the checkpoint is


def test_every_command_takes_the_best_policy(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert {given["trial"] for given in OF_RUN.values() if "trial" in given} == {"best"}
    for function in (evaluation.evaluate_run, film, drives, export, controller):
        assert inspect.signature(function).parameters["trial"].default == "best"
    told = {"trial": 2, "episodes": 20, "mean_cost": 0.3330841660499573, "success_rate": 0.95, "fingerprint": "3f87"}
    monkeypatch.setattr(evaluation, "evaluate_run", lambda *given: told)
    commands.evaluate([str(run)])
    assert capsys.readouterr().out.splitlines() == [
        "best policy: trial 2 (cost 0.700, ran in 1 episode); that of trial 3 has not run yet: trial=last takes it",
        "20 episodes: mean cost 0.333, success 95%",
    ]
    commands.evaluate([str(run), "json=true"])
    assert json.loads(capsys.readouterr().out) == told


def test_nothing_is_imported_from_inside_a_run(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither by the name of a folder below the working folder, nor through a link or a path, nor from there."""
    for folder in (run, run / "lib"):
        folder.mkdir(exist_ok=True)
        (folder / "evil.py").write_text("raise SystemExit('executed')")
    config = config_io.override(config_io.load(run / "config.yaml"), {"task": "gym", "cost": "run.lib.evil:cost"})
    monkeypatch.chdir(run.parent)
    with pytest.raises(RunError, match="nothing is imported from there"):
        restore.announce(Path("run"), config)
    (run.parent / "link.py").symlink_to(run / "evil.py")
    with pytest.raises(RunError, match="nothing is imported from there"):
        restore.announce(run, config_io.override(config, {"cost": "link:cost"}))
    config = config_io.override(config, {"cost": "evil:cost"})
    restore.announce(run, config)
    monkeypatch.syspath_prepend(run / "lib")
    with pytest.raises(RunError, match="nothing is imported from there"):
        restore.announce(run, config)
    monkeypatch.undo()
    monkeypatch.chdir(run)
    with pytest.raises(RunError, match="nothing is imported from there"):
        restore.announce(run, config)


def test_a_hostile_folder_executes_nothing(run: Path) -> None:
    """By the commands: a cost that would write a file, an environment's module that would, links, and a reference."""
    (run / "evil.py").write_text("open('executed', 'w')\n")
    config = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(
        config.replace("task: cartpole", "task: gym")
        .replace("env: null", "env: run.evil:A-v0")
        .replace("cost: null", "cost: run.evil:cost")
    )
    mine = run.parent / "mine"
    mine.write_text("mine")
    (run / "plots").mkdir()
    (run / "plots" / "learning.png").symlink_to(mine)
    assert call("plot", "run", cwd=run.parent).returncode == 0
    for name, words in (("evaluate", ["run"]), ("play", ["run"]), ("train", ["resume=run"])):
        done = call(name, *words, cwd=run.parent)
        assert (done.returncode, "Traceback" in done.stderr) == (2, False), done.stderr
        assert "nothing is imported from there" in done.stderr
    assert mine.read_text() == "mine"
    assert not list(run.parent.rglob("executed"))
    (run / "config.yaml").write_text(config.replace("env: null", "env: ${oc.env:HOME}"))
    for name, words in (("evaluate", ["run"]), ("train", ["resume=run"])):
        done = call(name, *words, cwd=run.parent)
        assert (done.returncode, done.stderr.count("\n"), "not a value but a reference" in done.stderr) == (2, 1, True)
        assert os.environ["HOME"] not in (run / "config.yaml").read_text()


ARM = """<mujoco><option timestep="0.01"/><worldbody><body><joint name="j" axis="0 1 0"/>
<geom size=".1" fromto="0 0 0 0 0 1" type="capsule" mass="1"/></body></worldbody>
<actuator><motor joint="j" ctrlrange="-1 1"/></actuator></mujoco>"""


def test_a_model_that_was_moved_is_known_by_its_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "up.py").write_text("import jax.numpy as jnp\ncost = lambda x: 1 - jnp.exp(-x[0] ** 2)\n")
    monkeypatch.chdir(tmp_path)
    words = {"task": "mjcf", "mjcf": str(tmp_path / "arm.xml"), "cost": "up:cost", "dt": "0.05", "horizon": "6"}
    config = config_io.parse(words)
    run = a_run(tmp_path / "run", made=tasks.of_config(config), **words)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "arm.xml").rename(tmp_path / "elsewhere" / "new.xml")
    kept = config_io.load(run / "config.yaml")
    with pytest.raises(RunError, match="is not there; mjcf=FILE says where it is now"):
        restore.moved(run, kept)
    now = restore.moved(run, kept, "elsewhere/new.xml")
    assert restore.planted(run, now).name == "arm"
    shutil.copy(tmp_path / "elsewhere" / "new.xml", tmp_path / "elsewhere" / "arm.xml")
    monkeypatch.chdir(tmp_path / "elsewhere")  # where its name is found
    assert restore.planted(run, restore.moved(run, kept)).name == "arm"
    (tmp_path / "elsewhere" / "new.xml").write_text(ARM.replace('mass="1"', 'mass="2"'))
    with pytest.raises(RunError, match="its mjcf_digest was"):
        restore.planted(run, now)
    with pytest.raises(ConfigError, match="of no use here"):
        restore.moved(run, config_io.parse({"task": "cartpole"}), "new.xml")


def test_a_run_of_an_older_version_has_no_policy_to_go_back_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its checkpoints do not say which policy worked."""
    today = checkpoint._named

    def older(tree: Any, prefix: str = "") -> dict[str, Any]:
        return {name: leaf for name, leaf in today(tree, prefix).items() if not name.startswith(("working", "succ"))}

    with monkeypatch.context() as before:
        before.setattr(checkpoint, "_named", older)
        older_run = a_run(tmp_path / "run", trials=1)
    state = restore.restored(older_run)[2]
    assert (int(state.working_trial), bool(state.succeeded)) == (0, False)
    assert same(state.working, state.policy.params)


def test_the_newest_policy_is_said_to_be_older_where_its_checkpoint_is_damaged(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged = next(path for path in sorted((run / "checkpoints" / "0003" / "d").iterdir()) if path.is_file())
    damaged.write_bytes(b"")
    assert int(restore.ready(run, "last")[2].trial) == 2
    assert "note: checkpoint 3 is not usable" in capsys.readouterr().err


@pytest.mark.parametrize("task", ["3", '"cartpole"', "[1]"])
def test_a_task_that_is_none_is_said_to_be_damaged(run: Path, task: str) -> None:
    (run / "run.json").write_text(f'{{"task": {task}}}')
    with pytest.raises(RunError, match=r"run.json is damaged; without it, resume=.* writes a new one"):
        restore.same(run, tasks.make("cartpole"), config_io.load(run / "config.yaml"))


def test_runs_that_go_on_together_differ_in_their_seeds_alone(tmp_path: Path) -> None:
    """Else the settings of the first would take the place of the others'."""
    a_run(tmp_path / "seed0", trials=1)
    a_run(tmp_path / "seed1", trials=1, seed="1", model__kl_weight="0.5")
    with pytest.raises(ConfigError, match=r"seed1 has model.kl_weight=0.5, and .*seed0 0.1; go on with each by its"):
        start.going_on(tmp_path, {"trials": "3"})
    change(tmp_path / "seed1", model__kl_weight=0.1, trials=7)
    assert [*start.going_on(tmp_path, {"trials": "9"}).runs] == [0, 1]
    with pytest.raises(ConfigError, match="seed1 has trials=7, and"):
        start.going_on(tmp_path, {})


def test_a_misspelt_word_of_a_run_that_goes_on_is_answered_with_the_nearest(run: Path) -> None:
    for word, said in (
        ("serch.steps", "serch.steps is not a setting; did you mean 'search.steps'"),
        ("model.hidden", "model.hidden cannot be changed by resume="),
        ("seeds", "seeds cannot be changed by resume="),
        ("env_args.port", "env_args.port cannot be changed by resume="),
    ):
        with pytest.raises(ConfigError, match=said):
            start.going_on(run, {word: "3"})


def test_a_run_is_found_whatever_of_its_files_is_missing(run: Path) -> None:
    (run / "run.json").unlink()
    assert groups.found([run.parent]) == [run]
    assert "run.json cannot be read" in groups.readable([a_run(run.parent / "other", trials=1), run])[1][0]


def test_a_run_with_runs_inside_is_that_run(run: Path) -> None:
    a_run(run / "seed1", trials=1)
    assert store.seeds_of(run) == {}
    with pytest.raises(RunError, match=rf"is not a run \(it has no config.yaml\); there are {run}$"):
        store.existing(run.parent)
