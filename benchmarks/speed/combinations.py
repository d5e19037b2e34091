"""What a step of the policy search costs for every model with every policy, on the cart-pole with 100 transitions.

    python -m benchmarks.speed.combinations [repeats=5] [setting=value ...]

K = 100 particles and H = 25 steps unless set otherwise; PILCO's analytic search takes one L-BFGS iteration, line search
included. Prints milliseconds and multiples of a (100 x 200)(200 x 200) product timed in turn with each, and writes
benchmarks/results/combinations.json.
"""

import shlex
from functools import partial

import jax
import jax.numpy as jnp

from benchmarks import RESULTS, command, number
from benchmarks.speed.growth import experience
from benchmarks.speed.timing import compiled, in_turn, matmul
from benchmarks.speed.workloads import ALIKE
from pegasus_jax.assembly.experiments import build, set_precision
from pegasus_jax.presets import MODELS, POLICIES
from pegasus_jax.runs import config_io
from pegasus_jax.runs.files import write_json
from pegasus_jax.runs.machine import about

STEPS, PRODUCTS = 4, 500  # in one call
PILCO = [
    {"model": model, "policy": policy, "algorithm": "pilco"} for model in ("ssgp", "gp") for policy in ("rbf", "linear")
]
COMBINATIONS = [{"model": model, "policy": policy, **ALIKE} for policy in POLICIES for model in MODELS] + PILCO


def step(words: dict[str, str], repeats: int) -> dict[str, float]:
    """Least milliseconds of a search step, seconds to compile it, and the step in products."""
    config = config_io.parse({"trials": "4", **words})
    set_precision(config)
    experiment = build(config)
    data = experience(100, len(experiment.task.state_names), len(experiment.task.control_names))
    state = jax.jit(experiment.init)(jax.random.key(0))._replace(data=data, trial=jnp.int32(4))
    search, row = compiled(partial(experiment.search, steps=STEPS), state, jnp.int32(0))
    times = in_turn({"search": search, "product": matmul(PRODUCTS)}, repeats)
    least, product = min(times["search"]) / STEPS, min(times["product"]) / PRODUCTS
    return {"min_ms": least, "compile_s": row["compile_s"], "of_product": least / product}


def main(words: list[str]) -> None:
    """The command line of this module; the file is written after every row."""
    options, dotted = config_io.split(words, ("repeats",))
    repeats = number(options, "repeats", 5)
    config_io.parse(COMBINATIONS[0] | dotted)  # what cannot be is said before the table begins
    result = {"rows": [], "about": about(shlex.join(["python", "-m", "benchmarks.speed.combinations", *words]))}
    print(f"{'model':15s}{'policy':14s}{'search':10s}{'ms':>9s}{'products':>10s}{'compile s':>11s}")
    for chosen in COMBINATIONS:
        row = step(chosen | dotted, repeats)
        result["rows"].append({**chosen, **row})
        write_json(RESULTS / "combinations.json", result)
        how = chosen.get("algorithm", "particles")
        numbers = f"{row['min_ms']:9.1f}{row['of_product']:10.0f}{row['compile_s']:11.1f}"
        print(f"{chosen['model']:15s}{chosen['policy']:14s}{how:10s}{numbers}", flush=True)


if __name__ == "__main__":
    command(main, __doc__)
