"""Several policies searched side by side. The best goes on: to the plant, and where they do not last, alone."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from pegasus_jax.types import Array, Key, Params, PolicyOptimizer, TrainState

JUDGE = 2**31 - 1  # what a search's key is folded with: no iteration has that number


def best_of(
    searcher: PolicyOptimizer,
    *,
    num_starts: int,
    window: int,
    lasting: bool = False,
    judge: Callable[[Key, Params, Params], Array] | None = None,
) -> PolicyOptimizer:
    """The searcher that searches from `num_starts` policies under the same scenarios, all of them until the trial ends.

    The first is the policy it is given, the others are the first of `fresh` at iteration 0 of each trial; or of the
    first search where they are `lasting`, and then each goes on from trial to trial, whichever is the best. What
    `searcher` keeps from search to search, such as a constraint's multiplier, is a lasting member's own; the others
    begin with what the given policy's member knows. The learner's parameters are always those of the member with the
    lowest mean objective over the last `window` iterations, or as many as there were; or with the lowest number of
    `judge(key, members' parameters, posterior)` [num_starts], where objectives cannot be compared: each counts a
    constraint by its own multiplier. Its optimizer is all members: a `TrainState` [num_starts, ...].
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
        def gathered() -> TrainState:
            several = lambda own, rest: jnp.concatenate([own[None], rest[: num_starts - 1]])  # noqa: E731
            members = jax.tree.map(several, learner.params, fresh)
            last = place_of(learner.params, learner.optimizer.params)
            known = jax.tree.map(lambda leaf: jnp.stack([leaf[last]] * num_starts), learner.optimizer.optimizer)
            return TrainState(members, known)

        def begun() -> TrainState:
            if not lasting:
                return gathered()
            old = jax.tree.leaves(learner.optimizer.params)
            copies = jnp.all(jnp.stack([jnp.all(leaf == leaf[0]) for leaf in old]))  # as `init` has it
            return jax.lax.cond(copies, gathered, lambda: learner.optimizer)

        members = jax.lax.cond(jnp.asarray(first) == 0, begun, lambda: learner.optimizer)
        search = lambda member: searcher.run(key, member, posterior, first=first, steps=steps, earlier=earlier)  # noqa: E731
        members, info = jax.vmap(search)(members)
        if judge is None:
            values = jnp.mean(info.objective[:, -window:], 1)
        else:
            values = judge(jax.random.fold_in(key, JUDGE), members.params, posterior)
        best = jnp.argmin(jnp.where(jnp.isnan(values), jnp.inf, values))
        params, info = jax.tree.map(lambda leaf: leaf[best], (members.params, info))
        return TrainState(params, members), info

    return PolicyOptimizer(init, run)


def place_of(params: Params, members: Params) -> Array:
    """[] the first of the members [N, ...] with these parameters.

    0 where there is none: a policy that went on as it was before a search is the one that member 0 began with.
    """
    same = jax.tree.map(lambda own, all_of: jnp.all((all_of == own).reshape(len(all_of), -1), 1), params, members)
    return jnp.argmax(jnp.all(jnp.stack(jax.tree.leaves(same)), 0))
