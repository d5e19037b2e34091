"""RBF and linear controllers: against NumPy, at their start, and as maps of Gaussians; controllers of other origin."""

from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pegasus_jax.math import angles, gaussian
from pegasus_jax.pilco.rbf import NOISE, rbf
from pegasus_jax.policies.linear import linear
from pegasus_jax.policies.squash import SQUASHES, to_limits
from pegasus_jax.policies.wrap import of_pair
from probes import LIMITS, dial

F, UNITS = 4, 6
MEAN = np.array([0.3, -0.2, 0.9, -0.4])
COV = 0.2 * np.cov(np.random.default_rng(0).normal(size=(F, 9)))


def pieces(squash):
    low, high = (jnp.asarray(limit, float) for limit in LIMITS)
    return dict(
        encode=partial(angles.encode, angles=(2,)),
        controls=2,
        saturate=to_limits(SQUASHES[squash], low, high),
        saturate_moments=partial(gaussian.squash, low=low, high=high) if squash == "sine" else None,
    )


def start(key):
    return jnp.array([0.5, -1.0, 2.0]) + jnp.array([0.3, 0.1, 0.2]) * jax.random.normal(key, (3,))


def make(kind, squash="sine"):
    if kind == "rbf":
        return rbf(**pieces(squash), start=start, waves=2, num_centers=UNITS)
    return linear(**pieces(squash), features=F)


def some_params(kind):
    """In double precision, far from the start."""
    noise = np.random.default_rng(1)
    if kind == "rbf":
        shapes = {"centres": (UNITS, F), "targets": (2, UNITS), "lengthscales": (2, F)}
    else:
        shapes = {"weights": (2, F), "bias": (2,)}
    return {name: jnp.asarray(noise.normal(size=shape)) for name, shape in shapes.items()}


def raw(kind, params, features):
    """The controls [N, U] before saturation at features [N, F], in NumPy."""
    params = {name: np.asarray(p) for name, p in params.items()}
    if kind == "linear":
        return features @ params["weights"].T + params["bias"]
    columns = []
    for targets, lengths in zip(params["targets"], np.log1p(np.exp(params["lengthscales"])), strict=True):
        k = lambda a, b, s=lengths: np.exp(-0.5 * np.sum(((a[:, None] - b) / s) ** 2, -1))  # noqa: E731
        weights = np.linalg.solve(k(params["centres"], params["centres"]) + NOISE * np.eye(UNITS), targets)
        columns.append(k(features, params["centres"]) @ weights)
    return np.stack(columns, 1)


def saturated(squash, v):
    f = np.tanh(v) if squash == "tanh" else (9 * np.sin(v) + np.sin(3 * v)) / 8
    return (LIMITS[1] + LIMITS[0]) / 2 + (LIMITS[1] - LIMITS[0]) / 2 * f


every_kind = pytest.mark.parametrize("kind", ["rbf", "linear"])


@every_kind
@pytest.mark.parametrize("squash", SQUASHES)
def test_the_control_is_the_formula(kind, squash, x64):
    """The RBF controller is the mean of a Gaussian process regression through its centres and targets."""
    policy, params = make(kind, squash), some_params(kind)
    x = np.random.default_rng(2).normal(size=(20, 3))
    features = np.stack([x[:, 0], x[:, 1], np.sin(x[:, 2]), np.cos(x[:, 2])], 1)
    u = jax.jit(jax.vmap(lambda x: policy.apply(params, None, x)))(x)
    np.testing.assert_allclose(u, saturated(squash, raw(kind, params, features)), rtol=1e-9)
    assert policy.sample(jax.random.key(0)) == ()


def test_the_rbf_controller_begins_where_episodes_do():
    policy = rbf(**pieces("sine"), start=start, waves=2, num_centers=4000)
    params = jax.jit(policy.init)(jax.random.key(0))
    centres = np.asarray(params["centres"])
    np.testing.assert_allclose(centres[:, :2].mean(0), [0.5, -1.0], atol=0.03)
    np.testing.assert_allclose(centres[:, :2].std(0), [0.3, 0.1], rtol=0.05)
    np.testing.assert_allclose(np.sum(centres[:, 2:] ** 2, 1), 1, rtol=1e-5)  # a sine and a cosine
    np.testing.assert_allclose(np.arctan2(centres[:, 2], centres[:, 3]).std(), 0.2, rtol=0.05)
    assert params["targets"].shape == (2, 4000)
    np.testing.assert_allclose(np.var(params["targets"]), 0.1, rtol=0.05)
    np.testing.assert_allclose(jax.nn.softplus(params["lengthscales"]), [[1, 1, 0.7, 0.7]] * 2, rtol=1e-6)


