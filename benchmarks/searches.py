"""How many searches get there: from fresh policies, under the models of a few runs, settings side by side.

    python -m benchmarks.searches [seeds=0-5] [after=2,4] [fresh=12] [each="A=1 B=2; C=3"] [setting=value ...]

Every seed is run for the last of the trials `after`; in each of them its model is kept. Under each kept model `fresh`
policies that know nothing are searched, once with the run's settings and once with each of the variants, which are
parted by semicolons, and their words by spaces. Writes OUT/searches.json (out=benchmarks/results) after every variant:
the cost of each search's policy on fresh imagined rollouts. This is for a GPU; a CPU takes a minute a search.
"""

import json
import shlex
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.study import RESULTS
from pegasus_jax.assembly.experiments import build, set_precision
from pegasus_jax.config import Config
from pegasus_jax.experiment import trial
from pegasus_jax.runs import config_io
from pegasus_jax.runs.machine import about
from pegasus_jax.runs.programs import FAST_RUN, compiler_options
from pegasus_jax.studies.study import seed_list
from pegasus_jax.types import Array, RunState

FRESH = 99  # seed of the policies that know nothing


def learned(config: Config, seeds: list[int], after: list[int]) -> RunState:
    """States [T S, ...] of the seeds after each of the trials."""
    experiment = build(config)
    states = jax.jit(jax.vmap(experiment.init))(jax.vmap(jax.random.key)(jnp.asarray(seeds, jnp.uint32)))
    step = jax.jit(jax.vmap(lambda state: trial(state, experiment)[0]))
    step = step.lower(states).compile(compiler_options=compiler_options(FAST_RUN))
    kept = []
    for count in range(1, max(after) + 1):
        states = step(states)
        kept += [states] * (count in after)
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *kept)


def searched(config: Config, states: RunState, fresh: int) -> Array:
    """Imagined costs [T S, fresh] after a search from each of so many fresh policies."""
    experiment = build(config)

    def one(state: RunState, index: Array) -> Array:
        begun = experiment.init(jax.random.fold_in(jax.random.fold_in(jax.random.key(FRESH), state.trial), index))
        own = state._replace(policy=begun.policy, key=jax.random.fold_in(state.key, index))
        return jnp.mean(experiment.imagine(experiment.search(own)[0])[1])

    program = jax.jit(jax.vmap(jax.vmap(one, (None, 0)), (0, None)))
    indices = jnp.arange(fresh)
    return program.lower(states, indices).compile(compiler_options=compiler_options(FAST_RUN))(states, indices)


def main(words: list[str]) -> None:
    """The command line of this module."""
    options, dotted = config_io.split(words, ("seeds", "after", "fresh", "each", "out"))
    config = config_io.parse(dotted)
    set_precision(config)
    after = [int(text) for text in options.get("after", "2,4").split(",")]
    states = learned(config, seed_list(options.get("seeds", "0-5")), after)
    path = Path(options.get("out", RESULTS)) / "searches.json"
    result: dict[str, Any] = {
        "imagined": {},
        "about": about(shlex.join(["python", "-m", "benchmarks.searches", *words])),
    }
    for variant in ["", *filter(None, map(str.strip, options.get("each", "").split(";")))]:
        changes = dict(word.split("=", 1) for word in variant.split())
        changed = config_io.parse({**dotted, **changes, "search.init": "previous"})
        costs = np.asarray(searched(changed, states, int(options.get("fresh", "12"))))
        result["imagined"][variant or "as it is"] = costs.round(4).tolist()
        path.write_text(json.dumps(result) + "\n")
        print(f"{variant or 'as it is':60s}", line(costs), flush=True)


def line(costs: np.ndarray) -> str:
    """What there is to say of searches that ended at these costs."""
    return (
        f"mean {costs.mean():.3f}  median {np.median(costs):.3f}"
        f"  below .35 {np.mean(costs < 0.35):.0%}, .6 {np.mean(costs < 0.6):.0%}  above .8 {np.mean(costs > 0.8):.0%}"
    )


if __name__ == "__main__":
    main(sys.argv[1:])
