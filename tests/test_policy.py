"""Controllers: within the limits whatever they see, one mask along a rollout, and a mean policy without any."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pegasus_jax.math.angles import encode
from pegasus_jax.models import dropout
from pegasus_jax.pilco.rbf import rbf
from pegasus_jax.policies.linear import linear
from pegasus_jax.policies.scaled import scaled
from pegasus_jax.policies.squash import SQUASHES, sine, to_limits
from probes import LIMITS, controller, experience, same

every_squash = pytest.mark.parametrize("squash", SQUASHES)
single = st.floats(-1e6, 1e6, width=32)


@pytest.fixture(scope="module")
def outputs():
    """Every squash's controls [U] of (seed, x), by a network whose weights are large enough to saturate."""
    acts = {}
    for squash in SQUASHES:
        policy = controller(squash=squash)

        def act(seed, x, policy=policy):
            keys = jax.random.split(jax.random.key(seed))
            params = policy.init(keys[0])
            last = params["network"]["params"]["layer_1"]
            last["kernel"] = 30 * last["kernel"]
            return policy.apply(params, policy.sample(keys[1]), x)

        acts[squash] = jax.jit(act)
    return acts


@every_squash
@given(seed=st.integers(0, 2**16), x=arrays(np.float32, 3, elements=single))
def test_controls_are_within_limits_for_any_state(squash, outputs, seed, x):
    u = np.asarray(outputs[squash](seed, x))
    assert np.all(u >= LIMITS[0])
    assert np.all(u <= LIMITS[1])


SATURATE = {name: jax.jit(lambda low, high, v, f=f: to_limits(f, low, high)(v)) for name, f in SQUASHES.items()}


@every_squash
@given(arrays(np.float32, 2, elements=st.floats(-100, 100, width=32)), st.integers(0, 2**16))
def test_saturation_never_leaves_the_limits_by_a_single_bit(squash, ends, seed):
    """A Gymnasium box refuses a control that is one rounding outside, and so may a motor driver."""
    low, high = np.sort(ends)
    v = np.random.default_rng(seed).normal(size=64).astype(np.float32) * 10
    u = np.asarray(SATURATE[squash](low, high, v))
    assert np.all(u >= low)
    assert np.all(u <= high)


@every_squash
def test_the_middle_and_both_ends_are_reached(squash):
    to = to_limits(SQUASHES[squash], *(jnp.asarray(limit, jnp.float32) for limit in LIMITS))
    end = np.pi / 2 if squash == "sine" else 20.0
    np.testing.assert_allclose(to(jnp.zeros(2)), (LIMITS[0] + LIMITS[1]) / 2, atol=1e-6)
    np.testing.assert_allclose(to(jnp.full(2, end)), LIMITS[1], atol=1e-6)
    np.testing.assert_allclose(to(jnp.full(2, -end)), LIMITS[0], atol=1e-6)


def test_the_sine_saturation_is_pilcos():
    """Flat to third order at its ends: sin^3 and nothing else has sin 3v = 3 sin v - 4 sin^3 v."""
    v = np.linspace(-2, 2, 41, dtype=np.float32)
    np.testing.assert_allclose(sine(v), (12 * np.sin(v) - 4 * np.sin(v) ** 3) / 8, atol=1e-6)
    assert abs(jax.grad(sine)(jnp.float32(np.pi / 2))) < 1e-6


def test_the_mean_policy_is_the_network_with_every_unit_at_its_expected_size():
    """Against NumPy, with the masks of binary dropout and with their mean."""
    policy = controller(dropout.binary(0.3))
    params = jax.jit(policy.init)(jax.random.key(0))
    noise = policy.sample(jax.random.key(1))
    x = np.array([0.3, -0.7, 2.0], np.float32)
    layers = [jax.tree.map(np.asarray, params["network"]["params"][f"layer_{i}"]) for i in range(2)]
    features = np.array([x[0], x[1], np.sin(x[2]), np.cos(x[2])])
    hidden = np.maximum(features @ layers[0]["kernel"] + layers[0]["bias"], 0)
    middle, half = (LIMITS[1] + LIMITS[0]) / 2, (LIMITS[1] - LIMITS[0]) / 2
    for draw, mask in ((None, 0.7), (noise, np.asarray(noise[0]) < 0.7)):
        expected = middle + half * np.tanh((hidden * mask) @ layers[1]["kernel"] + layers[1]["bias"])
        np.testing.assert_allclose(policy.apply(params, draw, x), expected, atol=1e-5)


def test_a_policy_without_noise_is_its_own_mean():
    policy = controller(dropout.none())
    params, x = jax.jit(policy.init)(jax.random.key(0)), jnp.array([0.3, -0.7, 2.0])
    assert np.array_equal(policy.apply(params, policy.sample(jax.random.key(1)), x), policy.apply(params, None, x))


