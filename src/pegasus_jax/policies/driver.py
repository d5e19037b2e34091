"""Episodes of a policy in JAX on an environment: what they ask of JAX is compiled before the robot moves."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import numpy as np

from pegasus_jax import episode
from pegasus_jax import memory as recall
from pegasus_jax.episode import Episode
from pegasus_jax.policies.rate_limited import explored
from pegasus_jax.task import Task
from pegasus_jax.types import Array, Key, Params, Policy, Trajectory


def driver(task: Task, policy: Policy, explore: Callable[[Key], Array]) -> Callable[[Key, Params, bool], Episode]:
    """drive(key, policy parameters, exploring) -> an episode on the task's environment, with the costs of its rows.

    The controls are the policy's, or those that `explore(key)` draws [H, U].
    """
    see, _, advance = recall.steps(task.memory)

    def draws(key: Key) -> tuple[Array, Key, Array, Params]:
        """All that an episode draws: random controls, a key and a seed of its start, the policy's noise [H, ...]."""
        plan_key, seed_key, noise_key = jax.random.split(key, 3)
        noise = jax.vmap(policy.sample)(jax.random.split(noise_key, task.horizon))
        return explore(plan_key), seed_key, jax.random.randint(seed_key, (), 0, 2**31 - 1), noise

    def reaction(params: Params, noise: Params, m: Any, x: Array) -> tuple[Array, Any]:
        u = policy.apply(params, noise, see(m, x))
        # In one type: a control in double precision would make this another program from the second period on.
        return u, m if m is None else advance(m, x, u).astype(m.dtype)

    drawn, begin, react = jax.jit(draws), jax.jit(partial(recall.begin, task.memory)), jax.jit(reaction)
    costs_of = jax.jit(partial(episode.costs, task))

    def compile_all(params: Params, noise: Params, key: Key) -> None:
        """The first control is to be as quick as the others; and a signal is not heard while this thread compiles."""
        x: Any = np.zeros((1, len(task.state_names)), np.float32)
        u: Any = np.zeros((0, len(task.control_names)), np.float32)
        m = begin(key, x[0])
        react(params, jax.tree.map(lambda z: z[0], noise), m, x[0])
        costs_of(episode.padded(Trajectory(x, u, u[:, 0], memory=m), task.horizon))

    @cache
    def wake() -> None:
        """The first controller answers once before the robot waits for it: it may be JAX's, and compile."""
        if task.guide is not None:
            task.guide(np.asarray(task.start_mean, np.float32))

    def drive(key: Key, params: Params, exploring: bool) -> Episode:
        plan, begin_key, *others = drawn(key)
        plan, seed, noise = jax.tree.map(np.asarray, (plan, *others))
        params = jax.device_put(params)
        compile_all(params, noise, begin_key)
        if exploring:
            wake()
        first = m = None
        sent = recall.resting(task).astype(plan.dtype)

        def control(t: int, x: np.ndarray) -> np.ndarray:
            nonlocal first, m, sent
            if t == 0:
                first = m = begin(begin_key, x)
            if exploring:
                sent = explored(task, x, plan[t], sent, np)
                return sent
            u, m = react(params, jax.tree.map(lambda z: z[t], noise), m, x)
            return np.asarray(u)

        found = episode.drive(int(seed), control, task)
        ran = found.trajectory._replace(memory=first)
        cost = np.asarray(costs_of(episode.padded(ran, task.horizon)))[: len(ran.u)]
        return found._replace(trajectory=ran._replace(cost=cost))

    return drive
