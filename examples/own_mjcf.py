"""A MuJoCo model of your own: the hand of a flat arm with two links learns to reach a point and to stay there.

    python own_mjcf.py [trials=5] [fit=2000] [search=1000]

MJX simulates own_mjcf.xml inside the compiled program. `pegasus-play` films what was learned by the command:

    pegasus-train task=mjcf mjcf=own_mjcf.xml cost=own_mjcf:cost angles=[0,1] dt=0.1 horizon=20 trials=5
"""

import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp

import pegasus_jax as pg

TARGET = jnp.array([0.0, 0.8])  # [m]


def hand(x):
    """Place [m] of the hand for x = (shoulder, elbow [rad], their rates [rad/s]); both links are 0.5 m long."""
    shoulder, elbow = x[0], x[0] + x[1]
    return 0.5 * jnp.stack([jnp.cos(shoulder) + jnp.cos(elbow), jnp.sin(shoulder) + jnp.sin(elbow)])


def cost(x):
    """0 where the hand is at the target, 0.4 at a distance of 0.2 m, near 1 far away."""
    return 1 - jnp.exp(-jnp.sum((hand(x) - TARGET) ** 2) / (2 * 0.2**2))


def main(words: list[str]) -> None:
    asked = {"trials": 5, "fit": 2000, "search": 1000}
    asked |= {name: int(value) for name, value in (word.split("=") for word in words)}
    config = pg.preset("mjcf")
    config = replace(
        config,
        mjcf=str(Path(__file__).with_suffix(".xml")),
        cost="own_mjcf:cost",
        angles=(0, 1),
        dt=0.1,
        horizon=20,
        trials=asked["trials"],
        fit=replace(config.fit, steps=asked["fit"]),
        search=replace(config.search, steps=asked["search"]),
    )
    experiment = pg.build(config)
    trial = jax.jit(lambda state: pg.trial(state, experiment, episodes=10))
    state = jax.jit(experiment.init)(jax.random.key(0))
    for number in range(1, config.trials + 1):
        state, info = trial(state)
        print(f"trial {number}: mean cost {info.evaluation.mean():.3f}", end=", ")
        print(f"in the last five control periods {info.evaluation[:, -5:].mean():.3f}", flush=True)

    episode = jax.jit(experiment.episode)(jax.random.key(1), state.policy.params, False)
    for t in range(0, config.horizon + 1, 4):
        place = hand(episode.x[t])
        print(f"{t * config.dt:.1f} s  the hand is at ({place[0]:+.2f}, {place[1]:+.2f}) m")


if __name__ == "__main__":
    main(sys.argv[1:])
