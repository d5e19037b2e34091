"""Which policy a run goes on with after an episode: a policy that worked comes back if its replacement fails."""

import jax.numpy as jnp
import optax

from pegasus_jax.types import Array, RunState


def after_episode(state: RunState) -> RunState:
    """The run after an episode: a policy that worked is remembered, and comes back once if the next policy fails.

    A policy from a fresh start may work in imagination only, where the model is wrong. The episode has taught that to
    the model, and the policy before it still works. If that one fails in its own next episode, or its next replacement
    fails too, it worked by luck, and nothing is remembered any more: docs/decisions.md 0021.
    """
    learned = state.policy_trial > 0  # a policy ran, and not random controls
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
