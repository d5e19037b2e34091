"""What a policy search minimizes: the imagined cost under given scenarios (Alg. 3, lines 6 to 15)."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from pegasus_jax.imagine import costs
from pegasus_jax.imagine.rollout import rollout
from pegasus_jax.types import Array, Cost, Params, Scenarios


def objective(
    policy_params: Params,
    posterior: Params,
    scenarios: Scenarios,
    *,
    cost: Cost | Callable[[Array], Array],
    aggregate: Callable[[Array], Array] = costs.mean,
    **how: Any,
) -> Array:
    """J(theta) (Alg. 3 line 15): the costs [H, K] of the rollout's states, made one number by `aggregate`.

    `cost` is a task's, or a function of all states x [H, K, D] -> [H, K], or -> [H, 1] where it is one for all
    particles. `how` are the keywords of `rollout`: dynamics, policy, match, and maybe noise and limit. No gradient
    flows through predicted noise: finite differences of J are its gradient only where that noise is constant, or with
    noise=NoiseUse(policy=0).

    Raises ValueError, while it is traced, for costs of another shape.
    """
    each = costs.of_particles(cost) if isinstance(cost, Cost) else cost
    x = rollout(policy_params, posterior, scenarios, **how).x[1:]
    if jnp.shape(found := each(x)) not in (x.shape[:2], (len(x), 1)):
        raise ValueError(
            f"cost(x) of states {x.shape} has shape {jnp.shape(found)}; expected [H, K] {x.shape[:2]}:"
            " costs.of_particles(Cost(function)) makes that of a function of one state"
        )
    return aggregate(found)
