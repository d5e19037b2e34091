"""When a refinement has gained nothing more: the rule by which a search ends early."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import optax

from pegasus_jax.types import Array


class Progress(NamedTuple):
    """What the rounds of a refinement have gained so far."""

    count: Array  # [] steps of this round whose objective counts
    total: Array  # [] sum of those objectives
    squares: Array  # [] sum of their squares
    mean: Array  # [] their mean in the round before; infinite in the first round
    variance: Array  # [] of that mean
    over: Array  # [] whether the newest round has gained nothing


def unrefined() -> Progress:
    """The progress of a search before its first round."""
    nothing, unknown = jnp.zeros((), float), jnp.asarray(jnp.inf, float)
    return Progress(nothing, nothing, nothing, unknown, unknown, jnp.zeros((), bool))


def after_row(progress: Progress, row: Any, value: Array) -> Progress:
    """What the rounds have gained after a row of a `SearchTable`, whose objective is `value` [].

    The last steps of a round are small, so their objectives, each under scenarios of its own, are samples of what the
    policy is expected to cost. A round has gained nothing where their mean is not lower than that of the round before
    by more than the standard error of the difference.
    """
    counts = row.counts & jnp.isfinite(value)  # a step that was skipped does not count
    counted = jnp.where(counts, value, 0.0)
    count, total = progress.count + counts, progress.total + counted
    squares = progress.squares + counted**2
    mean = total / count
    variance = jnp.maximum(squares / count - mean**2, 0) / jnp.maximum(count - 1, 1)
    gained = progress.mean - mean > jnp.sqrt(variance + progress.variance)
    over = ~gained & jnp.isfinite(progress.mean)
    going = progress._replace(count=count, total=total, squares=squares)
    return optax.tree.where(row.ends, unrefined()._replace(mean=mean, variance=variance, over=over), going)