@pytest.mark.parametrize("units", [30, 100])
def test_single_precision_is_enough_for_the_rbf_controller(units):
    """At its start, where its centres are closest and its weights largest.

    The variance is a difference of sums a thousand times as large: by CPU and compiler it is .2 to 1.5 % off.
    """
    policy = rbf(**pieces("sine"), start=start, waves=2, num_centers=units)
    params = policy.init(jax.random.key(0))
    mean, cov = np.array([0.5, -1.0, 0.9, -0.4]), 0.04 * np.eye(F)
    single = jax.jit(policy.moments)(params, jnp.float32(mean), jnp.float32(cov))
    with jax.enable_x64(True):
        double = jax.jit(policy.moments)(jax.tree.map(lambda p: jnp.asarray(np.float64(p)), params), mean, cov)
    for ours, exact in zip(single, double, strict=True):
        np.testing.assert_allclose(ours, exact, atol=3e-2 * np.abs(exact).max())


@every_kind
def test_moments_are_those_of_samples(kind, x64):
    """Made Gaussian before saturation, as the moments are; tolerances are five standard errors."""
    count = 1_000_000
    policy, params = make(kind), some_params(kind)
    image = jax.jit(policy.moments)(params, MEAN, COV)
    noise = np.random.default_rng(3)
    features = noise.multivariate_normal(MEAN, COV, count)
    v = raw(kind, params, features)
    together = np.concatenate([features, v], 1)
    redrawn = noise.multivariate_normal(together.mean(0), np.cov(together.T), count, method="svd")
    features, u = redrawn[:, :F] - redrawn[:, :F].mean(0), saturated("sine", redrawn[:, F:])
    centered = u - u.mean(0)
    error = lambda samples: 7 * samples.std(0) / np.sqrt(count)  # noqa: E731
    np.testing.assert_array_less(abs(image.mean - u.mean(0)), error(u))
    for i in range(2):
        np.testing.assert_array_less(abs(image.cov[i] - np.cov(u.T)[i]), error(centered[:, i, None] * centered))
        products = features * centered[:, i, None]
        np.testing.assert_array_less(abs((COV @ image.slope)[:, i] - products.mean(0)), error(products))


@every_kind
def test_moments_of_a_known_state_are_its_control(kind, x64):
    policy, params, x = make(kind), some_params(kind), np.array([0.3, -0.2, 0.7])
    features = jnp.asarray(angles.encode(jnp.asarray(x), (2,)))
    image = jax.jit(policy.moments)(params, features, jnp.zeros((F, F)))
    np.testing.assert_allclose(image.mean, policy.apply(params, None, x), rtol=1e-10)
    np.testing.assert_allclose(image.cov, 0, atol=1e-10)


@every_kind
def test_a_saturation_without_moments_leaves_the_policy_without(kind):
    assert make(kind, "tanh").moments is None
    assert make(kind, "sine").moments is not None


def test_a_network_of_other_origin_becomes_a_policy_of_features_within_the_limits():
    task = dial()
    module = nn.Dense(1)
    policy = of_pair(lambda key: module.init(key, jnp.zeros(2)), module.apply, task)
    params = policy.init(jax.random.key(0))
    kernel = np.asarray(params["params"]["kernel"])
    for angle in (-3.0, 0.5, 40.0):
        expected = np.tanh(np.array([np.sin(angle), np.cos(angle)]) @ kernel)
        np.testing.assert_allclose(policy.apply(params, policy.sample(None), jnp.array([angle])), expected, rtol=1e-4)
    strong = jax.tree.map(lambda p: 1e3 * p, params)
    assert abs(policy.apply(strong, None, jnp.array([2.0]))) <= 1
