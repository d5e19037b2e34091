"""Several policies searched side by side. The best goes on: to the plant, and where they do not last, alone."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from pegasus_jax.types import Array, Key, Params, PolicyOptimizer, TrainState

FRESH = 2**31 - 1  # what a search's key is folded with for fresh policies; for its scenarios these numbers are small


def best_of(
    searcher: PolicyOptimizer,
    make: Callable[[Key, Params], Params],
    *,
    num_starts: int,
    window: int,
    lasting: bool = False,
) -> PolicyOptimizer:
    """The searcher that searches from `num_starts` policies under the same scenarios, all of them until the trial ends.

    The first is the policy it is given, the others are `make` (key, given policy) at iteration 0 of each trial; or of
    the first search where they are `lasting`, and then each goes on from trial to trial, whichever is the best. All
    begin a trial with a new optimizer. The learner's parameters are always those of the member
    with the lowest mean objective over the last `window` iterations, or as many as there were. Its optimizer is all
    members: a `TrainState` [num_starts, ...].
    """

    def init(params: Params) -> TrainState:
        members = jax.tree.map(lambda leaf: jnp.stack([leaf] * num_starts), params)
        return TrainState(members, jax.vmap(searcher.init)(members))

    def run(
        key: Key,
        learner: TrainState,
        posterior: Params,
        *,
        first: Array | int,
        steps: int,
        earlier: Array | int = 0,
        fresh: Params | None = None,
    ) -> tuple[TrainState, Any]:
        del fresh  # the members have others

        def gathered() -> Params:
            keys = jax.random.split(jax.random.fold_in(key, FRESH), num_starts - 1)
            others = jax.vmap(make, (0, None))(keys, learner.params)
            return jax.tree.map(lambda own, rest: jnp.concatenate([own[None], rest]), learner.params, others)

        def begun() -> TrainState:
            old = learner.optimizer.params
            copies = jnp.all(jnp.stack([jnp.all(leaf == leaf[0]) for leaf in jax.tree.leaves(old)]))  # as `init` has it
            members = jax.lax.cond(copies, gathered, lambda: old) if lasting else gathered()
            return TrainState(members, jax.vmap(searcher.init)(members))

        members = jax.lax.cond(jnp.asarray(first) == 0, begun, lambda: learner.optimizer)
        search = lambda member: searcher.run(key, member, posterior, first=first, steps=steps, earlier=earlier)  # noqa: E731
        members, info = jax.vmap(search)(members)
        values = jnp.mean(info.objective[:, -window:], 1)
        best = jnp.argmin(jnp.where(jnp.isnan(values), jnp.inf, values))
        params, info = jax.tree.map(lambda leaf: leaf[best], (members.params, info))
        return TrainState(params, members), info

    return PolicyOptimizer(init, run)
