"""Episodes: a plant and a controller in turn, sensor noise between them, random controls within the limits."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pegasus_jax import episode
from probes import cart

TASK = cart(horizon=6)
LOW, HIGH = jnp.array([-2.0, 1.0]), jnp.array([2.0, 1.5])


def fly(key, sensor_std=0.0, act=lambda key, t, x: jnp.array([0.1 * t]) - 0.5 * x[:1]):
    return episode.run(key, act, TASK._replace(sensor_std=np.full(2, sensor_std)))


def test_it_is_the_plant_and_the_controller_in_turn():
    flight = jax.jit(fly)(jax.random.key(0))
    x = np.asarray(flight.x[0])
    assert flight.x.shape == (7, 2)
    for t in range(6):
        u = 0.1 * t - 0.5 * x[:1]
        np.testing.assert_allclose(flight.u[t], u, atol=1e-5)
        x = np.asarray(TASK.plant.step(x, u))
        np.testing.assert_allclose(flight.x[t + 1], x, atol=1e-5)
        np.testing.assert_allclose(flight.cost[t], TASK.cost.of_state(x), atol=1e-5)  # of the states 1..H


def test_the_controller_and_the_data_see_sensor_noise_and_the_cost_does_not():
    """The controller's input is the very row of the data; the cost is that of the same flight without noise."""
    blind = lambda key, t, x: jnp.array([0.3])  # noqa: E731
    clean, noisy = (jax.jit(partial(fly, sensor_std=std, act=blind))(jax.random.key(1)) for std in (0.0, 0.5))
    assert np.array_equal(clean.cost, noisy.cost)
    errors = np.asarray(noisy.x - clean.x)
    assert 0.2 < errors.std() < 1.0
    assert len(np.unique(errors)) == errors.size  # fresh at every step, the first state's too
    repeats = jax.jit(lambda key: fly(key, 0.5, lambda key, t, x: x[:1]))(jax.random.key(1))
    assert np.array_equal(repeats.u[:, 0], repeats.x[:-1, 0])


def test_the_controller_has_a_key_of_its_own_at_every_step():
    flight = jax.jit(lambda key: fly(key, 0.0, lambda key, t, x: jax.random.normal(key, (1,))))(jax.random.key(2))
    assert len(np.unique(flight.u)) == 6


def test_a_task_without_a_plant_says_so():
    with pytest.raises(ValueError, match="cart has no plant in JAX"):
        episode.run(jax.random.key(0), lambda key, t, x: x[:1], TASK._replace(plant=None))


@pytest.mark.parametrize("plan", [episode.uniform, episode.random_walk])
def test_random_controls_stay_within_limits_and_reach_for_them(plan):
    u = np.asarray(plan(jax.random.key(0), LOW, HIGH, 500))
    assert u.shape == (500, 2)
    assert np.all((u >= LOW) & (u <= HIGH))
    assert np.all(np.ptp(u, 0) > 0.85 * np.asarray(HIGH - LOW))
    np.testing.assert_allclose((u.mean(0) - LOW) / (HIGH - LOW), 0.5, atol=0.1)


def test_a_random_walk_stays_or_goes_most_of_the_way():
    u = np.asarray(episode.random_walk(jax.random.key(0), LOW, HIGH, 1000))
    stays = np.all(np.diff(u, axis=0) == 0, 1)
    np.testing.assert_allclose(stays.mean(), 0.7, atol=0.05)
    jumps = np.diff(u, axis=0)[~stays] / 0.75 + u[:-1][~stays]  # the draws it went towards
    assert np.all((jumps >= LOW - 1e-4) & (jumps <= HIGH + 1e-4))
    still = np.asarray(episode.uniform(jax.random.key(0), LOW, HIGH, 1000))
    assert not np.any(np.all(np.diff(still, axis=0) == 0, 1))


def test_a_plant_in_jax_ends_where_the_task_says_so():
    task = TASK._replace(stop=lambda x: x[0] > 1.5, stop_cost=0.8)
    push = lambda key, t, x: jnp.array([2.0])  # noqa: E731
    free = jax.jit(lambda key: episode.run(key, push, TASK._replace(sensor_std=np.zeros(2))))(jax.random.key(0))
    flight = jax.jit(lambda key: episode.run(key, push, task._replace(sensor_std=np.zeros(2))))(jax.random.key(0))
    length = 1 + int(np.argmax(free.x[1:, 0] > 1.5))
    assert 1 < length < 6
    assert int(flight.length) == length
    np.testing.assert_allclose(flight.cost, [*free.cost[:length], *[0.8] * (6 - length)], rtol=1e-6)
    short = episode.trimmed(flight)
    assert (short.x.shape, short.u.shape, short.length) == ((length + 1, 2), (length, 1), None)
    whole = episode.padded(short, 6)
    assert (whole.x.shape, int(whole.length)) == ((7, 2), length)
    np.testing.assert_array_equal(episode.trimmed(whole).x, short.x)
    np.testing.assert_allclose(episode.charged(short.cost, task), flight.cost, rtol=1e-6)
