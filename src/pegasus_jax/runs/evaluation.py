"""How good policies are on their plant, by episodes that never become data."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax import episode, tasks
from pegasus_jax.episode import Episode
from pegasus_jax.imagine.limits import margin
from pegasus_jax.runs import checkpoint, restore
from pegasus_jax.runs.collect import failed
from pegasus_jax.runs.programs import Program, over_episodes, quick
from pegasus_jax.task import Task
from pegasus_jax.types import Key, Params

UNMEASURED: dict[str, Any] = {"mean_cost": None, "success_rate": None}  # what `evaluate` says without episodes


def evaluate(keys: Key, params: Params, task: Task, program: Program, episodes: int) -> list[dict[str, Any]]:
    """Mean cost a step and success rate of each seed [S], over fresh episodes, not data (docs/reference.md 10)."""
    if not episodes:
        return [UNMEASURED] * len(keys)
    keys = quick(splitting(episodes))(keys)
    costs = program.evaluate(keys, params) if task.environment is None else driven(keys, params, task, program)
    return [
        {"mean_cost": float(np.mean(cost)), "success_rate": float(np.mean(success))}
        for cost, success in zip(costs, episode.succeeded(costs, task), strict=True)
    ]


@cache
def splitting(episodes: int) -> Callable[[Key], Key]:
    """keys [S] -> keys [S, E]."""
    return jax.vmap(lambda key: jax.random.split(key, episodes))


def driven(keys: Key, params: Params, task: Task, program: Program) -> np.ndarray:
    """Costs [S, E, H] of episodes on an environment, the periods that an early end left out included."""
    costs = []
    for some in over_episodes(keys):
        for ran in program.collect(some, params, False, purpose="evaluate"):
            failed(ran, task, kept=False)
            costs.append(episode.charged(ran.trajectory.cost, task))
    return np.reshape(costs, (keys.shape[1], keys.shape[0], task.horizon)).swapaxes(0, 1)


def saturated(u: Any, task: Task) -> dict[str, Any]:
    """The share of an episode's controls [H, U] that are within 1 % of a limit: of all, and of each by its name."""
    low, high = np.asarray(task.control_low), np.asarray(task.control_high)
    near = 0.01 * (high - low)
    u = np.asarray(u)
    shares = np.mean((u < low + near) | (u > high - near), axis=0)
    each = dict(zip(task.control_names, shares.tolist(), strict=True))
    return {"saturated": float(np.mean(shares)), "saturated_controls": each}


def kept_to(ran: Episode, task: Task) -> dict[str, Any]:
    """Whether an episode broke the task's constraint, and the share of its rows that did; nothing without one."""
    if task.constraint is None:
        return {}
    x = np.asarray(ran.trajectory.x)[1:]
    broken = np.asarray(margin(jnp.asarray(x, float), task.constraint)) > 0
    return {"constraint_broken": bool(broken.any()), "constraint_rows": float(broken.mean()) if broken.size else 0.0}


def evaluate_run(
    run: Path,
    episodes: int,
    seed: int,
    trial: restore.Trial = restore.BEST,
    mjcf: str | None = None,
) -> dict[str, Any]:
    """How the policy of a trial does on its plant, and the run's fingerprint then.

    `mjcf` is where the model's file is now, if it is not where it was.
    """
    _, experiment, state = restore.ready(run, trial, mjcf)
    program = Program(experiment, 1)
    params = jax.tree.map(lambda leaf: leaf[None], state.policy.params)
    keys = jax.random.key(seed)[None]
    try:
        (result,) = evaluate(keys, params, experiment.task, program, episodes)
    finally:
        tasks.close(experiment.task)
    return {"trial": int(state.trial), "episodes": episodes, **result, "fingerprint": checkpoint.fingerprint(state)}
