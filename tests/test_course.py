"""What changes over a search: widths and paces in closed form, and a choice that leaves gradients alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pegasus_jax.learn.schedule import either, narrowing, pace, reheated


def test_the_width_narrows_geometrically_and_stays():
    np.testing.assert_allclose(jax.vmap(narrowing(4.0, 10))(jnp.arange(0, 25, 5)), [4, 2, 1, 1, 1], rtol=1e-6)


def test_after_a_course_every_search_has_its_own():
    factor = jax.vmap(reheated(lambda i: -1.0 * i, 4, 2, top=0.4, decay=0.5))(jnp.arange(9))
    np.testing.assert_allclose(factor, [0, -1, -2, -3, 0.4, 0.3, 0.4, 0.3, 0.4], atol=1e-6)


def test_the_pace_falls_and_begins_again_where_a_search_refines():
    factor = pace(100, 0.2, 60)
    np.testing.assert_allclose([factor(i) for i in (0, 30, 59.99)], [1, 0.6, 0.2], atol=1e-3)
    np.testing.assert_allclose([factor(i) for i in (60, 80, 99.99)], [1, 0.515, 0.03], atol=1e-3)
    np.testing.assert_allclose([pace(100, 0.2)(i) for i in (0, 50, 99.99)], [1, 0.6, 0.2], atol=1e-3)
    np.testing.assert_allclose([pace(100, 0.2)(i) for i in (100, 300)], 0.2, atol=1e-3)  # and stays
    assert pace(100, 1.0) is None


@pytest.mark.parametrize(("asked", "slope"), [(True, 2.0), (False, np.inf)])
def test_what_is_not_asked_for_reaches_no_gradient(asked, slope):
    """Though it is computed, and would make NaN of a slope that is not asked for times an infinite one."""
    double, explode = lambda x: 2.0 * x, jnp.exp
    assert jax.jit(jax.grad(lambda x: either(jnp.asarray(asked), double, explode)(x)))(1e3) == slope
