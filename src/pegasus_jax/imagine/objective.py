"""What a policy search minimizes: the imagined cost under given scenarios (Alg. 3, lines 6 to 15)."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from pegasus_jax.imagine import costs
from pegasus_jax.imagine.rollout import rollout
from pegasus_jax.types import Array, Params, Scenarios


def objective(
    policy_params: Params,
    posterior: Params,
    scenarios: Scenarios,
    *,
    cost: Callable[[Array], Array],
    aggregate: Callable[[Array], Array] = costs.mean,
    **how: Any,
) -> Array:
    """J(theta) (Alg. 3 line 15): cost [H, K, D] -> [H, K] of the rollout's states, made one number by `aggregate`.

    `how` are the keywords of `rollout`: dynamics, policy, match, and maybe noise and limit.
    """
    return aggregate(cost(rollout(policy_params, posterior, scenarios, **how).x[1:]))


def either(condition: Array | None, yes: Callable[..., Array], no: Callable[..., Array]) -> Callable[..., Array]:
    """The function that is `yes` where the condition holds and else `no`; without a condition, `no`.

    Both are computed, because a branch at each time step costs a GPU more than they do. The one that is not asked for
    gets zeros: what it would make of a particle that has diverged reaches no gradient.
    """
    if condition is None:
        return no

    def chosen(*arguments: Array) -> Array:
        asked, other = ([jnp.where(c, a, 0) for a in arguments] for c in (condition, ~condition))
        return jnp.where(condition, yes(*asked), no(*other))

    return chosen
