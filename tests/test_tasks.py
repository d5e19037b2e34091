"""Every task builds with its own defaults, obeys its plant's limits, and learns through the command line."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import forked
from pegasus_jax import tasks
from pegasus_jax.assembly.experiments import build
from pegasus_jax.assembly.pieces import dynamics_of
from pegasus_jax.checks import ConfigError
from pegasus_jax.config import Config, Lagrangian
from pegasus_jax.runs import config_io, store
from pegasus_jax.task import Signal
from pegasus_jax.tasks import assumed
from pegasus_jax.types import Dataset

# (task, legs, states, controls, horizon, control period [s])
SHAPES = [
    ("cartpole", 2, 4, 1, 25, 0.1),
    ("double_cartpole", 2, 6, 1, 30, 0.1),
    *((f"swimmer_{name}", 2, 7, 4, 20, 1.0) for name in ("knife_edge", "belly_up", "corkscrew", "depth_change")),
    *((f"swimmer_{name}", 6, 13, 18, 40, 0.5) for name in ("knife_edge", "belly_up", "corkscrew", "depth_change")),
]

TINY = ["model.hidden=[8]", "policy.hidden=[8]", "search.steps=5", "fit.steps=5", "search.particles=16", "trials=1"]
# The episode is the untrained policy's; without a refining half there is half as much to compile.
TINY += ["explore.trials=0", "search.refine_fraction=0", "search.init=better"]


def parse(*words: str) -> Config:
    return config_io.parse(config_io.split(words)[1])


def test_every_task_is_listed_here() -> None:
    assert {name for name, *_ in SHAPES} == {*tasks.TASKS}


@pytest.mark.parametrize(("name", "legs", "states", "controls", "horizon", "dt"), SHAPES)
def test_a_task_builds(name: str, legs: int, states: int, controls: int, horizon: int, dt: float) -> None:
    """Its shapes are the paper's, and its cost is low at no start and 1 at most."""
    experiment = build(parse(f"task={name}", *([f"legs={legs}"] if name.startswith("swimmer") else [])))
    task = experiment.task
    assert (len(task.state_names), len(task.control_names), task.horizon, task.dt) == (states, controls, horizon, dt)
    start = jnp.asarray(task.start_mean, jnp.float32)
    assert 0.5 < task.cost.of_state(start) <= 1
    assert jax.eval_shape(experiment.init, jax.random.key(0)).data.x.shape[1] == states
    policy = experiment.policy
    push = jax.tree.map(lambda leaf: 1e3 * jnp.ones_like(leaf), policy.init(jax.random.key(0)))
    for params in (push, jax.tree.map(jnp.negative, push)):
        u = np.asarray(policy.apply(params, None, start))
        assert np.all((u >= task.control_low - 1e-5) & (u <= task.control_high + 1e-5))


def test_tasks_bring_their_defaults() -> None:
    """docs/reference.md 2.2 and 3.4; a setting on the line wins over them."""
    double = parse("task=double_cartpole", "model=log_normal")
    assert (double.model.hidden, double.policy.hidden) == ((200,) * 4, (50,) * 4)
    assert (double.search.learning_rate, double.explore.trials, double.trials) == (1e-4, 2, 40)
    for legs, steps in ((2, 2000), (6, 4000)):
        words = ("task=swimmer_belly_up", f"legs={legs}")
        named = [parse(*words, "model=log_normal"), parse(*words, "algorithm=paper")]
        for config in named:
            assert (config.model.hidden, config.policy.hidden, config.policy.dropout) == ((200,) * 4, (200,) * 4, 0.1)
            assert (config.explore.trials, config.explore.kind, config.search.steps) == (2, "walk", 500)
            assert (config.model.dropout, config.model.ensemble_size) == ("log_normal", 1)
            assert (config.search.particles, config.search.learning_rate, config.fit.steps) == (200, 1e-3, steps)
        assert [config.model.kl_weight for config in named] == [0.1, 1]
    assert (named[0].trials, parse(*words, "model=log_normal", "trials=8").trials) == (50, 8)
    assert parse("task=swimmer_belly_up", "policy=mlp").policy.dropout == 0
    assert parse("task=swimmer_belly_up", "algorithm=deep_pilco").search.particles == 10


