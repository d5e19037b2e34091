"""Updates that a number that is not finite does not make: what a fit and a search share."""

from typing import Any

import jax
import jax.numpy as jnp
import optax

from pegasus_jax.types import Array, Params, TrainState


def is_finite(numbers: Params) -> Array:
    """[] whether every entry is; of no entries, as of a model that is known, they are."""
    return jnp.all(jnp.array([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(numbers)], bool))


def update_if(
    condition: Array, optimizer: optax.GradientTransformation, gradient: Params, learner: TrainState, **more: Any
) -> tuple[Params, optax.OptState]:
    """The optimizer's updates and its next state; where the condition does not hold zeros, and its state as it is.

    `more` is for optimizers that ask for it, such as the `value` of the objective; others ignore it.
    """
    update = optax.with_extra_args_support(optimizer).update
    zeros = jax.tree.map(jnp.zeros_like, gradient)
    return jax.lax.cond(
        condition,
        lambda: update(gradient, learner.optimizer, learner.params, **more),
        lambda: (zeros, learner.optimizer),
    )