def test_a_mask_is_a_draw_and_the_control_a_function_of_it():
    """The same draw gives the same control; other draws drop other units, each at the given rate."""
    policy = controller(dropout.binary(0.3), hidden=(50, 50))
    draws = jax.jit(jax.vmap(policy.sample))(jax.random.split(jax.random.key(0), 100))
    assert [d.shape for d in draws] == [(100, 50)] * 2
    for layer in draws:
        np.testing.assert_allclose(np.mean(np.asarray(layer) < 0.7), 0.7, atol=0.03)
    assert not np.any(np.asarray(draws[0]) == np.asarray(draws[1]))  # layers are drawn apart
    params, x = jax.jit(policy.init)(jax.random.key(1)), jnp.array([0.3, -0.7, 2.0])
    u = jax.vmap(policy.apply, (None, 0, None))(params, draws, x)
    assert len(np.unique(u, axis=0)) == 100
    np.testing.assert_allclose(policy.apply(params, [d[3] for d in draws], x), u[3], rtol=1e-5)


def test_the_scale_of_the_input():
    plain, scaled = controller(dropout.none()), controller(dropout.none(), input_scale=jnp.array([2.0, 1, 1, 1]))
    both = plain.init(jax.random.key(0))
    one, two = plain.apply(both, None, jnp.array([0.6, 0.2, 1.0])), scaled.apply(both, None, jnp.array([0.3, 0.2, 1.0]))
    np.testing.assert_allclose(one, two, rtol=1e-5)


def with_entry(entry, rows=30):
    """Data of the rig with its first entry replaced, each row by a number of `entry`."""
    data = experience(rows)
    return data._replace(x=data.x.at[:rows, 0].set(jnp.asarray(entry, jnp.float32)))


KINDS = {
    "mlp": lambda: controller(dropout.none()),
    "linear": lambda: linear(
        encode=partial(encode, angles=(2,)), features=4, controls=2, saturate=jnp.tanh, saturate_moments=None
    ),
    "rbf": lambda: rbf(
        encode=partial(encode, angles=(2,)),
        start=lambda key: jnp.array([1e4, 0.0, 0.0]) + jax.random.normal(key, (3,)),
        waves=2,
        controls=2,
        num_centers=10,
        saturate=jnp.tanh,
        saturate_moments=None,
    ),
}
every_kind = pytest.mark.parametrize("kind", KINDS)


@every_kind
@given(seed=st.integers(0, 2**16), size=st.floats(0.15, 9.0))
def test_inputs_of_ordinary_size_are_left_as_they_are(kind, seed, size):
    """To the last bit: parameters, control and gradient."""
    policy = KINDS[kind]()
    data = with_entry(size * np.random.default_rng(seed).uniform(-1, 1, 30))
    fresh = policy.init(jax.random.key(seed))
    assert same(policy.adapt(fresh, data), fresh)


def test_a_network_that_leaves_its_inputs_alone_is_the_network_alone():
    policy = controller(dropout.none())
    params, x = policy.init(jax.random.key(0)), jnp.array([0.3, -0.7, 2.0])
    hidden = jnp.maximum(layer(params, 0, encode(x, (2,))), 0)
    low, high = LIMITS
    expected = to_limits(SQUASHES["tanh"], jnp.float32(low), jnp.float32(high))(layer(params, 1, hidden))
    assert np.array_equal(policy.apply(params, None, x), expected)


def layer(params, i, inputs):
    of = params["network"]["params"][f"layer_{i}"]
    return inputs @ of["kernel"] + of["bias"]


LARGE = {
    "constant": np.full(30, 1e4),
    "varies": 1e4 + 300 * np.random.default_rng(0).normal(size=30),
    "a rate in degrees": 500 * np.random.default_rng(1).normal(size=30),
    "far away": -3e6 + 1e5 * np.random.default_rng(2).normal(size=30),
}


@cache
def slopes_of(kind):
    """Data -> how large the gradients of fresh policies are that were adapted to them; compiled once for all data."""
    policy = KINDS[kind]()

    def slopes(data):
        def slope(key):
            controls = lambda params: jax.vmap(lambda x: policy.apply(params, None, x))(data.x[:30])  # noqa: E731
            squares = jax.grad(lambda params: jnp.sum(controls(params) ** 2))
            return optax.tree.norm(squares(policy.adapt(policy.init(key), data)))

        return jax.vmap(slope)(jax.random.split(jax.random.key(0), 10))

    return jax.jit(slopes)


@every_kind
@pytest.mark.parametrize("name", LARGE)
def test_a_large_entry_does_not_saturate_a_policy(kind, name):
    """A fresh policy's gradient by its parameters is of the size that it has without the entry."""
    given = np.asarray(slopes_of(kind)(with_entry(LARGE[name])))
    assert np.isfinite(given).all()
    if kind == "rbf" and name != "constant":  # its centres are drawn where episodes start: here at 1e4, give or take 1
        return
    assert np.median(given) > 0.1


