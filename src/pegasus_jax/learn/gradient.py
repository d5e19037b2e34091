"""Policy search as printed (Alg. 3): follow the gradient of the imagined cost under held scenarios."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from pegasus_jax.imagine.scenarios import Sampler
from pegasus_jax.learn.updates import is_finite, update_if
from pegasus_jax.types import Array, Key, Params, Scenarios, TrainState


class SearchInfo(NamedTuple):
    """How a search went, iteration by iteration."""

    objective: Array  # [steps]; where an iteration ends with a comparison, that of the policy that goes on
    gradient_norm: Array  # [steps] before clipping
    skipped: Array  # [] updates skipped because the objective or its gradient was not finite
    iterations: Array | None = None  # [] how many were done; the rest are NaN; None: all


def gradient_search(
    key: Key,
    learner: TrainState,
    posterior: Params,
    *,
    objective: Callable[[Params, Params, Scenarios], Array],
    sampler: Sampler,
    optimizer: optax.GradientTransformation,
    steps: int,
    first: Array | int = 0,
    **others: Any,
) -> tuple[TrainState, SearchInfo]:
    """Alg. 3 as printed: `steps` updates along the gradient of `objective` under the scenarios of each iteration.

    The learner holds policy parameters and `optimizer.init` of them. `optimizer` includes the clip of lines 17 and 18:
    optax.chain(optax.clip_by_global_norm(1.0), optax.adam(1e-3)). An update is skipped where the objective or its
    gradient is not finite. Arrays of the information have an entry a step, [N]. `first` iterations of the search are
    done already. A trial also gives its searcher `earlier`, `fresh` and `works`, which are ignored here. Raises
    TypeError for others.
    """
    if unknown := {*others} - {"earlier", "fresh", "works"}:
        raise TypeError(f"gradient_search has no argument {min(unknown)}=")

    def step(carry: tuple[TrainState, Scenarios], i: Array) -> tuple[tuple[TrainState, Scenarios], SearchInfo]:
        learner, scenarios = carry
        scenarios = sampler.redraw(key, i, scenarios, posterior, i == first)
        value, gradient = jax.value_and_grad(objective)(learner.params, posterior, scenarios)
        finite = is_finite((value, gradient))
        along = dict(value=value, grad=gradient, value_fn=lambda params: objective(params, posterior, scenarios))
        updates, state = update_if(finite, optimizer, gradient, learner, **along)
        learner = TrainState(optax.apply_updates(learner.params, updates), state)
        info = SearchInfo(value, optax.tree.norm(gradient), ~finite)
        return (learner, scenarios), info

    begun = learner, sampler.begin(key, jnp.asarray(first, jnp.int32), posterior)
    (learner, _), info = jax.lax.scan(step, begun, first + jnp.arange(steps, dtype=jnp.int32))
    return learner, info._replace(skipped=jnp.sum(info.skipped))
