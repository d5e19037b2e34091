"""How soon a robot gets its next control: inside an episode, and from what a run leaves for deployment.

    python -m benchmarks.speed.latency [setting=value ...]

Learns for two short trials on an environment that answers at once and notes when it is called. Writes
benchmarks/results/latency.json: microseconds (median, 99th percentile, most) between the return of the environment's
`step` and its next call, and of one call of `controller`.
"""

import json
import shlex
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium
import jax.numpy as jnp
import numpy as np

from benchmarks import RESULTS
from pegasus_jax import controller, tasks
from pegasus_jax.runs import config_io
from pegasus_jax.runs.machine import about
from pegasus_jax.runs.train import train

TINY = {"fit.steps": "20", "search.steps": "20", "horizon": "200", "trials": "2", "eval_episodes": "5"}
CALLS = 2000
gaps: list[float] = []


class Still(gymnasium.Env):
    """Four numbers that never change, and one control."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (4,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    left = 0.0

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        self.left = 0.0
        return np.zeros(4), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        if self.left:
            gaps.append(time.perf_counter() - self.left)
        answer = np.full(4, float(action[0])), 0.0, False, False, {}
        self.left = time.perf_counter()
        return answer


def cost(x: Any) -> Any:
    """Of the first number."""
    return 1 - jnp.exp(-(x[0] ** 2))


def microseconds(seconds: list[float]) -> dict[str, float]:
    """What a control loop wants to know of so many times."""
    times = 1e6 * np.asarray(seconds)
    return {
        "median_us": float(np.median(times)),
        "99_us": float(np.quantile(times, 0.99)),
        "most_us": float(times.max()),
    }


def main(words: list[str]) -> None:
    """The command line of this module."""
    gymnasium.register("Still-v0", Still)
    _, dotted = config_io.split(words)
    fixed = {"task": "gym", "env": "Still-v0", "cost": f"{__name__}:cost", "start_mean": "[0]"}
    config = tasks.resolve(config_io.parse({**fixed, **TINY, **dotted}))
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        train(config, run)
        control, calls = controller(run), []
        for _ in range(CALLS):
            began = time.perf_counter()
            control(np.zeros(4))
            calls.append(time.perf_counter() - began)
    row = {"between steps": microseconds(gaps), "controller": microseconds(calls)}
    command = shlex.join(["python", "-m", "benchmarks.speed.latency", *words])
    (RESULTS / "latency.json").write_text(json.dumps({"rows": row, "about": about(command)}, indent=1) + "\n")
    print(json.dumps(row))


if __name__ == "__main__":
    main(sys.argv[1:])
