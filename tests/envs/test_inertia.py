"""Solving small linear equations, against a general solver."""

import jax
import numpy as np
import pytest

from pegasus_envs.inertia import solve


@pytest.mark.parametrize("size", [1, 2, 3, 6])
def test_equals_a_general_solver(size):
    """For batches by `vmap`, and for those along the last axis."""
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(5, size, size)) + 2 * np.eye(size)
    matrix, sides = np.swapaxes(factor, 1, 2) @ factor, rng.normal(size=(5, size, 2))
    exact = np.linalg.solve(matrix, sides)
    with jax.enable_x64(True):
        found = jax.vmap(solve)(matrix, sides)
        last = solve(*(jax.numpy.moveaxis(array, 0, -1) for array in (matrix, sides)))
    np.testing.assert_allclose(found, exact, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(np.moveaxis(last, -1, 0), exact, rtol=1e-9, atol=1e-9)
