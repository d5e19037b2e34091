"""Costs of states, and what a search makes of the costs of K imagined rollouts."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from pegasus_jax.types import Array

Cost = Callable[[Array], Array]  # x [D] -> scalar
Aggregate = Callable[[Array], Array]  # costs [H, K] -> scalar


def saturating(error: Callable[[Array], Array], width: float) -> Cost:
    """The cost 1 - exp(-|error(x)|^2 / (2 width^2)) of a state x [D] (Deisenroth 2010; docs/reference.md 1.3)."""

    def cost(x: Array) -> Array:
        e = error(x) / width
        return 1 - jnp.exp(-0.5 * jnp.sum(e * e))

    return cost


def of_particles(cost: Cost) -> Callable[[Array], Array]:
    """The cost of every particle: x [H, K, D] -> [H, K]."""
    return jax.vmap(jax.vmap(cost))


def mean(costs: Array) -> Array:
    """Mean cost a step and particle: what the authors' code minimises."""
    return jnp.mean(costs)


def total(costs: Array) -> Array:
    """Cost of an episode, averaged over particles: the paper's eq. 1 and Alg. 3 line 15."""
    return jnp.sum(jnp.mean(costs, 1))


def discounted(discount: float, aggregate: Aggregate = mean) -> Aggregate:
    """The aggregate of costs weighted by discount^t."""

    def weighted(costs: Array) -> Array:
        return aggregate(costs * discount ** jnp.arange(costs.shape[0], dtype=costs.dtype)[:, None])

    return weighted
