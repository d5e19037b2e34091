"""A run's folder as training leaves it, made in a moment: what is in it is drawn, not learned."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax import tasks
from pegasus_jax.assembly.experiments import assembled
from pegasus_jax.runs import checkpoint, config_io, store
from pegasus_jax.runs.restore import precision
from pegasus_jax.task import Task
from pegasus_jax.types import Trajectory

TINY = {"task": "cartpole", "model.hidden": "[3]", "policy.hidden": "[3]", "search.steps": "2", "search.particles": "8"}


def episode(task: Task, trial: int, length: int | None = None) -> Trajectory:
    """Rows of numbers that a plant could have sent."""
    draw, steps = np.random.default_rng(trial), task.horizon if length is None else length
    x = draw.normal(size=(steps + 1, len(task.state_names))).astype(np.float32)
    u = draw.uniform(task.control_low, task.control_high, (steps, len(task.control_names))).astype(np.float32)
    return Trajectory(x, u, draw.uniform(size=steps).astype(np.float32))  # type: ignore[arg-type]


def row(trial: int, **known: Any) -> dict[str, Any]:
    """A row of trials.jsonl."""
    numbers = dict(
        mean_cost=None, success_rate=None, objective_last=0.5, objective_fresh=0.5, plant_seconds=trial * 2.5
    )
    policy = {"random": trial == 1, "policy": trial - 1, "episode_success": False, "ended": "horizon"}
    return {"trial": trial, "episode_cost": 1 - trial / 10, **numbers, **policy, **known}


def a_run(run: Path, trials: int = 3, made: Task | None = None, **changes: str) -> Path:
    """The folder of a run of so many trials, each with an episode, a row and a checkpoint."""
    config = config_io.parse(TINY | {"trials": str(trials)} | {k.replace("__", "."): v for k, v in changes.items()})
    task = made or tasks.make(config.task)
    store.create(run)
    config_io.save(config, run / "config.yaml")
    store.note(run, "pegasus-train", 0, task)
    with precision(config):
        state = jax.jit(assembled(config, task, None, 0).init)(jax.random.key(config.seed))
        for trial in range(1, trials + 1):
            store.save_episode(run, trial, episode(task, trial), task, policy=trial - 1, ended="horizon")
            params = jax.tree.map(lambda leaf, trial=trial: leaf + trial / 10, state.policy.params)
            learned = state._replace(policy=state.policy._replace(params=params), trial=jnp.int32(trial))
            checkpoint.save(run, trial, learned)
    store.write_trials(run, [row(trial) for trial in range(1, trials + 1)])
    return run
