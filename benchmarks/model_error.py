"""How well each model knows the next episode: one-step errors and calibration, from a few random episodes.

    python -m benchmarks.model_error [task=double_cartpole] [episodes=4,10,20] [models=gp,ssgp] [setting=value ...]

Fits each model to the same episodes of jumping controls, once after each number of episodes, and asks it about 20 more.
Writes benchmarks/results/model_error-TASK.json and prints, for each model and number of episodes, the median error of
each dimension over the deviation of its change, and the calibration (1: as wrong as it says; 2: twice as wrong).
"""

import json
import shlex
import sys
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.study import RESULTS
from pegasus_jax import episode
from pegasus_jax.assembly.experiments import build, set_precision
from pegasus_jax.config import Config
from pegasus_jax.math.angles import difference
from pegasus_jax.models.calibration import one_step_errors, overconfidence
from pegasus_jax.runs import config_io
from pegasus_jax.runs.machine import about
from pegasus_jax.types import Array, Key, RunState, Task, Trajectory

TESTS = 20
MODELS = "log_normal,binary,ensemble,gp,ssgp"
EXACT = {"gp": "true", "ssgp": "true"}  # a likelihood's last digits cancel in single precision


def random_walks(task: Task, episodes: int) -> Trajectory:
    """Episodes [N, ...] of controls that jump now and then."""
    low, high = jnp.asarray(task.control_low, float), jnp.asarray(task.control_high, float)

    def one(key: Key) -> Trajectory:
        plan_key, run_key = jax.random.split(key)
        plan = episode.random_walk(plan_key, low, high, task.horizon, move=0.35, pull=1.0)
        return episode.run(run_key, lambda _, t, x: plan[t], task)

    return jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), episodes))


def errors(config: Config, counts: list[int]) -> dict[str, Any]:
    """Episodes so far -> errors of a fit to them."""
    set_precision(config)
    experiment = build(config)
    task, dynamics = experiment.task, experiment.dynamics
    walks = random_walks(task, counts[-1] + TESTS)
    tests = jax.tree.map(lambda leaf: leaf[counts[-1] :], walks)
    scale = difference(tests.x[:, 1:], tests.x[:, :-1], task.angles).std((0, 1))

    @jax.jit
    def asked(state: RunState) -> tuple[Array, Array]:
        posterior = dynamics.posterior(state.model.params, state.data)
        one = partial(one_step_errors, jax.random.key(1), posterior, dynamics=dynamics, angles=task.angles)
        return jax.vmap(one)(tests)  # [N, H, D] each

    state, fit, found = jax.jit(experiment.init)(jax.random.key(config.seed)), jax.jit(experiment.fit), {}
    for count in range(1, counts[-1] + 1):
        state = experiment.add_episode(state, jax.tree.map(lambda leaf: leaf[count - 1], walks))  # noqa: B023
        if count in counts:
            state, _ = fit(state)
            error, variance = asked(state)
            found[str(count)] = {
                "median": rounded(jnp.median(jnp.abs(error), (0, 1)) / scale),
                "rms": rounded(jnp.sqrt((error**2).mean((0, 1))) / scale),
                "calibration": round(float(overconfidence(error, variance)), 2),
            }
    return found


def rounded(values: Array) -> list[float]:
    """As JSON should have them."""
    return np.asarray(values, float).round(3).tolist()


def main(words: list[str]) -> None:
    """The command line of this module."""
    options, rest = config_io.split(words, ("episodes", "models"))
    counts = sorted(int(count) for count in options.get("episodes", "4,10,20").split(","))
    rest = {"task": "double_cartpole", "trials": str(counts[-1])} | rest
    path = RESULTS / f"model_error-{rest['task']}.json"
    rows: dict[str, Any] = {}
    for model in options.get("models", MODELS).split(","):
        rows[model] = errors(config_io.parse({"x64": EXACT.get(model, "false"), "model": model} | rest), counts)
        for count, row in rows[model].items():
            print(
                f"{model:11s} {count:>3s} episodes  median {row['median']}  calibration {row['calibration']}",
                flush=True,
            )
        command = shlex.join(["python", "-m", "benchmarks.model_error", *words])
        path.write_text(json.dumps({"rows": rows, "about": about(command)}) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
