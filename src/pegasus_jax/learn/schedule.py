"""What changes over the iterations of a search: the width of its cost, its step size, whether it refines."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import optax

from pegasus_jax.types import Array

Schedule = Callable[[Array | int], Array]  # of the iteration, from 0


class Course(NamedTuple):
    """How a search goes on. By default every iteration is like the first."""

    stage: Schedule | None = None  # what the objective is told of the iteration
    pace: Schedule | None = None  # a factor of the step
    settled: float = 0  # the iteration from which the objective is what the search is for
    turns: tuple[int, ...] = ()  # after so many it goes back to where it started or last turned, unless it found better
    anew: bool = False  # it starts from its rival, whatever that costs

    def at(self, i: Array | int) -> tuple[Array, ...]:
        """What the objective of iteration i is told beyond policy parameters, belief and scenarios."""
        return () if self.stage is None else (self.stage(i),)


def narrowing(widest: float, over: float) -> Schedule:
    """A factor of the cost's width that falls from `widest` at iteration 0 to 1 at iteration `over`, geometrically."""
    return lambda i: widest ** jnp.maximum(0.0, 1 - i / over)


def pace(steps: int, decay: float, refine: int | None = None) -> Schedule | None:
    """A factor of the step size: in `steps` it falls from 1 to `decay`, as half a cosine; None if it is always 1.

    From the iteration `refine` on it falls from 1 once more, to .03.
    """
    if refine is None:
        only = optax.cosine_decay_schedule(1.0, steps, decay)
        return None if decay == 1 else lambda i: jnp.asarray(only(i))
    fall = optax.cosine_decay_schedule(1.0, max(refine, 1), decay)
    again = optax.cosine_decay_schedule(1.0, max(steps - refine, 1), 0.03)
    return lambda i: jnp.where(i < refine, fall(i), again(i - refine))


def reheated(annealed: Schedule, over: int, steps: int, top: float, decay: float) -> Schedule:
    """`annealed` before iteration `over`; then in each search of `steps` half a cosine, from `top` to `decay` of it."""
    fall = optax.cosine_decay_schedule(top, steps, decay)
    return lambda i: jnp.where(i < over, annealed(i), fall((i - over) % steps))


def either(condition: Array | None, yes: Callable[..., Array], no: Callable[..., Array]) -> Callable[..., Array]:
    """The function that is `yes` where the condition holds and else `no`; without a condition, `no`.

    Both are computed, because a branch at each time step costs a GPU more than they do. The one that is not asked for
    gets zeros: what it would make of a particle that has diverged reaches no gradient.
    """
    if condition is None:
        return no

    def chosen(*arguments: Array) -> Array:
        asked, other = ([jnp.where(c, a, 0) for a in arguments] for c in (condition, ~condition))
        return jnp.where(condition, yes(*asked), no(*other))

    return chosen
