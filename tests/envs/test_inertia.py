"""Solving for accelerations along a tree of joints, against a general solver."""

import jax
import numpy as np
import pytest

from pegasus_envs.inertia import limbs, solve

TREES = {
    "one chain": (-1, 0, 1),
    "trunk with equal chains": (-1, 0, 1, 2, 3, 2, 5),
    "no trunk": (-1, 0, -1, 2),
    "unequal chains": (-1, 0, 1, 0),
    "branches on branches": (-1, 0, 1, 1, 0, 4, 4),
}


@pytest.mark.parametrize("parents", TREES.values(), ids=TREES)
def test_equals_a_general_solver(parents):
    """On random matrices with the zeros of the tree: two joints couple only where one carries the other."""
    size, rng = len(parents), np.random.default_rng(0)
    carries = np.eye(size, dtype=bool)
    for dof, parent in enumerate(parents):
        if parent >= 0:
            carries[dof] |= carries[parent]
    factor = np.where(carries, rng.normal(size=(3, size, size)), 0) + 2 * np.eye(size)
    inertia = np.swapaxes(factor, 1, 2) @ factor
    force = rng.normal(size=(3, size))
    with jax.enable_x64(True):
        found = jax.vmap(lambda m, f: solve(m, f, parents))(inertia, force)
        one = solve(jax.numpy.asarray(inertia[0]), jax.numpy.asarray(force[0]), parents)
    np.testing.assert_allclose(found, np.linalg.solve(inertia, force[..., None])[..., 0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(one, found[0], rtol=1e-12, atol=1e-12)


def test_divides_where_the_tree_first_branches():
    assert [part.tolist() for part in limbs(TREES["trunk with equal chains"])] == [[0, 1, 2], [[3, 4], [5, 6]]]
    for name in ("one chain", "unequal chains", "branches on branches"):
        assert limbs(TREES[name]).chains.size == 0, name
