"""Learn the cart-pole swing-up from Python, and draw the raw learning curve.

    python cartpole.py [trials=6] [fit=3000] [search=1000]

A trial is one episode of 2.5 s on the plant. After each, the policy is tried in 20 more episodes that are not data.
Writes cartpole.png: a point for each of those episodes.
"""

import sys
from dataclasses import replace

import jax
import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

import pegasus_jax as pg


def main(words: list[str]) -> None:
    config = pg.preset("cartpole")  # the settings of the command pegasus-train task=cartpole
    steps = {"trials": 6, "fit": config.fit.steps, "search": config.search.steps}
    steps |= {name: int(value) for name, value in (word.split("=") for word in words)}
    config = replace(
        config,
        trials=steps["trials"],
        fit=replace(config.fit, steps=steps["fit"]),
        search=replace(config.search, steps=steps["search"]),
    )
    experiment = pg.build(config)
    task = experiment.task

    trial = jax.jit(lambda state: pg.trial(state, experiment, episodes=20))
    state = jax.jit(experiment.init)(jax.random.key(config.seed))
    curve = []
    for number in range(1, config.trials + 1):
        state, info = trial(state)  # one episode, a fit of the model, a search of the policy, the evaluation
        costs = np.asarray(info.evaluation)  # [episodes, control periods]
        curve.append(costs.mean(1))
        solved = np.mean(costs[:, -5:].mean(1) < task.success)
        print(f"trial {number}: {number * task.horizon * task.dt:4.1f} s on the plant,", end=" ")
        print(f"mean cost {costs.mean():.3f}, {solved:.0%} of the episodes swing up", flush=True)

    figure, axis = plt.subplots()
    for number, costs in enumerate(curve, 1):
        axis.plot(np.full(len(costs), number), costs, "C0o", alpha=0.3)
    axis.plot(range(1, len(curve) + 1), [costs.mean() for costs in curve], "C0")
    axis.set(xlabel="trial", ylabel="mean cost a control period", title=f"{task.name}, seed {config.seed}")
    figure.savefig("cartpole.png")


if __name__ == "__main__":
    main(sys.argv[1:])
