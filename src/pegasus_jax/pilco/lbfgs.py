"""Full-data fitting by L-BFGS, for models whose loss is a smooth function of all rows: Gaussian processes."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from pegasus_jax.learn.fit import FitInfo
from pegasus_jax.types import Array, Batch, Dataset, Dynamics, Key, ModelLearner, Params, TrainState

MEMORY = 10  # past steps from which the curvature is known


class Descent(NamedTuple):
    """How far a minimization got."""

    params: Params  # the best there were
    value: Array  # [] theirs; infinite before the first step
    state: Any  # of the optimizer
    failures: Array  # [] int32, steps in a row without progress; it is over when they are 2
    skipped: Array  # [] int32, steps that ended where the function is not finite
    steps: Array  # [] int32 taken


def begin(params: Params) -> Descent:
    """The descent from `params`, before its first step."""
    zero = jnp.int32(0)
    start = Descent(params, jnp.inf, optax.lbfgs(memory_size=MEMORY).init(params), zero, zero, zero)  # type: ignore[arg-type]
    # Of the types that the first step will give: weak ones would have a search traced twice.
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.result_type(leaf)), start)


def step(function: Callable[[Params], Array], d: Descent) -> tuple[Descent, tuple[Any, Params]]:
    """One iteration of L-BFGS with a zoom line search (Nocedal & Wright 2006, alg. 7.4 and 3.5).

    Also gives the value and the gradient where it began. The value never rises: a step that gains nothing, or ends
    where the function is not finite, is not taken, and the curvature learned so far is forgotten. It is a failure, as
    is a gain below the precision of the arithmetic.
    """
    optimizer = optax.lbfgs(memory_size=MEMORY)
    value, gradient = optax.value_and_grad_from_state(function)(d.params, state=d.state)
    updates, state = optimizer.update(gradient, d.state, d.params, value=value, grad=gradient, value_fn=function)
    moved = optax.apply_updates(d.params, updates)
    after = optax.tree.get(state, "value")
    better = after < value
    precision = max(2e-9, 4 * float(jnp.finfo(after.dtype).eps))
    gained = better & (value - after > precision * jnp.maximum(jnp.abs(value), 1))
    params, state = jax.tree.map(
        lambda new, old: jnp.where(better, new, old), (moved, state), (d.params, optimizer.init(d.params))
    )
    ahead = Descent(
        params,
        jnp.where(better, after, value),
        state,
        jnp.where(gained, 0, d.failures + 1),
        d.skipped + ~jnp.isfinite(after),
        d.steps + 1,
    )
    return ahead, (value, gradient)


def minimize(function: Callable[[Params], Array], params: Params, steps: int) -> Descent:
    """At most `steps` steps from `params`; two failures in a row end the descent."""
    return jax.lax.while_loop(
        lambda d: (d.steps < steps) & (d.failures < 2), lambda d: step(function, d)[0], begin(params)
    )


def full_data(dynamics: Dynamics, *, num_starts: int) -> ModelLearner:
    """The fitter that minimizes the loss over all rows at once, from the best of several starts.

    The starts are the current parameters and `num_starts` draws of `dynamics.init`. The loss must be a function of
    the parameters and of `prepare(data)` alone: it is given one key and all rows of the data set, used or not. Nothing
    but the parameters is carried from one fit to the next.
    """

    def run(key: Key, learner: TrainState, data: Dataset, steps: int) -> tuple[TrainState, FitInfo]:
        init_key, loss_key = jax.random.split(key)
        context = dynamics.prepare(data)

        def loss(params: Params) -> Array:
            return dynamics.loss(params, loss_key, Batch(data.x, data.u, data.y), context)

        fresh = jax.vmap(dynamics.init)(jax.random.split(init_key, num_starts))
        candidates = jax.tree.map(lambda now, new: jnp.concatenate([now[None], new]), learner.params, fresh)
        # One after the other: kernel matrices of all candidates at once would fill the memory.
        losses = jax.lax.map(loss, candidates)
        best = jnp.argmin(jnp.where(jnp.isfinite(losses), losses, jnp.inf))
        found = minimize(loss, jax.tree.map(lambda leaf: leaf[best], candidates), steps)
        return TrainState(found.params, learner.optimizer), FitInfo(found.value, losses[best], found.skipped)

    return ModelLearner(lambda params: (), run)
