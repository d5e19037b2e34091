"""The only place that draws the noise of imagined rollouts."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from pegasus_jax import memory as recall
from pegasus_jax.math.linalg import standardize
from pegasus_jax.sharding import Spread, together
from pegasus_jax.types import Array, Dynamics, Key, Params, Period, Policy, Scenarios

Block = Callable[[Key, Params], Params]  # (key, posterior) -> that part of the scenarios


class Blocks(NamedTuple):
    """How each part of the scenarios is drawn."""

    start: Block
    dynamics: Block
    policy: Block
    sensor: Block
    match: Block


def blocks(
    *,
    dynamics: Dynamics,
    policy: Policy,
    start: Callable[[Key], Array],
    particles: int,
    horizon: int,
    standardized_noise: bool = False,
    spread: Spread = together,
) -> Blocks:
    """How each part of the scenarios is drawn; `start` draws a first state [D], the policy's memory its first m [M].

    With `standardized_noise`, the normal draws of every time step have exactly zero mean and unit covariance over the
    particles, so that matched particles have exactly the moments asked for: K <= D + M then raises ValueError, while it
    is traced. `spread` lays particles out over devices.
    """

    deal = dynamics.deal or jax.vmap(dynamics.sample, (0, None))

    def each(sample: Callable[[Key], Params], key: Key) -> Params:
        return spread(sample(jax.random.split(key, particles)), 0)

    def first(key: Key) -> Array:
        x = start(key)
        return recall.join(x, recall.begin(policy.memory, key, x))

    def normal(key: Key, _: Params, *, like: Callable[[Key], Array]) -> Array:
        states = jax.eval_shape(like, key).shape[0]
        # Drawn as one long row: the same numbers, by loops that need not stop every few dimensions.
        z = jax.random.normal(key, (horizon * particles * states,)).reshape(horizon, particles, states)
        return spread(standardize(z) if standardized_noise else z, 1)

    return Blocks(
        start=lambda key, _: each(jax.vmap(first), key),
        dynamics=lambda key, posterior: each(lambda keys: deal(keys, posterior), key),
        policy=lambda key, _: each(jax.vmap(policy.sample), key),
        sensor=partial(normal, like=start),
        match=partial(normal, like=first),
    )


def draw(key: Key, step: Array | int, posterior: Params, *, blocks: Blocks, period: Period = Period()) -> Scenarios:
    """The scenarios in force at a search iteration: starts [K, D], normal draws [H, K, D], ...

    Block b at iteration i is drawn from fold_in(fold_in(key, b), i // period_b): any iteration's scenarios can be had
    without those before it, so a search may stop and go on anywhere.
    """
    epochs = jnp.stack([_epoch(step, every) for every in period])
    folded = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(len(blocks)))  # all at once: quick to compile
    keys = jax.vmap(jax.random.fold_in)(folded, epochs)
    return Scenarios(*(sample(keys[i], posterior) for i, sample in enumerate(blocks)))


def begin(key: Key, step: Array, posterior: Params, *, blocks: Blocks, period: Period) -> Scenarios:
    """The scenarios before a loop of `redraw`: blocks that last for the whole search, zeros in place of the others."""
    drawing = partial(draw, blocks=blocks, period=period)
    nothing = jax.tree.map(jnp.zeros_like, jax.eval_shape(drawing, key, step, posterior))
    return nothing._replace(**_of_period(0, drawing(key, step, posterior), period)) if 0 in period else nothing


def redraw(
    key: Key, step: Array, scenarios: Scenarios, posterior: Params, begins: Array, *, blocks: Blocks, period: Period
) -> Scenarios:
    """`draw` for iteration `step`, from the `scenarios` of this iteration or of the one before.

    Only blocks that may change are drawn. Where a loop `begins`, [], `scenarios` come from `begin`.
    """
    renewed = {}
    for every in sorted(set(period) - {0}):

        def fresh(every: int = every) -> dict[str, Params]:
            return _of_period(every, draw(key, step, posterior, blocks=blocks, period=period), period)

        def kept(every: int = every) -> dict[str, Params]:
            return _of_period(every, scenarios, period)

        renewed |= fresh() if every == 1 else jax.lax.cond(begins | (step % every == 0), fresh, kept)
    return scenarios._replace(**renewed)


def _of_period(every: int, scenarios: Scenarios, period: Period) -> dict[str, Params]:
    """The blocks with this period, by name; the compiler leaves out the draws of all others."""
    blocks = zip(Scenarios._fields, scenarios, period, strict=True)
    return {name: block for name, block, lasts in blocks if lasts == every}


def _epoch(step: Array | int, every: int) -> Array:
    return jnp.asarray(step // every if every else 0, jnp.uint32)


class Sampler(NamedTuple):
    """Where the scenarios of a search come from."""

    begin: Callable[[Key, Array, Params], Scenarios]  # (key, first iteration, posterior) -> what a loop begins with
    # (key, iteration, those before it, posterior, whether the loop begins) -> those in force
    redraw: Callable[[Key, Array, Scenarios, Params, Array], Scenarios]


def sampler(blocks: Blocks, period: Period) -> Sampler:
    """Scenarios drawn from `blocks`, each held for its `period` of iterations."""
    return Sampler(*(partial(function, blocks=blocks, period=period) for function in (begin, redraw)))
