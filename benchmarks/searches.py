"""What searches end with, each from a policy of its own that knows nothing, under the model of a run.

    python -m benchmarks.searches RUN [trial=last] [policies=32] [out=FILE] [search.SETTING=value ...]

RUN is the folder of any run, and `trial` the one after which its model is taken. The settings are the run's own, but
for those of the search that are given here. All policies are searched for in one program, so on a GPU many take as
long as a few. Prints how much they are expected to cost a step on fresh scenarios, of which a run would have had one:
a spread says that the search decides, where they agree the model does, or the plant.
"""

import shlex
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import command, named
from pegasus_jax.assembly.experiments import compose
from pegasus_jax.checks import ConfigError, check_range, whole
from pegasus_jax.cli.runs import trial_of
from pegasus_jax.config import Search
from pegasus_jax.experiment import Experiment
from pegasus_jax.runs import config_io, restore
from pegasus_jax.runs.files import write_json
from pegasus_jax.runs.machine import about
from pegasus_jax.types import Array, Key, RunState

PARTS = (0.05, 0.25, 0.5, 0.75, 0.95)  # of the policies: their quantiles


def ended(experiment: Experiment, state: RunState, keys: Key) -> np.ndarray:
    """The imagined cost a step [P] of policies that are searched for under a run's model, each with its key [P]."""

    def one(key: Key) -> Array:
        began = state._replace(key=key, policy=experiment.init(key).policy, succeeded=jnp.bool_(False))
        found, _ = experiment.search(began)
        return jnp.mean(experiment.imagine(found)[1])

    return np.asarray(jax.jit(jax.vmap(one))(keys))


def main(given: list[str]) -> None:
    """The command line of this module. Raises ConfigError or RunError for what it cannot use."""
    run, words = named(given, "the folder of a run")
    options, dotted = config_io.split(words, ("trial", "policies", "out"))
    for name in dotted:
        if not name.startswith("search."):
            raise ConfigError(f"{name} is the run's own; expected settings of a search, as search.steps=500")
    trial, policies = options.get("trial", restore.LAST), whole("policies", options.get("policies", "32"))
    check_range("policies", policies, 1)
    config, known, state = restore.ready(Path(run), trial_of(trial))
    if not isinstance(config.search, Search) or not config.search.refine_fraction:
        raise ConfigError(f"{run} has a search that begins with the policy before; expected search.refine_fraction=0.5")
    config = config_io.override(config, {"search.init": "fresh"} | dotted)
    keys = jax.random.split(jax.random.key(config.seed), policies)
    costs = ended(compose(config, known.task), state, keys)
    print(
        f"{policies} policies after trial {int(state.trial)}, imagined cost: mean {costs.mean():.3f}, {spread(costs)}"
    )
    if "out" in options:
        told = about(shlex.join(["python", "-m", "benchmarks.searches", *given]))
        write_json(Path(options["out"]), {"imagined_cost": costs.tolist(), "about": told})


def spread(costs: np.ndarray) -> str:
    """The quantiles of costs [P] in words."""
    return ", ".join(
        f"{part:.0%} below {cost:.3f}" for part, cost in zip(PARTS, np.quantile(costs, PARTS), strict=True)
    )


if __name__ == "__main__":
    command(main, __doc__)
