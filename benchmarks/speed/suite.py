"""Speed here: a search step at the paper's sizes, and every other part of a trial, beside plain matrix products.

    python -m benchmarks.speed.suite [quick=true] [repeats=7] [out=FILE] [setting=value ...]

Prints one table and writes it, with versions and machine, to benchmarks/results/speed.json. Compare ratios within one
run: machines are noisy. `of products` is the time of a search step over that of its own matrix products, each timed
alone in the same process with the same shapes. On a process pinned to one CPU (taskset -c 0) times are CPU time.
"""

import resource
import shlex
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import RESULTS, command, number, writable
from benchmarks.speed.timing import clock, compiled, in_turn, matmul, own_products, summary
from benchmarks.speed.workloads import SIZES, Workload, flop, workload
from pegasus_jax.assembly.experiments import build
from pegasus_jax.config import Config
from pegasus_jax.runs import config_io
from pegasus_jax.runs.files import write_json
from pegasus_jax.runs.machine import about, cpus

STEPS, FIT_STEPS, PRODUCTS = 10, 100, 500  # steps, and products, in one timed run
Row = dict[str, float]
Words = dict[str, str]

# What a gradient costs as one thing grows from the cart-pole's: the name, and the values as settings (or the horizon).
GROWTH = {
    "K": ("search.particles", ("30", "100", "300", "1000")),
    "H": ("horizon", ("12", "25", "50")),
    "width": ("model.hidden", ("[50,50]", "[200,200]", "[400,400]")),
}


def measure(function: Callable[..., Any], *arguments: Any, repeats: int, per: int = 1) -> Row:
    """Trace, compile and run time of a function of `per` steps, in turn with matrix products."""
    program, row = compiled(function, *arguments)
    times = in_turn({"program": program, "matmul": matmul(PRODUCTS)}, repeats)
    row |= summary(times["program"], per)
    row["of_matmul"] = row["min_ms"] / summary(times["matmul"], PRODUCTS)["min_ms"]
    return row


def search_step(work: Workload, repeats: int) -> Row:
    """A search step, the least it could cost, and how near its gradient is to the one in float64."""
    row = measure(partial(work.experiment.search, steps=STEPS), work.state, jnp.int32(1), repeats=repeats, per=STEPS)
    row["gflop"] = flop(work) / 1e9
    row["of_products"] = row["min_ms"] / own_products(work, repeats)
    return row | quality(work)


def quality(work: Workload) -> Row:
    """The objective, its error and its gradient's, relative to float64's and to the gradient's norm."""
    value = jax.value_and_grad(work.objective)
    given = (work.state.policy.params, work.posterior, work.scenarios)
    ours, gradient = jax.jit(value)(*given)
    with jax.enable_x64(True):
        exact, exact_gradient = jax.jit(value)(*jax.tree.map(widened, given))
    ours_flat, exact_flat = (
        np.concatenate([np.ravel(np.asarray(leaf)) for leaf in jax.tree.leaves(tree)])
        for tree in (gradient, exact_gradient)
    )
    return {
        "objective": float(ours),
        "objective_error": abs(float(ours) - float(exact)) / abs(float(exact)),
        "gradient_error": float(np.linalg.norm(ours_flat - exact_flat) / np.linalg.norm(exact_flat)),
    }


def widened(leaf: Any) -> Any:
    """The array in float64, if it is one of floats."""
    return jnp.asarray(leaf, jnp.float64) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf


def trial_parts(config: Config, repeats: int) -> dict[str, Row]:
    """What a trial has besides its search, on the task's own plant; and a whole trial, of few updates."""
    experiment = build(config)
    state = jax.jit(experiment.init)(jax.random.key(config.seed))
    began = clock()
    collect, add_episode = jax.jit(experiment.collect), jax.jit(experiment.add_episode)
    state = add_episode(state, collect(state))
    fit, search = (jax.jit(partial(part, steps=1)) for part in (experiment.fit, experiment.search))
    jax.block_until_ready(search(fit(state)[0])[0])
    first = clock() - began

    def trial(state: Any) -> Any:
        state = experiment.add_episode(state, experiment.collect(state))
        state, _ = experiment.fit(state, steps=FIT_STEPS)
        return experiment.search(state, steps=STEPS)[0]

    follow = (jax.random.key(0), state.policy.params, jnp.asarray(False))
    return {
        "first result": {"compile_s": first},
        "fit step": measure(partial(experiment.fit, steps=FIT_STEPS), state, repeats=repeats, per=FIT_STEPS),
        "plant episode": measure(experiment.episode, *follow, repeats=repeats),
        "imagine": measure(experiment.imagine, state, repeats=repeats),
        f"trial of {FIT_STEPS} + {STEPS} steps": measure(trial, state, repeats=repeats),
    }


