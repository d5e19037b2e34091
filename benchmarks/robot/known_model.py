"""How far a policy search comes where the model is not what limits it: the cart-pole by positions, its equations known.

    python -m benchmarks.robot.known_model [delay=1] [seeds=100-105] [searches=4] [setting=value ...]

As `benchmarks.robot.sensors cartpole`, but imagined with the true equations (cartpole_by_hand.py), so there is nothing
to fit. Each search is one of a run in which no episode has succeeded yet. Prints, after each of them, the mean cost a
step of 100 episodes and the share that succeeded. Tuning seeds are 100 to 119.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import command, number
from benchmarks.robot.cartpole_by_hand import exact
from benchmarks.robot.sensors import CARTPOLE
from pegasus_jax import episode, tasks
from pegasus_jax.assembly.experiments import compose
from pegasus_jax.config import Config
from pegasus_jax.runs import config_io
from pegasus_jax.runs.study import seed_list
from pegasus_jax.types import Dynamics, Prediction

EPISODES = 100


def known() -> Dynamics:
    """The true equations as a model, which has nothing to learn and no noise to speak of."""

    def apply(_: Any, __: Any, x: jax.Array, u: jax.Array) -> Prediction:
        return Prediction(exact(x, u) - x, jnp.full(4, 1e-3))

    return Dynamics(
        init=lambda key: jnp.zeros(1),
        prepare=lambda data: None,
        loss=lambda params, key, batch, context: jnp.zeros(()),
        posterior=lambda params, data: params,
        sample=lambda key, posterior: jnp.zeros(()),
        apply=apply,
    )


def searched(config: Config, seeds: list[int], searches: int) -> list[list[tuple[float, float]]]:
    """(mean cost, success) after each search of each seed."""
    experiment = compose(config, tasks.of_config(config), dynamics=known())
    collect, search = jax.jit(experiment.collect), jax.jit(experiment.search)
    judge = jax.jit(jax.vmap(lambda key, params: experiment.episode(key, params, False).cost, (0, None)))
    found = []
    for seed in seeds:
        state, row = experiment.init(jax.random.key(seed)), []
        for _ in range(searches):
            state = experiment.add_episode(state, collect(state))._replace(succeeded=jnp.bool_(False))
            state, _ = search(state)
            costs = np.asarray(judge(jax.random.split(jax.random.key(7), EPISODES), state.policy.params))
            row.append((float(np.mean(costs)), float(np.mean(episode.succeeded(costs, experiment.task)))))
        found.append(row)
        print(f"seed {seed}  " + "  ".join(f"{cost:.3f} {success:4.0%}" for cost, success in row), flush=True)
    return found


def main(given: list[str]) -> None:
    """The command line of this module. Raises ConfigError for what it cannot use."""
    options, words = config_io.split(given, ("delay", "seeds", "searches"))
    own = dict(word.split("=", 1) for word in CARTPOLE) | {"sensors.delay": options.get("delay", "1")}
    seeds, searches = seed_list(options.get("seeds", "100-105")), number(options, "searches", 4)
    found = searched(config_io.parse(own | words), seeds, searches)
    below = [sum(row[i][0] < 0.5 for row in found) for i in range(searches)]
    print(f"cost below .5 after searches 1 to {searches}: {' '.join(map(str, below))} of {len(seeds)}")


if __name__ == "__main__":
    command(main, __doc__)
