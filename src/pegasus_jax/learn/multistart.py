"""Several policies searched side by side, of which the best runs on the plant."""

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
    """The searcher that runs `searcher` from `num_starts` policies side by side, under the same scenarios.

    At iteration 0 of each trial member 0 begins with the given policy, the others with the first of `fresh`. `lasting`
    members begin like that in the first search only, and then each goes on from trial to trial. What `searcher` keeps
    from search to search, such as a constraint's multiplier, a lasting member keeps for itself; the others begin with
    that of the member whose policy is given. The learner's parameters are those of the best member: of the lowest mean
    objective over the last `window` iterations, or as many as there were. Where members count a constraint by
    multipliers of their own, objectives cannot be compared: then of the lowest `judge(key, members' parameters,
    posterior)` [num_starts]. The learner's optimizer state is all members: a `TrainState` [num_starts, ...].
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
            last = index_of(learner.params, learner.optimizer.params)
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


def index_of(params: Params, members: Params) -> Array:
    """[] the index of the first of the members [N, ...] that has these parameters.

    0 where none has: then the policy from before the search went on, with which member 0 had begun.
    """
    same = jax.tree.map(lambda own, all_of: jnp.all((all_of == own).reshape(len(all_of), -1), 1), params, members)
    return jnp.argmax(jnp.all(jnp.stack(jax.tree.leaves(same)), 0))
