"""Accelerations from forces: the inertia matrix of a tree of joints, solved along the tree.

A general solver calls LAPACK once for every member of a batch. Here joints that carry nothing further are eliminated
first, all chains at once, and what is left is unrolled: every operation is then one over the batch.
"""

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array


class Limbs(NamedTuple):
    """Degrees of freedom of a trunk, and of chains that grow from it and move independently of each other."""

    trunk: np.ndarray
    """[T]"""
    chains: np.ndarray
    """[C, L]; C is 0 when the mechanism does not divide into chains of one length"""


@cache
def limbs(parents: tuple[int, ...]) -> Limbs:
    """Divide a tree, given each degree of freedom's parent (-1: none), where it first branches."""
    children = np.bincount(np.array(parents) + 1, minlength=len(parents) + 1)
    trunk, dof = [], -1
    while children[dof + 1] == 1:
        dof = parents.index(dof)
        trunk.append(dof)
    chains = []
    for first in (i for i, parent in enumerate(parents) if parent == dof):
        chains.append([first])
        while children[chains[-1][-1] + 1] == 1:
            chains[-1].append(parents.index(chains[-1][-1]))
    alike = len({len(chain) for chain in chains}) == 1
    if not alike or len(trunk) + sum(map(len, chains)) < len(parents):
        return Limbs(np.arange(len(parents), dtype=np.int32), np.zeros((0, 0), np.int32))
    return Limbs(np.array(trunk, np.int32), np.array(chains, np.int32))


def solve(inertia: Array, force: Array, parents: tuple[int, ...]) -> Array:
    """inertia^-1 force [nv], for the symmetric positive inertia [nv, nv] of a tree of joints."""
    trunk, chains = limbs(parents)
    if not len(chains):
        return _solve(inertia, force[:, None])[:, 0]
    coupling = inertia[chains[:, :, None], trunk]  # [C, L, T]
    sides = jnp.concatenate([coupling, force[chains][:, :, None]], axis=2)
    solved = _solve(inertia[chains[:, :, None], chains[:, None, :]], sides)
    left = jnp.einsum("clt,clu->tu", coupling, solved)
    reduced = inertia[np.ix_(trunk, trunk)] - left[:, :-1]
    base = _solve(reduced, (force[trunk] - left[:, -1])[:, None])[:, 0]
    ends = solved[..., -1] - solved[..., :-1] @ base
    order = np.argsort(np.concatenate([trunk, chains.ravel()])).astype(np.int32)
    return jnp.concatenate([base, ends.ravel()])[order]


def _solve(matrix: Array, sides: Array) -> Array:
    """matrix^-1 sides [..., n, m] for symmetric positive matrices [..., n, n], by the method of Gauss and Jordan."""
    size = matrix.shape[-1]
    rows = jnp.concatenate([matrix, sides], axis=-1)
    for i in range(size):
        pivot = rows[..., i, :] / rows[..., i, i, None]
        factor = rows[..., :, i] - np.eye(size)[i]
        # Fused, each step would be computed again for every entry of the next.
        rows = jax.lax.optimization_barrier(rows - factor[..., None] * pivot[..., None, :])
    return rows[..., size:]
