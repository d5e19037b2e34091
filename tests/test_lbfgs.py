"""Full-data fitting by L-BFGS: it minimizes, the value never rises, and what is not finite is not taken."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

from pegasus_jax.pilco.lbfgs import full_data, minimize
from pegasus_jax.types import Dataset, TrainState
from probes import regression, same


def rosenbrock(x):
    return jnp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)


def test_it_finds_the_minimum_that_scipy_finds(x64):
    start = np.array([-1.2, 1.0, 0.5])
    found = jax.jit(lambda x: minimize(rosenbrock, x, 200))(start)
    theirs = optimize.minimize(
        rosenbrock, start, jac=jax.grad(rosenbrock), method="L-BFGS-B", options={"ftol": 1e-15, "gtol": 1e-10}
    )
    np.testing.assert_allclose(found.params, theirs.x, atol=1e-4)
    assert found.value < 1e-8
    assert found.steps < 200  # it knows when it has arrived
    assert found.skipped == 0


def test_the_value_falls_with_every_step_allowed():
    start = jnp.array([-1.2, 1.0, 0.5, 2.0, -1.0])
    run = jax.jit(lambda steps: minimize(rosenbrock, start, steps))
    found = [run(n) for n in (1, 2, 5, 10, 20)]
    values = [float(f.value) for f in found]
    assert values == sorted(values, reverse=True)
    assert len(set(values)) == len(values)
    assert [int(f.steps) for f in found] == [1, 2, 5, 10, 20]
    for f in found:
        np.testing.assert_allclose(f.value, rosenbrock(f.params), rtol=1e-5)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_region_where_the_function_is_not_finite_is_not_entered(bad):
    """The minimum on the way to it is found all the same."""
    run = jax.jit(lambda x: minimize(lambda x: jnp.where(x > 3, bad, (x - 2.9) ** 4 - x), x, 100))
    found = run(jnp.float32(-4.0))
    assert jnp.isfinite(found.value)
    assert found.params <= 3
    np.testing.assert_allclose(found.value, -3, atol=0.01)


def test_where_nothing_is_finite_nothing_changes():
    found = jax.jit(lambda x: minimize(lambda x: jnp.sum(x) * jnp.nan, x, 50))(jnp.ones(3))
    assert same(found.params, jnp.ones(3))
    assert found.skipped == found.steps == 2


# The fitter

NOISE = np.random.default_rng(0)
X, U = NOISE.normal(size=(20, 2)), NOISE.normal(size=(20, 1))
SLOPE = np.array([[1.0, -2.0], [0.5, 3.0], [0.3, -0.7]])


def data(size=20):
    y = np.concatenate([X, U], 1) @ SLOPE
    return Dataset(*(jnp.asarray(rows, jnp.float32) for rows in (X, U, y)), jnp.int32(size))


def linear(spread=1.0):
    """A model whose loss is the square error of all rows, by way of `prepare`, as a Gaussian process has it."""
    model = regression(2, 1)
    return model._replace(
        init=lambda key: spread * jax.random.normal(key, (3, 2)),
        prepare=lambda data: data,
        loss=lambda params, key, batch, rows: jnp.mean((rows.y - jnp.concatenate([rows.x, rows.u], -1) @ params) ** 2),
    )


def test_it_finds_the_least_squares():
    fitter = full_data(linear(), num_starts=3)
    run = jax.jit(fitter.run, static_argnums=3)
    learner, info = run(jax.random.key(0), TrainState(jnp.zeros((3, 2)), fitter.init(None)), data(), 50)
    np.testing.assert_allclose(learner.params, SLOPE, atol=1e-3)
    assert info.loss < 1e-5 < info.first


def test_it_starts_from_the_best_of_its_starts_and_the_current_parameters():
    model = linear(spread=2.0)
    fitter = full_data(model, num_starts=20)
    run = jax.jit(fitter.run, static_argnums=3)
    poor = TrainState(jnp.full((3, 2), 50.0), fitter.init(None))
    started = run(jax.random.key(0), poor, data(), 0)
    value = model.loss(started[0].params, None, None, data())
    np.testing.assert_allclose(started[1].first, value, rtol=1e-6)
    drawn = [model.loss(model.init(key), None, None, data()) for key in jax.random.split(jax.random.key(1), 200)]
    assert value < np.quantile(drawn, 0.2)  # one among 20 is, but for one chance in 100
    good = TrainState(jnp.asarray(SLOPE + 0.01), fitter.init(None))
    assert same(run(jax.random.key(0), good, data(), 0)[0].params, good.params)


def test_a_start_that_is_not_finite_is_not_chosen():
    fitter = full_data(linear(), num_starts=2)
    run = jax.jit(fitter.run, static_argnums=3)
    learner, info = run(jax.random.key(0), TrainState(jnp.full((3, 2), jnp.nan), fitter.init(None)), data(), 50)
    np.testing.assert_allclose(learner.params, SLOPE, atol=1e-3)
    assert info.skipped == 0