@pytest.mark.parametrize("kind", ["mlp", "linear"])
@pytest.mark.parametrize("size", [0.02, 1e-3, 1e-6])
def test_a_small_entry_is_seen_whatever_its_unit(kind, size):
    """A fresh policy answers to it as to the same entry in units that make it large, and not as if it were absent."""
    entry, policy = 2 + np.random.default_rng(0).normal(size=30), KINDS[kind]()

    def answers(entry):
        data = with_entry(entry)
        params = policy.adapt(policy.init(jax.random.key(0)), data)
        return np.asarray(jax.vmap(lambda x: policy.apply(params, None, x))(data.x[:30]))

    small = answers(size * entry)
    np.testing.assert_allclose(small, answers(1e3 * entry), rtol=1e-3, atol=1e-4)
    assert np.max(np.abs(small - answers(np.zeros(30)))) > 0.01


@every_kind
@pytest.mark.parametrize("constant", [0.0, 0.01])
def test_a_small_entry_that_never_moved_is_not_blown_up(kind, constant):
    policy = KINDS[kind]()
    data, moved = with_entry(np.full(30, constant)), with_entry(np.full(30, constant + 0.1))
    params = policy.adapt(policy.init(jax.random.key(0)), data)
    controls = [np.asarray(jax.vmap(lambda x: policy.apply(params, None, x))(d.x[:30])) for d in (data, moved)]
    assert np.isfinite(controls).all()
    assert np.max(np.abs(controls[1] - controls[0])) < 0.5


def test_the_sine_of_an_angle_that_moved_little_is_no_small_entry():
    policy, data = controller(dropout.none(), waves=2), experience(30)
    data = data._replace(x=data.x.at[:30].multiply(1e-3))
    params = policy.adapt(policy.init(jax.random.key(0)), data)
    assert np.array_equal(params["input"].scale[2:], [1, 1])
    assert (np.asarray(params["input"].scale)[:2] < 0.05).all()


@pytest.mark.parametrize("size", [30.0, 180.0, 1e6, 1e-3])
def test_the_length_scale_of_a_large_or_small_entry_is_its_spread(size):
    """exp of 89 and more is not finite in float32."""
    policy, data = KINDS["rbf"](), with_entry(size * np.random.default_rng(0).normal(size=30))
    params = policy.adapt(policy.init(jax.random.key(0)), data)
    np.testing.assert_allclose(jax.nn.softplus(params["lengthscales"][:, 0]), np.std(data.x[:30, 0]), rtol=1e-4)


def test_the_scaling_of_inputs_is_not_learned():
    policy, data = controller(dropout.none()), with_entry(LARGE["varies"])
    params = policy.adapt(policy.init(jax.random.key(0)), data)
    slope = jax.grad(lambda params: jnp.sum(policy.apply(params, None, data.x[0]) ** 2))(params)
    assert not any(np.any(leaf) for leaf in slope["input"])
    assert optax.tree.norm(slope["network"]) > 0
    white = scaled(params["input"], encode(data.x[:30], (2,)))[:, 0]
    np.testing.assert_allclose((white.mean(), white.std()), (0, 1), atol=1e-2)


def adapted(entry):
    """The inputs [30, F] of a fresh network whose units are found in data, and its controls [30, U] there."""
    policy, data = controller(dropout.none(), find_units=True), with_entry(entry)
    params, x = policy.adapt(policy.init(jax.random.key(0)), data), data.x[:30]
    return scaled(params["input"], encode(x, (2,))), jax.vmap(partial(policy.apply, params, None))(x)


@pytest.mark.parametrize(
    ("size", "expected"), [(0.01, 3.0), (0.1, 0.3), (0.5, 1.5), (1.0, 3.0), (2.0, 3.0), (15.0, 3.0)]
)
def test_units_that_are_found_leave_no_input_larger_than_the_others(size, expected):
    """decision 0040: root mean squares above 1, or far below, become 3, others three times as large; so do waves."""
    entry = np.random.default_rng(0).normal(size=30)
    entry *= size / np.sqrt(np.mean(entry**2))
    inputs, _ = adapted(entry)
    np.testing.assert_allclose(np.sqrt(np.mean(inputs**2, 0))[0], expected, rtol=1e-4)
    waves = np.asarray(encode(with_entry(entry).x[:30], (2,)))[:, 2:]
    np.testing.assert_allclose(inputs[:, 2:], 3 * waves, rtol=1e-4)


def test_units_that_are_found_do_not_depend_on_those_of_the_plant():
    entry = 2 * np.random.default_rng(0).normal(size=30)
    np.testing.assert_allclose(adapted(entry)[1], adapted(5 * entry)[1], rtol=1e-3, atol=1e-5)


def test_a_large_entry_with_units_that_are_found_is_standardized():
    inputs, _ = adapted(LARGE["varies"])
    np.testing.assert_allclose((inputs[:, 0].mean(), inputs[:, 0].std()), (0, 3), atol=3e-2)
