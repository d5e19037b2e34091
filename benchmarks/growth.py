"""How the cost of a model grows with the data: a BNN's does not, a Gaussian process's does.

    python -m benchmarks.growth [rows=50,100,200,400,800] [repeats=3] [setting=value ...]

For each model and number of rows n: one evaluation of the loss and its gradient (of all rows for a Gaussian process, of
a minibatch for a BNN), conditioning on the data, drawing the particles' functions, and a step of the policy search (K =
100 particles, H = 25 steps unless set otherwise), on the cart-pole. Prints a table and writes
benchmarks/results/growth.json. Compare within one run: machines are noisy.
"""

import json
import shlex
import sys
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.suite import RESULTS, matmul, measure
from pegasus_jax import dataset, settings
from pegasus_jax.build import build, set_precision
from pegasus_jax.record import about
from pegasus_jax.types import Batch, Dataset, Trajectory

MODELS = ("log_normal", "ssgp", "gp")
STEPS = 4  # search steps in one call


def experience(rows: int, states: int, controls: int) -> Dataset:
    """A full data set of smooth made-up transitions."""
    walk, force = jax.random.split(jax.random.key(0))
    x = jnp.cumsum(0.1 * jax.random.normal(walk, (rows + 1, states)), 0)
    u = jax.random.uniform(force, (rows, controls), minval=-10, maxval=10)
    return dataset.add(dataset.empty(rows, states, controls), Trajectory(x, u, jnp.zeros(rows)), ())


def costs(model: str, rows: int, words: dict[str, str], repeats: int) -> dict[str, float]:
    """Milliseconds of each part."""
    config = settings.parse({**words, "model": model, "trials": str(-(-rows // 25))})
    experiment = build(config)
    dynamics, task = experiment.dynamics, experiment.task
    data = experience(rows, len(task.state_names), len(task.control_names))
    state = jax.jit(experiment.init)(jax.random.key(0))._replace(data=data, trial=jnp.int32(1))
    params, prepared = state.model.params, jax.jit(dynamics.prepare)(data)
    batch = Batch(*(column[:100] for column in data[:3]))
    belief = jax.jit(dynamics.condition)(params, data)
    keys = jax.random.split(jax.random.key(1), config.search.particles)
    timed: dict[str, tuple[Any, ...]] = {
        "loss": (jax.value_and_grad(dynamics.loss), params, keys[0], batch, prepared),
        "condition": (dynamics.condition, params, data),
        "draw": (jax.vmap(dynamics.sample, (0, None)), keys, belief),
        "search": (partial(experiment.search, steps=STEPS), state, jnp.int32(0)),
    }
    per = {"search": STEPS}
    return {name: measure(*call, repeats=repeats, per=per.get(name, 1))["min_ms"] for name, call in timed.items()}


def main(words: list[str]) -> None:
    """The command line of this module."""
    options, dotted = settings.split(words, ("rows", "repeats"))
    sizes = [int(n) for n in options.get("rows", "50,100,200,400,800").split(",")]
    repeats = int(options.get("repeats", "3"))
    set_precision(settings.parse(dotted))
    loop, arguments, _ = matmul()
    table: list[dict[str, Any]] = []
    print(
        f"{'model':12s}{'n':>6s}" + "".join(f"{name + ' ms':>14s}" for name in ("loss", "condition", "draw", "search"))
    )
    for model in MODELS:
        for rows in sizes:
            row = costs(model, rows, dotted, repeats)
            table.append({"model": model, "rows": rows, **row})
            print(f"{model:12s}{rows:6d}" + "".join(f"{value:14.2f}" for value in row.values()), flush=True)
    reference = measure(loop, *arguments, repeats=repeats, per=1000)["min_ms"]
    print(f"matmul 100x200x200: {reference:.3f} ms")
    RESULTS.mkdir(exist_ok=True)
    command = shlex.join(["python", "-m", "benchmarks.growth", *words])
    result = {"rows": table, "matmul_ms": reference, "about": about(command)}
    (RESULTS / "growth.json").write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
