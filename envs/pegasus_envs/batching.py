"""Batches that compile to fast loops: the batch as the last axis, and values that are computed once."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_batching import custom_vmap

T = TypeVar("T")


def batch_last(function: Callable[..., T]) -> Callable[..., T]:
    """The same function; `vmap` then adds its axis after all others, and vector instructions run over the members.

    `function` must accept arrays with further axes at the end (it indexes from the front; all its arguments have them),
    and close over nothing that `vmap` could be batching.
    """

    @custom_vmap
    def batched(*arguments: Any) -> Any:
        return function(*arguments)

    @batched.def_vmap
    def rule(size: int, is_batched: list[Any], *arguments: Any) -> tuple[Any, Any]:
        def last(x: Array, yes: bool) -> Array:
            return jnp.moveaxis(x, 0, -1) if yes else jnp.broadcast_to(x[..., None], (*x.shape, size))

        results = batched(*jax.tree.map(last, list(arguments), is_batched))
        return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), results), jax.tree.map(lambda _: True, results)

    # custom_vmap cannot be transposed: derivatives, in both directions, are those of the plain function.
    differentiable = jax.custom_jvp(batched)
    differentiable.defjvp(lambda primals, tangents: jax.jvp(function, primals, tangents))
    return differentiable


def stored(*arrays: Array) -> Array:
    """The arrays, broadcast and stacked [n, ...], in memory if there are more than eight.

    XLA's CPU compiler fuses whatever it can, and so computes a value again in every loop that reads it, and what that
    depends on, too. A concatenation of more than eight arrays it does not fuse, if it cannot see the slices of it.
    """
    return jax.lax.optimization_barrier(jnp.stack(jnp.broadcast_arrays(*arrays)))
