"""How the cost of a model grows with the data: a BNN's does not, a Gaussian process's does.

    python -m benchmarks.speed.growth [rows=50,100,200,400,800] [repeats=3] [setting=value ...]

For each method and number of rows n, on the cart-pole: one evaluation of the model's loss and its gradient (of all rows
for a Gaussian process, of a minibatch for a BNN), conditioning on the data, drawing K = 100 functions, and an iteration
of the policy search, a quarter of a search of 4: it includes a quarter of one conditioning and of two draws, where a
search of 100 includes a hundredth. The search follows K particles unless set otherwise, or PILCO's analytic moments
with an RBF policy, in double precision; H = 25. Prints a table and writes benchmarks/results/growth.json. On a machine
that others use, pin it to one CPU (`taskset -c 0`): it then counts its own seconds only.
"""

import shlex
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks import RESULTS, command, number, numbers
from benchmarks.speed.timing import compiled, in_turn, matmul, summary
from benchmarks.speed.workloads import ALIKE
from pegasus_jax.assembly.experiments import build, set_precision
from pegasus_jax.learn import data as dataset
from pegasus_jax.runs import config_io
from pegasus_jax.runs.files import write_json
from pegasus_jax.runs.machine import about
from pegasus_jax.types import Batch, Dataset, Trajectory

PILCO = {"policy": "rbf", "algorithm": "pilco"}
# name: (what it is, the most rows it is measured with: analytic moments of an exact process take minutes beyond)
METHODS: dict[str, tuple[dict[str, str], int]] = {
    "log_normal": ({"model": "log_normal", **ALIKE}, 10**6),
    "ssgp": ({"model": "ssgp", **ALIKE}, 10**6),
    "gp": ({"model": "gp", **ALIKE}, 10**6),
    "pilco, ssgp": ({"model": "ssgp", **PILCO}, 10**6),
    "pilco, gp": ({"model": "gp", **PILCO}, 200),
}
PARTICLES = 100
STEPS = 4  # search iterations in one call


def experience(rows: int, states: int, controls: int) -> Dataset:
    """A full data set of smooth made-up transitions."""
    walk, force = jax.random.split(jax.random.key(0))
    x = jnp.cumsum(0.1 * jax.random.normal(walk, (rows + 1, states)), 0)
    u = jax.random.uniform(force, (rows, controls), minval=-10, maxval=10)
    return dataset.add(dataset.empty(rows, states, controls), Trajectory(x, u, jnp.zeros(rows)), ())


def costs(method: dict[str, str], rows: int, words: dict[str, str], repeats: int) -> dict[str, float]:
    """Milliseconds of each part."""
    config = config_io.parse({**method, **words, "trials": str(-(-rows // 25))})
    set_precision(config)
    experiment = build(config)
    dynamics, task = experiment.dynamics, experiment.task
    data = experience(rows, len(task.state_names), len(task.control_names))
    state = jax.jit(experiment.init)(jax.random.key(0))._replace(data=data, trial=jnp.int32(1))
    params, prepared = state.model.params, jax.jit(dynamics.prepare)(data)
    batch = Batch(*(column[:100] for column in data[:3]))
    posterior = jax.jit(dynamics.posterior)(params, data)
    keys = jax.random.split(jax.random.key(1), PARTICLES)
    timed: dict[str, tuple[Any, ...]] = {
        "loss": (jax.value_and_grad(dynamics.loss), params, keys[0], batch, prepared),
        "condition": (dynamics.posterior, params, data),
        "draw": (jax.vmap(dynamics.sample, (0, None)), keys, posterior),
        "search": (partial(experiment.search, steps=STEPS), state, jnp.int32(0)),
    }
    times = in_turn({name: compiled(*call)[0] for name, call in timed.items()}, repeats)
    per = {"search": STEPS}
    return {name: summary(each, per.get(name, 1))["min_ms"] for name, each in times.items()}


def main(words: list[str]) -> None:
    """The command line of this module."""
    options, dotted = config_io.split(words, ("rows", "repeats"))
    sizes, repeats = numbers(options, "rows", "50,100,200,400,800"), number(options, "repeats", 3)
    config_io.parse(METHODS["log_normal"][0] | dotted)  # what cannot be is said before the table begins
    table: list[dict[str, Any]] = []
    print(
        f"{'method':12s}{'n':>6s}" + "".join(f"{name + ' ms':>14s}" for name in ("loss", "condition", "draw", "search"))
    )
    for name, (method, most) in METHODS.items():
        for rows in (n for n in sizes if n <= most):
            row = costs(method, rows, dotted, repeats)
            table.append({"method": name, "rows": rows, **row})
            print(f"{name:12s}{rows:6d}" + "".join(f"{value:14.2f}" for value in row.values()), flush=True)
    jax.config.update("jax_enable_x64", False)
    products = 500
    reference = summary(in_turn({"matmul": matmul(products)}, repeats)["matmul"], products)["min_ms"]
    print(f"matmul 100x200x200: {reference:.3f} ms")
    command = shlex.join(["python", "-m", "benchmarks.speed.growth", *words])
    write_json(RESULTS / "growth.json", {"rows": table, "matmul_ms": reference, "about": about(command)})


if __name__ == "__main__":
    command(main, __doc__)
