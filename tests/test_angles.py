"""Angles: the embedding is invertible and smooth, and a crossing of 180 degrees is not a jump."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pegasus_jax.math.angles import difference, encode, feature_names, wrap
from pegasus_jax.math.gaussian import sincos

PI = np.float32(np.pi)
angle = st.floats(-50, 50, width=32) | st.floats(3, 4, width=32) | st.floats(-4, -3, width=32)


@pytest.mark.parametrize("angles", [(), (3,), (0, 2), (2, 0)])
def test_features_are_the_rest_then_sines_then_cosines(angles):
    x = np.random.default_rng(0).normal(size=(5, 4)).astype(np.float32)
    rest = [x[:, i] for i in range(4) if i not in angles]
    expected = np.stack([*rest, *(np.sin(x[:, i]) for i in angles), *(np.cos(x[:, i]) for i in angles)], -1)
    features = encode(jnp.asarray(x), angles)
    assert features.shape == (5, 4 + len(angles))
    np.testing.assert_allclose(features, expected, rtol=1e-6, atol=1e-6)
    names = feature_names(("a", "b", "c", "d"), angles)
    assert len(names) == features.shape[-1]
    for i in angles:  # the names stand where the features are
        np.testing.assert_allclose(features[:, names.index(f"sin {'abcd'[i]}")], np.sin(x[:, i]), atol=1e-6)


@pytest.mark.parametrize("place", [-1, 4])
def test_an_angle_that_is_no_dimension_is_refused(place):
    """JAX would take the last, or none."""
    x = jnp.zeros(4)
    for made in (
        lambda: encode(x, (place,)),
        lambda: difference(x, x, (place,)),
        lambda: sincos(x, jnp.eye(4), (place,)),
        lambda: feature_names(("a", "b", "c", "d"), (place,)),
    ):
        with pytest.raises(ValueError, match=rf"angles=\({place},\) has {place}; expected indices from 0 to 3"):
            made()


def test_an_angle_that_is_named_twice_is_refused():
    for made in (lambda: encode(jnp.zeros(4), (3, 3)), lambda: feature_names(("a", "b", "c", "d"), (3, 3))):
        with pytest.raises(ValueError, match=r"angles=\(3, 3\) has 3 twice; expected different indices"):
            made()


def test_differences_of_arrays_of_numpy_are_wrapped():
    np.testing.assert_allclose(
        difference(np.array([3.0, 3.0]), np.array([-3.0, -3.0]), (0,)), [6 - 2 * PI, 6], rtol=1e-6
    )


@given(angle)
def test_a_wrapped_angle_is_the_same_angle_within_half_a_turn(value):
    wrapped = float(wrap(jnp.float32(value)))
    assert abs(wrapped) <= PI
    np.testing.assert_allclose([np.sin(wrapped), np.cos(wrapped)], [np.sin(value), np.cos(value)], atol=2e-5)


@given(st.floats(-float(PI), float(PI), width=32))
def test_an_angle_inside_is_not_changed_by_a_single_bit(value):
    assert np.array_equal(np.float32(wrap(jnp.float32(value))), np.float32(value))


@given(arrays(np.float32, 2, elements=angle), st.floats(-3, 3, width=32))
def test_differences_see_through_any_number_of_turns(start, change):
    """Column 0 is an angle measured in (-pi, pi], column 1 the same numbers as a length."""
    after = start + np.float32(change)
    measured = wrap(jnp.asarray([[start[0], start[1]], [after[0], after[1]]])[:, 0])
    x = jnp.stack([measured, jnp.asarray([start[1], after[1]])], -1)
    np.testing.assert_allclose(difference(x[1], x[0], (0,)), [change, after[1] - start[1]], atol=3e-5)


@pytest.mark.parametrize("turn", [1, -1])
def test_crossing_the_seam(turn):
    before, after = turn * (PI - 0.1), turn * (-PI + 0.1)
    x = jnp.array([[before, before], [after, after]])
    np.testing.assert_allclose(difference(x[1], x[0], (0,)), [turn * 0.2, after - before], atol=1e-6)
    np.testing.assert_allclose(difference(x[1], x[0], ()), [after - before, after - before], atol=1e-6)
