"""How much wider than its table says a search makes a cost that is too flat to be followed: docs/decisions.md 0034."""

import jax.numpy as jnp

from pegasus_jax.learn.schedule import STEP, SearchTable
from pegasus_jax.types import Array

SEEN = 0.9  # a greater mean cost is nearly 1 everywhere: it has no slope to speak of
RATE = 1.01  # of the factor, a step
MOST = 3.0  # of the factor


def holding(table: SearchTable) -> SearchTable:
    """The table, in which every step before a refinement may widen a cost that is too flat."""
    return table._replace(holds=(table.action == STEP) & ~table.refine)


def widened(row: SearchTable, widening: Array) -> SearchTable:
    """A row, whose cost is wider by the factor `widening` [] where the row may widen it."""
    return row._replace(cost_width=row.cost_width * jnp.where(row.holds, widening, 1.0))


def after_step(widening: Array, row: SearchTable, value: Array) -> Array:
    """The factor [] after a row whose objective was `value` []: it grows while the cost is flat, else falls to 1."""
    moved = jnp.where(value > SEEN, widening * RATE, widening / RATE)
    return jnp.where(row.holds, jnp.clip(moved, 1.0, MOST), widening)
