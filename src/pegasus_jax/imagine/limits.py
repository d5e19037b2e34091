"""A constraint in imagination: how likely a policy breaks it, what that costs, and how much it is to weigh.

The multiplier of the penalty follows the probability (dual ascent), the policy a smooth stand-in for it that has a
gradient: a proxy-Lagrangian (Cotter et al. 2019).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from pegasus_jax.imagine import costs
from pegasus_jax.imagine.rollout import rollout
from pegasus_jax.types import Array, Dynamics, Params, Prediction, Scenarios
from pegasus_jax.vectorized import Vectorized, for_particles

FIRST, MOST = 1.0, 100.0  # multipliers
RATE = 0.1  # by which the multiplier moves in an iteration, times how far the probability is from its bound
WIDTH = 0.05  # of the penalty's bend at the limit, as a part of the way from the start to the limit
GROSS = 1.0  # as far beyond the limit as the start is before it: from there on particles stand still


class Constraint(NamedTuple):
    """What a policy is to keep to: a state breaks it where one of these numbers is positive."""

    of_state: Callable[[Array], Array]  # x [D] -> [C] or one number; about -1 where episodes start, 0 at the limit
    bound: float = 0.05  # on the probability that an episode breaks it


def margin(x: Array, constraint: Constraint) -> Array:
    """The largest of the constraint's numbers for each of the states x [..., D] -> [...]; positive breaks it."""
    return jnp.max(jnp.vectorize(_numbers(constraint), signature="(d)->(c)")(x), -1)


def _numbers(constraint: Constraint) -> Callable[[Array], Array]:
    """The constraint's numbers [C] of a state, of which it may return one alone."""
    return lambda x: jnp.atleast_1d(constraint.of_state(x))


def probability(x: Array, constraint: Constraint) -> Array:
    """[] the share of the trajectories x [H+1, K, D] that break the constraint after their first state.

    One that begins beyond the limit says nothing of its policy, and does not count; one that goes to infinity does.
    """
    broken = ~(margin(x, constraint) <= 0)  # NaN breaks it
    return jnp.sum(jnp.any(broken[1:], 0) & ~broken[0]) / jnp.maximum(jnp.sum(~broken[0]), 1)


def penalty(x: Array, constraint: Constraint) -> Array:
    """[] what breaking it costs, on average over the states x [H, K, D]: log(1 + softplus(g / WIDTH)), summed over g.

    It is small before the limit, grows at it, and beyond it as a logarithm: particles that are far beyond still have a
    gradient, and do not drown the others.
    """
    numbers = jax.vmap(jax.vmap(_numbers(constraint)))(x)
    return jnp.mean(jnp.sum(jnp.log1p(jax.nn.softplus(numbers / WIDTH)), -1))


def ascend(multiplier: Array, chance: Array, *, bound: float) -> Array:
    """The multiplier [] after an iteration whose policy breaks the constraint with this probability []."""
    return jnp.clip(multiplier + RATE * (chance - bound), 0.0, MOST)


def prefers(cheaper: Array, chance: Array, other: Array, *, bound: float) -> Array:
    """[] whether a policy is to win over another, where it is `cheaper` and breaks the constraint with `chance`.

    Of two beyond the bound the one that breaks it less often wins; of two within it, the cheaper one.
    """
    beyond, before = jnp.maximum(chance, bound), jnp.maximum(other, bound)
    return (beyond < before) | (beyond == before) & cheaper


def ranked(cost: Array, chance: Array, *, bound: float) -> Array:
    """[N] numbers of N policies whose lowest is that of one which `prefers` lets win over all others.

    Of those that break the constraint least, or within its bound, it is their `cost` [N], of the others infinite.
    """
    beyond = jnp.maximum(chance, bound)
    return jnp.where(beyond <= jnp.min(beyond), cost, jnp.inf)


def constrained(
    policy_params: Params,
    posterior: Params,
    scenarios: Scenarios,
    multiplier: Array,
    *,
    cost: Callable[[Array], Array],
    constraint: Constraint,
    **how: Any,
) -> tuple[Array, Array]:
    """(`objective` and `multiplier` times the penalty of the constraint, the probability that an episode breaks it)."""
    x = rollout(policy_params, posterior, scenarios, **how).x
    value = costs.mean(cost(x[1:])) + multiplier * penalty(x[1:], constraint)
    return value, probability(x, constraint)


def absorbing(dynamics: Dynamics, constraint: Constraint | None, stop: Callable[[Array], Array] | None) -> Dynamics:
    """The same model with absorbing states: a particle stays where `stop` ends it, or grossly beyond the limit.

    No data tell a model what comes after such states, and it might send particles to infinity.
    """
    ends: list[Callable[[Array], Array]] = []
    if constraint is not None:
        ends.append(lambda x: margin(x, constraint) > GROSS)
    if stop is not None:
        ends.append(lambda x: stop(x) > 0.5)
    if not ends:
        return dynamics

    def ended(x: Array) -> Array:
        return jnp.any(jnp.stack([end(x) for end in ends]))

    def still(x: Array, change: Prediction) -> Prediction:
        return Prediction(*(jnp.where(ended(x), 0.0, part) for part in change))

    def one(posterior: Params, draw: Params, x: Array, u: Array) -> Prediction:
        return still(x, dynamics.apply(posterior, draw, x, u))

    def many(posterior: Params, draws: Params, x: Array, u: Array) -> Prediction:
        return jax.vmap(still)(x, for_particles(dynamics.apply)(posterior, draws, x, u))

    return dynamics._replace(apply=Vectorized(one, many))
