"""The work that the speed benchmarks measure: search steps of the paper's sizes, on made-up data and a made-up cost.

The data need no plant, whose simulation would have to be compiled, and the cost is far from saturation, so that an
objective and its gradient say something.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax import tasks
from pegasus_jax.assembly.experiments import compose
from pegasus_jax.assembly.searchers import blocks_of
from pegasus_jax.config import Config
from pegasus_jax.experiment import Experiment
from pegasus_jax.imagine import costs, matching
from pegasus_jax.imagine.objective import objective
from pegasus_jax.imagine.scenarios import draw
from pegasus_jax.math.angles import encode
from pegasus_jax.runs import config_io
from pegasus_jax.task import Task
from pegasus_jax.types import (
    Array,
    Cost,
    Params,
    Period,
    RunState,
    Scenarios,
    Trajectory,
)

# Every iteration alike, as the paper's and the peers' are: what a search refines by is another program.
ALIKE = {"search.standardized_noise": "false", "search.refine_fraction": "0", "search.init": "better"}
SIZES = {
    "cart-pole": {
        "task": "cartpole",
        "model": "log_normal",
        "policy": "dropout_mlp",
        "search.particles": "100",
        **ALIKE,
    },
    "double cart-pole": {"task": "double_cartpole", "model": "log_normal", "search.particles": "100"},
    "six-legged swimmer": {
        "task": "swimmer_depth_change",
        "model": "log_normal",
        "legs": "6",
        "search.particles": "100",
        **ALIKE,
    },
    "cart-pole with K=1000": {
        "task": "cartpole",
        "model": "log_normal",
        "policy": "dropout_mlp",
        "search.particles": "1000",
        **ALIKE,
    },
}
EPISODES = 4  # of data


class Workload(NamedTuple):
    """One size: an experiment with data, and its objective on scenarios that stay as they are."""

    config: Config
    experiment: Experiment
    state: RunState  # with EPISODES of data and a model fitted for a moment
    posterior: Params
    scenarios: Scenarios
    objective: Callable[[Params, Params, Scenarios], Array]

    @property
    def task(self) -> Task:
        return self.experiment.task

    @property
    def features(self) -> int:
        """Inputs of the policy."""
        return len(self.task.state_names) + len(self.task.angles)


def workload(words: dict[str, str], horizon: int | None = None) -> Workload:
    """The workload of a configuration in `key=value` words, with another horizon than the task's if given."""
    config = config_io.parse(words)
    task = tasks.of_config(config)
    task = task._replace(cost=near(task), horizon=horizon or task.horizon)
    experiment = compose(replace(config, horizon=None), task)
    state = jax.jit(experiment.init)(jax.random.key(config.seed))
    add_episode = jax.jit(experiment.add_episode)
    for seed in range(EPISODES):
        state = add_episode(state, wandering(task, seed))
    state, _ = jax.jit(partial(experiment.fit, steps=200))(state)
    dynamics, policy = experiment.dynamics, experiment.policy
    posterior = jax.jit(dynamics.posterior)(state.model.params, state.data)
    blocks = blocks_of(config.search.particles, task, dynamics, policy)
    scenarios = jax.jit(partial(draw, blocks=blocks, period=Period()))(jax.random.key(1), 0, posterior)
    match = matching.keep if config.search.matching == "never" else matching.match
    value = partial(objective, dynamics=dynamics, policy=policy, match=match, cost=costs.of_particles(task.cost))
    return Workload(config, experiment, state, posterior, scenarios, value)


def goal(task: Task) -> Array:
    """Where `near` wants the features [F] of a state: one away from those of the first."""
    return encode(jnp.asarray(task.start_mean, float), task.angles) + 1.0


def near(task: Task) -> Cost:
    """1 - exp(-|features - goal|^2 / (2 F))."""
    target = goal(task)
    return costs.saturating(lambda x: encode(x, task.angles) - target, len(target) ** 0.5, task.angles)


def wandering(task: Task, seed: int) -> Trajectory:
    """An episode of a made-up stable system: each dimension is pulled to its start, pushed by controls and by noise."""
    noise, wiring = np.random.default_rng(seed), np.random.default_rng(0)
    low, high = np.asarray(task.control_low), np.asarray(task.control_high)
    u = noise.uniform(low, high, size=(task.horizon, len(low)))
    push = (u / np.maximum(high, -low)) @ wiring.normal(size=(len(low), len(task.state_names))) * 0.2
    x = [noise.normal(size=push.shape[1]) * 0.5]
    for force in push:
        x.append(0.8 * x[-1] + force + 0.2 * noise.normal(size=len(force)))
    return Trajectory(
        jnp.asarray(np.asarray(task.start_mean) + x, float), jnp.asarray(u, float), jnp.zeros(task.horizon)
    )


def layers(inputs: int, hidden: tuple[int, ...], outputs: int) -> list[tuple[int, int]]:
    """(inputs, outputs) of every layer of a network."""
    sizes = (inputs, *hidden, outputs)
    return list(pairwise(sizes))


def products(work: Workload) -> dict[tuple[str, int, int, int], int]:
    """The matrix products of one search step and how often each is needed: (kind, K, inputs, outputs) -> times.

    Of both networks the products forward and back to their inputs; of the policy those that give its weight gradients.
    """
    config, task = work.config, work.task
    states, controls = len(task.state_names), len(task.control_names)
    model = layers(work.features + controls, config.model.hidden, states * (1 + config.model.heteroscedastic))
    policy = layers(work.features, config.policy.hidden, controls)
    counted: dict[tuple[str, int, int, int], int] = {}
    for kind, network in (("forward", model + policy), ("back", model + policy), ("weights", policy)):
        for inputs, outputs in network:
            key = (kind, config.search.particles, inputs, outputs)
            counted[key] = counted.get(key, 0) + task.horizon
    return counted


def flop(work: Workload) -> float:
    """Floating-point operations of those products."""
    return sum(2.0 * rows * a * b * times for (_, rows, a, b), times in products(work).items())
