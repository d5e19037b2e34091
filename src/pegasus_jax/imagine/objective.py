"""What a policy search minimizes: the imagined cost under given scenarios (Alg. 3, lines 6 to 15)."""

from collections.abc import Callable

import jax.numpy as jnp

from pegasus_jax.imagine import costs
from pegasus_jax.imagine.rollout import NoiseUse, rollout
from pegasus_jax.types import Array, Dynamics, Params, Policy, Scenarios


def objective(
    policy_params: Params,
    posterior: Params,
    scenarios: Scenarios,
    *,
    dynamics: Dynamics,
    policy: Policy,
    match: Callable[[Array, Array], Array],
    cost: Callable[[Array], Array],
    aggregate: Callable[[Array], Array] = costs.mean,
    noise: NoiseUse = NoiseUse(),
    limit: Array | float | None = None,
) -> Array:
    """J(theta) (Alg. 3 line 15): cost [H, K, D] -> [H, K] of the rollout's states, made one number by `aggregate`."""
    imagined = rollout(
        policy_params,
        posterior,
        scenarios,
        dynamics=dynamics,
        policy=policy,
        match=match,
        noise=noise,
        limit=limit,
    )
    return aggregate(cost(imagined.x[1:]))


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
