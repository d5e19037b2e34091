"""Which policy a run goes on with after an episode: one that worked is not forgotten for one that does not."""

import jax.numpy as jnp
import optax

from pegasus_jax.types import Array, RunState


def after_episode(state: RunState) -> RunState:
    """The run after an episode of its policy: one that works is remembered, one that fails gives way to it, once.

    A policy from a fresh start may work in imagination only, where the model does not know what it does. The episode
    has taught the model that; the one before it is still a policy that works. If that fails in its own next episode, or
    the next one that replaces it fails too, it was luck, and nothing is remembered: docs/decisions.md 0021.
    """
    learned = state.policy_trial > 0  # and no random controls
    works = state.succeeded & learned
    back = learned & ~state.succeeded & (state.working_trial > 0) & (state.working_trial != state.policy_trial)
    params = optax.tree.where(back, state.working, state.policy.params)
    return state._replace(
        policy=state.policy._replace(params=params),
        policy_trial=jnp.where(back, state.working_trial, state.policy_trial),
        succeeded=state.succeeded | back,
        working=optax.tree.where(works, params, state.working),
        working_trial=jnp.where(works, state.policy_trial, 0),
    )


def came_back(state: RunState) -> Array:
    """Whether the policy is one that worked and came back [], so that none is remembered beside it."""
    return state.succeeded & (state.policy_trial > 0) & (state.working_trial == 0)