def growth(words: Words, repeats: int) -> dict[str, Row]:
    """The gradient's cost against K, H, width and seeds; the fit's against the size of the data set."""
    rows = {}
    for name, (setting, values) in GROWTH.items():
        for value in values:
            work = workload(words, int(value)) if name == "H" else workload({**words, setting: value})
            rows[f"gradient, {name}={value}"] = gradient(work, repeats, 1)
    work = workload(words)
    for seeds in (1, 2, 5, 10):
        rows[f"gradient, seeds={seeds}"] = gradient(work, repeats, seeds)
    for trials in (15, 60, 240):
        work = workload({**words, "trials": str(trials)})
        fit = partial(work.experiment.fit, steps=FIT_STEPS)
        rows[f"fit step, N={len(work.state.data.x)}"] = measure(fit, work.state, repeats=repeats, per=FIT_STEPS)
    return rows


def gradient(work: Workload, repeats: int, seeds: int) -> Row:
    """The objective and its gradient for policies of several seeds at once."""
    params = jax.tree.map(lambda leaf: jnp.stack([leaf] * seeds), work.state.policy.params)
    value = jax.vmap(jax.value_and_grad(work.objective), (0, None, None))
    return measure(value, params, work.posterior, work.scenarios, repeats=repeats)


def suite(words: Words, repeats: int, quick: bool) -> dict[str, Row]:
    """Every row. `quick`: the cart-pole's alone, and nothing that grows."""
    rows = {}
    for name in list(SIZES)[: 1 if quick else None]:
        for match in ("always", "never"):
            suffix = "" if match == "always" else ", no matching"
            work = workload({**SIZES[name], "search.matching": match, **words})
            rows[f"search step, {name}{suffix}"] = search_step(work, repeats)
    if not quick:  # for its memory
        work = workload({**SIZES["six-legged swimmer"], "search.particles": "1000", **words})
        search = partial(work.experiment.search, steps=1)
        rows["search step, six-legged swimmer with K=1000"] = measure(search, work.state, jnp.int32(1), repeats=1)
    cartpole = {**SIZES["cart-pole"], **words}
    rows |= trial_parts(config_io.parse(cartpole), repeats)
    return rows if quick else rows | growth(cartpole, repeats)


COLUMNS = (
    *("trace_s", "compile_s", "min_ms", "median_ms", "of_matmul", "of_products"),
    *("gflop", "memory_mb", "objective_error", "gradient_error"),
)


def table(rows: dict[str, Row]) -> str:
    """The rows as text."""
    lines = [f"{'':44s}" + "".join(f"{name:>16s}" for name in COLUMNS)]
    for name, row in rows.items():
        lines.append(f"{name:44s}" + "".join(f"{row[c]:16.3g}" if c in row else f"{'':16s}" for c in COLUMNS))
    return "\n".join(lines)


def main(words: list[str]) -> None:
    """The command line of this module."""
    options, dotted = config_io.split(words, ("repeats", "quick", "out"))
    out = writable(options.get("out", RESULTS / "speed.json"))
    rows = suite(dotted, number(options, "repeats", 7), options.get("quick") == "true")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(table(rows))
    print(f"peak memory of the process {peak / 1e9:.2f} GB")
    machine = {"cpus": cpus()}
    command = shlex.join(["python", "-m", "benchmarks.speed.suite", *words])
    write_json(out, {"rows": rows, "peak_memory_bytes": peak, "machine": machine, "about": about(command)})


if __name__ == "__main__":
    command(main, __doc__)
