"""Several seeds as one compiled program, and the raw learning curve of every seed.

    python study.py [seeds=4] [trials=6] [fit=3000] [search=1000]

Writes study.png and study.csv, a line a seed: the mean cost of its evaluation episodes after each trial.
"""

import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

import pegasus_jax as pg


def main(words: list[str]) -> None:
    config = pg.preset("cartpole")
    asked = {"seeds": 4, "trials": 6, "fit": config.fit.steps, "search": config.search.steps}
    asked |= {name: int(value) for name, value in (word.split("=") for word in words)}
    config = replace(
        config,
        trials=asked["trials"],
        fit=replace(config.fit, steps=asked["fit"]),
        search=replace(config.search, steps=asked["search"]),
    )
    whole = pg.run(pg.build(config), config.trials, episodes=5)  # key -> (state, TrialInfo): a run as one function
    keys = jax.vmap(jax.random.key)(jnp.arange(asked["seeds"]))
    _, info = jax.jit(jax.vmap(whole))(keys)

    curves = np.asarray(info.evaluation).mean((2, 3))  # [seeds, trials, episodes, control periods] -> [seeds, trials]
    for seed, curve in enumerate(curves):
        print(f"seed {seed}: " + " ".join(f"{cost:.3f}" for cost in curve))
    np.savetxt("study.csv", curves, "%.4f", delimiter=",")
    figure, axis = plt.subplots()
    axis.plot(range(1, config.trials + 1), curves.T)
    axis.set(xlabel="trial", ylabel="mean cost a control period", title=f"{config.task}, {len(curves)} seeds")
    figure.savefig("study.png")


if __name__ == "__main__":
    main(sys.argv[1:])
