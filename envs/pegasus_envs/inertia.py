"""Accelerations from forces: small linear equations, without the call of LAPACK that each of a batch would take."""

import jax
import jax.numpy as jnp
from jax import Array


def solve(matrix: Array, sides: Array) -> Array:
    """matrix^-1 sides [n, m, ...], for symmetric positive matrices [n, n, ...]: Gauss's elimination, unrolled."""
    # Fused, each step would be computed again for every entry of the next.
    step = jax.lax.optimization_barrier
    rows, pivots = jnp.concatenate([matrix, sides], axis=1), []
    while len(rows):
        pivot = step(rows[0] / rows[0, 0])
        rows = step(rows[1:, 1:] - rows[1:, :1] * pivot[1:])
        pivots.append(pivot[1:])
    solved = []
    for pivot in reversed(pivots):
        size = len(solved)
        solved.insert(0, step(pivot[size:] - sum(pivot[i] * solved[i] for i in range(size))))
    return jnp.stack(solved)
