"""How soon a robot gets its next control: inside an episode, and from what a run leaves for deployment.

    python -m benchmarks.speed.latency [setting=value ...]

Learns for two short trials on an environment that answers at once and notes when it is called. Writes microseconds
(median, 99th percentile, most): benchmarks/results/latency.json, between the return of the environment's `step` and its
next call, and of one call of `controller`; benchmarks/results/latency_exports.json, of one call of each file that
`export` writes, C from C, the others from Python.
"""

import json
import runpy
import shlex
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
from jax import export as jax_export

from benchmarks import RESULTS, command
from pegasus_jax import controller, export, tasks
from pegasus_jax.exports.as_c import compiler
from pegasus_jax.runs import config_io
from pegasus_jax.runs.files import write_json
from pegasus_jax.runs.machine import about
from pegasus_jax.runs.train import train

TINY = {
    **{"fit.steps": "20", "search.steps": "20", "horizon": "200", "trials": "2", "eval_episodes": "5"},
    "policy.hidden": "[200,200]",  # the default one is narrower: this is the most that a network of ours takes
}
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


IN_C = """
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <time.h>
#include "controller.h"
int main(void) {
    float x[CONTROLLER_OBSERVATIONS] = {0}, u[CONTROLLER_CONTROLS];
    for (int call = 0; call < %d; ++call) {
        struct timespec began, ended;
        clock_gettime(CLOCK_MONOTONIC, &began);
        int failed = controller_act(x, u);
        clock_gettime(CLOCK_MONOTONIC, &ended);
        x[0] = u[0]; /* what is used is computed */
        if (failed) return 1;
        printf("%%.9f\\n", (double)(ended.tv_sec - began.tv_sec) + 1e-9 * (double)(ended.tv_nsec - began.tv_nsec));
    }
    return 0;
}
"""


def calls(act: Callable[[np.ndarray], Any], x: np.ndarray) -> list[float]:
    """Seconds that each call takes."""
    found = []
    for _ in range(CALLS):
        began = time.perf_counter()
        act(x)
        found.append(time.perf_counter() - began)
    return found


def exported(run: Path) -> dict[str, list[float]]:
    """Seconds of each call of the policy of a run, by the files that it is exported as."""
    files = {name: export(run, format=name) for name in ("numpy", "c", "onnx", "stablehlo")}
    session = onnxruntime.InferenceSession(files["onnx"].read_bytes(), providers=["CPUExecutionProvider"])
    of_jax = jax.jit(jax_export.deserialize(bytearray(files["stablehlo"].read_bytes())).call)
    of_jax(np.zeros(4, np.float32))  # compiles
    source, program = run / "speed.c", run / "speed"
    source.write_text(IN_C % CALLS)
    subprocess.run([*compiler(), "-std=c99", "-O2", str(source), "-o", str(program), "-lm"], check=True)
    in_c = subprocess.run([str(program)], check=True, capture_output=True, text=True).stdout
    return {
        "c": [float(line) for line in in_c.split()],
        "numpy": calls(runpy.run_path(str(files["numpy"]))["act"], np.zeros(4)),
        "onnx": calls(lambda x: session.run(None, {"observation": x}), np.zeros((1, 4), np.float32)),
        "stablehlo": calls(lambda x: np.asarray(of_jax(x)), np.zeros(4, np.float32)),
    }


def main(words: list[str]) -> None:
    """The command line of this module."""
    gymnasium.register("Still-v0", Still)
    _, dotted = config_io.split(words)
    fixed = {"task": "gym", "env": "Still-v0", "cost": "benchmarks.speed.latency:cost", "start_mean": "[0,0,0,0]"}
    config = tasks.resolve(config_io.parse({**fixed, **TINY, **dotted}))
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        train(config, run)
        ours = {"between steps": gaps, "controller": calls(controller(run), np.zeros(4))}
        found = {"latency": ours, "latency_exports": exported(run)}
    command = shlex.join(["python", "-m", "benchmarks.speed.latency", *words])
    for name, seconds in found.items():
        rows = {what: microseconds(times) for what, times in seconds.items()}
        write_json(RESULTS / f"{name}.json", {"rows": rows, "about": about(command)})
        print(json.dumps(rows))


if __name__ == "__main__":
    command(main, __doc__)
