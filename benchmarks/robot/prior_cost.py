"""What a simulator as the model's mean costs: time to compile, and to imagine with its gradient, on one core.

    taskset -c 0 python -m benchmarks.robot.prior_cost

A link on a hinge with 10 MuJoCo steps a control period, as an MJCF file and as a function; 100 particles, 60 periods.
"""

import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks import command, none
from pegasus_jax import preset, tasks
from pegasus_jax.assembly.pieces import dynamics_of
from pegasus_jax.models.residual import residual
from pegasus_jax.types import Dataset
from pegasus_jax.vectorized import for_particles

LINK = """<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body>
      <joint name="elbow" type="hinge" axis="0 1 0" damping="0.05"{limits}/>
      <geom type="capsule" size="0.02" mass="0.43" fromto="0 0 0 0 0 1"/>
    </body>
  </worldbody>
  <actuator><motor joint="elbow" ctrlrange="-2 2"/></actuator>
</mujoco>"""
PARTICLES, PERIODS = 100, 60


def by_hand(x: jax.Array, u: jax.Array) -> jax.Array:
    """The link's equations, in ten steps."""
    for _ in range(10):
        rate = x[1] + 0.005 * (15 * jnp.sin(x[0]) + 7 * u[0] - 0.35 * x[1])
        x = jnp.stack([x[0] + 0.005 * rate, rate])
    return x


def seconds(prior: Any, file: Path) -> tuple[float, float]:
    """To compile and to run the gradient of an imagined rollout by a network's controls, with this prior or none."""
    words = {"mjcf": str(file), "cost": lambda x: 1 - jnp.cos(x[0]), "angles": (0,), "dt": 0.05, "horizon": PERIODS}
    config = replace(preset("mjcf"), **words, prior=prior)
    task = tasks.of_config(config)
    model = dynamics_of(config.model, task)
    model = model if task.prior is None else residual(model, task.prior, angles=task.angles)
    rows = jax.random.normal(jax.random.key(0), (30, 2)), jnp.zeros((30, 1)), 0.1 * jnp.ones((30, 2)), jnp.int32(30)
    posterior = model.posterior(model.init(jax.random.key(1)), Dataset(*rows))
    draws = jax.vmap(model.sample, (0, None))(jax.random.split(jax.random.key(2), PARTICLES), posterior)
    start = 0.1 * jax.random.normal(jax.random.key(3), (PARTICLES, 2))

    def cost(gain: jax.Array) -> jax.Array:
        def step(x: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
            after = x + for_particles(model.apply)(posterior, draws, x, jnp.tanh(x @ gain)[:, None]).mean
            return after, jnp.mean(1 - jnp.cos(after[:, 0]))

        return jnp.mean(jax.lax.scan(step, start, None, PERIODS)[1])

    began = time.monotonic()
    slope = jax.jit(jax.grad(cost)).lower(jnp.zeros(2)).compile()
    compiled, began = time.monotonic() - began, time.monotonic()
    for _ in range(3):
        jax.block_until_ready(slope(jnp.array([-1.0, -0.1])))
    return compiled, (time.monotonic() - began) / 3


def main(words: Sequence[str] = ()) -> None:
    """Print the table. Raises ConfigError for any word."""
    none(words)
    with tempfile.TemporaryDirectory() as folder:
        files = {name: Path(folder) / f"{name}.xml" for name in ("free", "limited")}
        files["free"].write_text(LINK.format(limits=""))
        files["limited"].write_text(LINK.format(limits=' range="-400 400" limited="true"'))
        print("| prior | to compile [s] | an iteration of a search [s] |\n|---|---|---|")
        ways = {"none": None, "a function": by_hand, "an MJCF file": str(files["free"])}
        ways["an MJCF file with a joint limit"] = str(files["limited"])
        for name, prior in ways.items():
            compiled, ran = seconds(prior, files["free"])
            print(f"| {name} | {compiled:.1f} | {ran:.2f} |", flush=True)


if __name__ == "__main__":
    command(main, __doc__)
