"""Batches along the last axis."""

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_envs.batching import batch_last


def test_the_batch_comes_last_and_nothing_else_changes():
    shapes = []

    def plain(tree, y):
        shapes.append(tree["x"].shape)
        return {"sum": tree["x"][0] * y + jnp.sin(tree["x"][2])}

    function = batch_last(plain)
    x, y = np.random.default_rng(0).normal(size=(5, 4, 3)).astype(np.float32), np.float32(2.0)
    one = function({"x": x[0, 0]}, y)["sum"]
    many = jax.vmap(lambda x: function({"x": x}, y))(x[0])["sum"]
    nested = jax.vmap(jax.vmap(lambda x: function({"x": x}, y)))(x)["sum"]
    assert set(shapes) == {(3,), (3, 4), (3, 4, 5)}
    np.testing.assert_allclose(nested, plain({"x": np.moveaxis(x, -1, 0)}, y)["sum"], rtol=1e-6)
    np.testing.assert_allclose(many, nested[0], rtol=1e-6)
    np.testing.assert_allclose(one, many[0], rtol=1e-6)


def test_derivatives_in_both_directions():
    square = batch_last(lambda x, y: (x * x * y).sum(axis=0))
    x = jnp.arange(6.0).reshape(2, 3)
    for transform in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(jax.vmap(transform(square), (0, None))(x, 3.0), 6.0 * x)
        np.testing.assert_allclose(transform(lambda x: jax.vmap(square, (0, None))(x, 3.0).sum())(x), 6.0 * x)
