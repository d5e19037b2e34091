"""A search for the gains of `benchmarks.plants.feedback`: cross-entropy, from no knowledge but their signs and sizes.

    python -m benchmarks.plants.gains legs=2 task=knife_edge [generations=9] [seed=0]

Prints the best mean |e|^2 of each generation and the gains found. 32 candidates, 2 starts each; by default the depth
changes get 30 generations, the others 9.
"""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import command, number, only
from benchmarks.plants.feedback import NAMES, ROLL, episodes
from pegasus_envs.swimmer.plant import swimmer
from pegasus_jax.checks import choice

CANDIDATES, ELITE, STARTS = 32, 8, 2
GUESS = dict(zip(NAMES, (0.6, 0.3, 0.0, 0.5, 0.05, 0.2, 0.1, 0.5, 0.5, 0.4, 0.0), strict=True))
SPREAD = dict(zip(NAMES, (0.15, 0.2, 0.1, 0.4, 0.2, 0.2, 0.15, 0.3, 0.3, 0.6, 0.0), strict=True))


def search(task: str, legs: int, generations: int, seed: int) -> np.ndarray:
    """The mean of the last generation's elite [11]."""
    plant = swimmer(task, legs)  # pyright: ignore[reportArgumentType]
    rng, mean, std = np.random.default_rng(seed), np.array([*GUESS.values()]), np.array([*SPREAD.values()])
    if (legs, task) == (6, "depth_change"):
        mean[-1], std[-1] = 1.0, 0.7  # six legs can heave

    @jax.jit
    def score(gains: jax.Array, keys: jax.Array) -> jax.Array:
        states = jax.vmap(plant.reset)(jnp.tile(keys, CANDIDATES))
        which = jnp.zeros(CANDIDATES * STARTS, int)
        xs = episodes(plant, [task], which, jnp.repeat(gains, STARTS, axis=0), states)
        squares = jnp.sum(jax.vmap(jax.vmap(plant.error))(xs) ** 2, axis=-1)
        return squares.reshape(CANDIDATES, -1).mean(axis=1)

    for generation in range(1, generations + 1):
        gains = rng.normal(mean, std, (CANDIDATES, len(NAMES)))
        keys = jax.random.split(jax.random.key(seed + generation), STARTS)
        scores = np.asarray(score(jnp.asarray(gains, jnp.float32), keys))
        elite = gains[np.argsort(scores)[:ELITE]]
        mean, std = elite.mean(axis=0), elite.std(axis=0) + 0.01 * np.array([*SPREAD.values()])
        print(f"generation {generation:>2}: best {scores.min():.4f}, median {np.median(scores):.4f}", flush=True)
    return mean


def main(words: list[str]) -> None:
    """The command line of this module. Raises ConfigError for what it cannot use."""
    options = only(words, ("legs", "task", "generations", "seed"))
    task, legs = options.get("task", "knife_edge"), number(options, "legs", 2)
    choice("task", task, ROLL)
    choice("legs", legs, (2, 6))
    generations = number(options, "generations", 30 if task == "depth_change" else 9)
    print(np.round(search(task, legs, generations, number(options, "seed", 0, 0)), 3).tolist())


if __name__ == "__main__":
    command(main, __doc__)
