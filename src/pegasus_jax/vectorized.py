"""A function of one particle that has a way of its own to answer for K of them at once."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax


@dataclass(frozen=True)
class Vectorized:
    """`one`, whose answers for K particles at once are `many`: (shared [...], rest [K, ...]) -> [K, ...].

    A function that takes its place in a model has no `many`, and is vmapped: whoever changes `one` changes both.
    """

    one: Callable[..., Any]
    many: Callable[..., Any]

    def __call__(self, *arguments: Any) -> Any:
        return self.one(*arguments)


def for_particles(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function (shared, of each, ...) of K particles: its own, or else vmapped over all but the first argument."""
    if isinstance(function, Vectorized):
        return function.many
    return lambda shared, *each: jax.vmap(function, (None, *(0 for _ in each)))(shared, *each)
