"""Speed here: trace, compile and run time of each part of a trial, beside a plain matmul in the same process.

    python -m benchmarks.suite [repeats=7] [setting=value ...]

Prints a table and writes benchmarks/results/speed.json. Compare ratios within one run: machines are noisy.
"""

import itertools
import json
import resource
import shlex
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from pegasus_jax import settings
from pegasus_jax.build import build
from pegasus_jax.config import Config
from pegasus_jax.record import about

RESULTS = Path(__file__).parent / "results"
MATMULS = 1000  # a loop long enough that starting it does not count


def measure(function: Callable[..., Any], *arguments: Any, repeats: int, per: int = 1) -> dict[str, float]:
    """Seconds to trace and compile, and milliseconds to run (each of `per` steps inside one call)."""
    began = time.perf_counter()
    lowered = jax.jit(function).lower(*arguments)
    traced = time.perf_counter()
    compiled = lowered.compile()
    ready = time.perf_counter()
    jax.block_until_ready(compiled(*arguments))
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(compiled(*arguments))
        times.append((time.perf_counter() - start) / per * 1e3)
    return {
        "trace_s": traced - began,
        "compile_s": ready - traced,
        "min_ms": min(times),
        "median_ms": statistics.median(times),
    }


def matmul(rows: int = 100, width: int = 200) -> tuple[Callable[..., Any], tuple[Any, Any], float]:
    """A loop of (rows x width)(width x width) products, its arguments, and the FLOP of one."""
    x, w = jnp.ones((rows, width)), jnp.eye(width) * 0.999

    def loop(x: Any, w: Any) -> Any:
        return jax.lax.fori_loop(0, MATMULS, lambda _, h: h @ w, x)

    return loop, (x, w), 2.0 * rows * width * width


def search_flop(config: Config, states: int, features: int, controls: int, horizon: int) -> float:
    """Multiply-adds that a search step cannot avoid: both networks forward and back to their inputs, and the weight
    gradients of the policy."""

    def weights(inputs: int, hidden: tuple[int, ...], outputs: int) -> int:
        sizes = (inputs, *hidden, outputs)
        return sum(a * b for a, b in itertools.pairwise(sizes))

    model = weights(features + controls, config.model.hidden, states * (1 + config.model.heteroscedastic))
    policy = weights(features, config.policy.hidden, controls)
    return 2.0 * config.search.particles * horizon * (2 * model + 3 * policy)


def suite(config: Config, repeats: int) -> dict[str, dict[str, float]]:
    """Every part of one trial, measured on a state that has one episode."""
    experiment = build(config)
    task = experiment.task
    state = jax.jit(experiment.init)(jax.random.key(config.seed))
    state = jax.jit(experiment.absorb)(state, jax.jit(experiment.collect)(state))
    loop, arguments, flop = matmul()
    rows = {"matmul 100x200x200": measure(loop, *arguments, repeats=repeats, per=MATMULS)}
    peak = flop / rows["matmul 100x200x200"]["min_ms"]
    steps = 20
    search = partial(experiment.search, steps=steps)
    features = len(task.state_names) + len(task.angles)
    rows["search step"] = measure(search, state, jnp.int32(0), repeats=repeats, per=steps)
    needed = search_flop(config, len(task.state_names), features, len(task.control_names), task.horizon)
    rows["search step"]["gflop"] = needed / 1e9
    rows["search step"]["of_matmul_peak"] = needed / rows["search step"]["min_ms"] / peak
    fit = partial(experiment.fit, steps=200)
    rows["fit step"] = measure(fit, state, repeats=repeats, per=200)
    follow = (jax.random.key(0), state.policy.params, jnp.asarray(False))
    rows["plant episode"] = measure(experiment.episode, *follow, repeats=repeats)
    rows["imagine"] = measure(experiment.imagine, state, repeats=repeats)
    for row in rows.values():
        row["of_matmul"] = row["min_ms"] / rows["matmul 100x200x200"]["min_ms"]
    return rows


def table(rows: dict[str, dict[str, float]]) -> str:
    """The rows as text."""
    columns = ("trace_s", "compile_s", "min_ms", "median_ms", "of_matmul", "of_matmul_peak")
    lines = [f"{'':20s}" + "".join(f"{name:>16s}" for name in columns)]
    for name, row in rows.items():
        cells = "".join(f"{row[c]:16.3f}" if c in row else f"{'':16s}" for c in columns)
        lines.append(f"{name:20s}{cells}")
    return "\n".join(lines)


def main(words: list[str]) -> None:
    """The command line of this module."""
    options, dotted = settings.split(words, ("repeats",))
    rows = suite(settings.parse(dotted), int(options.get("repeats", "7")))
    peak_memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(table(rows))
    print(f"peak memory {peak_memory / 1e9:.2f} GB")
    RESULTS.mkdir(exist_ok=True)
    command = shlex.join(["python", "-m", "benchmarks.suite", *words])
    result = {"rows": rows, "peak_memory_bytes": peak_memory, "about": about(command)}
    (RESULTS / "speed.json").write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