def test_the_resolved_config_survives_its_file(tmp_path: Path) -> None:
    config = parse("task=swimmer_corkscrew", "legs=6", "search.particles=20")
    config_io.save(config, tmp_path / "config.yaml")
    assert config_io.load(tmp_path / "config.yaml") == config


def test_an_unknown_task_is_named() -> None:
    with pytest.raises(ConfigError, match="did you mean 'double_cartpole'"):
        tasks.make("double_cartpol")


@pytest.mark.parametrize(
    "words",
    [
        pytest.param(["task=double_cartpole", "model.substeps=1"], marks=pytest.mark.campaign),
        pytest.param(["task=swimmer_knife_edge", "search.visited_starts=0"], marks=pytest.mark.slow),
    ],
    ids=" ".join,
)
def test_a_tiny_trial_through_the_command_line(words: list[str], tmp_path: Path) -> None:
    run = tmp_path / "run"
    done = forked.command("train", *words, *TINY, f"out={run}", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (row,) = store.trials(run)
    assert not row["random"]
    assert all(np.isfinite(value) for value in row.values() if isinstance(value, float))
    task = tasks.make(words[0].removeprefix("task="))
    ran = store.load_episode(run, 1)
    assert ran is not None
    u = ran.trajectory.u
    assert np.all((u >= task.control_low - 1e-5) & (u <= task.control_high + 1e-5))
    assert np.ptp(u, axis=0).min() > 0
    assert words[0] in json.loads((run / "run.json").read_text())["command"]


def test_a_mechanism_of_ones_own_is_five_and_takes_the_steps_that_its_coordinates_need() -> None:
    """`model=lagrangian` on a user's plant; three coordinates are integrated as with substeps=4, and not with 1."""
    own = config_io.parse({"task": "gym", "model": "lagrangian", "rates": "[2,3]"})
    assert (own.model.ensemble_size, own.model.substeps, own.fit.steps) == (5, None, 1000)
    task, x, u = tasks.make("double_cartpole"), jnp.array([0.1, 0.2, 3.0, -4.0, 2.0, 1.0]), jnp.array([5.0])
    data = Dataset(jnp.ones((4, 6)), jnp.ones((4, 1)), jnp.arange(24.0).reshape(4, 6), jnp.int32(4))
    changes = {}
    for substeps in (None, 1, 4):
        dynamics = dynamics_of(Lagrangian(ensemble_size=1, dropout="none", substeps=substeps), task)

        @jax.jit
        def change(dynamics=dynamics):
            posterior = dynamics.posterior(dynamics.init(jax.random.key(0)), data)
            return dynamics.apply(posterior, dynamics.sample(jax.random.key(1), posterior), x, u).mean

        changes[substeps] = change()
    assert (changes[None] == changes[4]).all()
    assert not jnp.allclose(changes[None], changes[1])


def test_what_is_not_drawn_or_not_observed_is_noted() -> None:
    fixed, drawn = lambda key: jnp.ones(2), lambda key: jax.random.uniform(key, (2,))
    for value, count in ((fixed, 1), (drawn, 0)):
        task = tasks.make("cartpole")._replace(goal=Signal(value, (1.0, 1.0)))
        found = assumed.goals(Config(goals=value), task)
        assert [note.partition(" for each")[2][:12] for note in found] == [" of 100 keys"] * count
    file = (
        "<mujoco><worldbody><body><joint name='j'/><geom size='.1'/></body></worldbody>"
        "<actuator><general joint='j' dyntype='filter' dynprm='.1'/></actuator></mujoco>"
    )
    plant = SimpleNamespace(model=mujoco.MjModel.from_xml_string(file))
    for history, count in ((1, 1), (2, 0)):
        found = assumed.actuators(Config(task="mjcf", history=history), tasks.make("cartpole")._replace(plant=plant))
        assert len(found) == count
