"""Predictions compiled with all optimizations, as users have them, are those of the same operations one at a time.

jaxlib 0.10 compiled a Gaussian process' draws at 200 inputs and more into numbers that had nothing to do with the data.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pegasus_jax import settings
from pegasus_jax.build import build
from pegasus_jax.types import Dataset

DRAWS, INPUTS = 50, 400


@pytest.mark.parametrize("model", ["gp", "ssgp", "log_normal", "ensemble"])
def test_many_draws_at_many_inputs(model):
    dynamics = build(settings.parse({"task": "cartpole", "model": model})).dynamics
    x, u, y = (jnp.asarray(np.random.default_rng(i).normal(size=(120, d))) for i, d in enumerate((4, 1, 4)))
    data = Dataset(x, u, jnp.sin(x + y / 10), jnp.int32(120))
    belief = jax.jit(dynamics.condition)(jax.jit(dynamics.init)(jax.random.key(0)), data)
    draws = jax.jit(jax.vmap(dynamics.sample, (0, None)))(jax.random.split(jax.random.key(1), DRAWS), belief)
    x = jax.random.normal(jax.random.key(2), (INPUTS, 4))
    u = jax.random.normal(jax.random.key(3), (INPUTS, 1))

    def means(draws):
        at = jax.vmap(dynamics.apply, (None, None, 0, 0))
        return jax.vmap(lambda draw: at(belief, draw, x, u).mean)(draws)

    one_at_a_time = means(draws)
    np.testing.assert_allclose(jax.jit(means)(draws), one_at_a_time, atol=1e-3 * float(jnp.std(one_at_a_time)))
