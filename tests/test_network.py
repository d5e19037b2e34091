"""The network: a ReLU perceptron, one mask for every layer's input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pegasus_jax.checks import ConfigError
from pegasus_jax.models.networks import ACTIVATIONS, INITIALIZERS, MLP, orthogonal


def forward(params, x, masks):
    """The same network in NumPy."""
    layers = [params["params"][f"layer_{i}"] for i in range(len(params["params"]))]
    for i, layer in enumerate(layers):
        x = (x if masks[i] is None else x * masks[i]) @ np.asarray(layer["kernel"]) + np.asarray(layer["bias"])
        x = np.maximum(x, 0) if i < len(layers) - 1 else x
    return x


@pytest.mark.parametrize("hidden", [(), (5,), (6, 5)])
@pytest.mark.parametrize("masked", [False, True])
def test_it_is_the_network_of_the_docstring(hidden, masked):
    noise = np.random.default_rng(0)
    network = MLP(hidden, 2)
    params = network.init(jax.random.key(0), jnp.zeros(3), [None] * (len(hidden) + 1))
    masks = [noise.uniform(size=w).astype(np.float32) if masked else None for w in (3, *hidden)]
    x = noise.normal(size=(4, 3)).astype(np.float32)
    np.testing.assert_allclose(network.apply(params, x, masks), forward(params, x, masks), atol=1e-5)


def test_all_of_it_has_the_precision_that_was_asked_for(x64):
    """The kernels too: else a gradient of 64 bits would be one of 32."""
    params = MLP((5,), 2).init(jax.random.key(0), jnp.zeros(3), [None, None])
    assert {leaf.dtype for leaf in jax.tree.leaves(params)} == {np.dtype(np.float64)}


def test_every_row_may_have_its_own_mask():
    network = MLP((5,), 2)
    params = network.init(jax.random.key(0), jnp.zeros(3), [None, None])
    x = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    mask = np.random.default_rng(1).integers(0, 2, size=(4, 5)).astype(np.float32)
    rows = [network.apply(params, x[i], [None, mask[i]]) for i in range(4)]
    np.testing.assert_allclose(network.apply(params, x, [None, mask]), rows, atol=1e-6)


@pytest.mark.parametrize("name", INITIALIZERS)
def test_initial_weights(name):
    """Glorot: variance 2 / (in + out). Orthogonal: the rows or columns are orthonormal. Biases: within .01."""
    params = jax.jit(lambda key: MLP((60,), 40, name).init(key, jnp.zeros(50), [None, None]))(jax.random.key(0))[
        "params"
    ]
    kernel = np.asarray(params["layer_1"]["kernel"])
    assert kernel.shape == (60, 40)
    if name == "orthogonal":
        np.testing.assert_allclose(kernel.T @ kernel, np.eye(40), atol=1e-5)
    else:
        np.testing.assert_allclose(kernel.var(), 2 / 100, rtol=0.1)
    biases = np.concatenate([params[f"layer_{i}"]["bias"] for i in range(2)])
    assert np.all(np.abs(biases) <= 0.01)
    assert len(np.unique(biases)) == 100


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_activations_and_their_slopes_are_the_librarys(name):
    """relu, silu and tanh under the same names; forward, backward, and where exp overflows float32."""
    x = jnp.asarray([-100.0, -5.0, -0.1, 0.3, 4.0, 100.0])
    ours, theirs = (jax.vmap(jax.value_and_grad(f))(x) for f in (ACTIVATIONS[name], getattr(jax.nn, name)))
    np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-7)
    tangents = [jax.jvp(f, (x,), (x,))[1] for f in (ACTIVATIONS[name], getattr(jax.nn, name))]
    np.testing.assert_allclose(*tangents, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("shape", [(7, 7), (3, 20), (20, 3), (1, 4), (5, 1)])
def test_orthogonal_weights_are_those_of_jax_without_its_library_of_linear_algebra(shape) -> None:
    """Whose QR factors of a batch, computed for two layers at once, never come on a CPU of two cores."""
    keys = jax.random.split(jax.random.key(3), 4)
    expected = [jax.nn.initializers.orthogonal()(key, shape, jnp.float32) for key in keys]
    several = jax.jit(jax.vmap(lambda key: orthogonal(key, shape)))
    np.testing.assert_allclose(several(keys), expected, atol=1e-5)
    assert "custom_call" not in several.lower(keys).as_text()


@pytest.mark.parametrize("kind", ["initializer", "activation"])
def test_a_kind_that_there_is_not_is_one_line(kind) -> None:
    with pytest.raises(ConfigError, match=rf"{kind}=tanhh is not a choice; "):
        MLP((4,), 1, **{kind: "tanhh"}).init(jax.random.key(0), jnp.zeros(2), [None, None])
