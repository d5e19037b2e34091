"""The data set: rows go in once, in order, and only rows in use ever come out."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pegasus_jax.learn import data as dataset
from pegasus_jax.types import Trajectory

H, D, U = 5, 3, 2


def episode(seed):
    noise = np.random.default_rng(seed)
    x = (noise.normal(size=(H + 1, D)) * 2).astype(np.float32)
    x[:, 1] = np.arctan2(np.sin(x[:, 1] * 3), np.cos(x[:, 1] * 3))  # an angle that jumps at the seam
    return Trajectory(jnp.asarray(x), jnp.asarray(noise.normal(size=(H, U)), jnp.float32), jnp.zeros(H))


add = jax.jit(partial(dataset.add, angles=(1,)))
minibatch = jax.jit(partial(dataset.minibatch, rows=16))


@cache
def filled(episodes, capacity):
    data = dataset.empty(capacity, D, U)
    for seed in range(episodes):
        data = add(data, episode(seed))
    return data


@pytest.mark.parametrize(("episodes", "spare"), [(0, 3), (1, 0), (4, 0), (3, 7)])
def test_episodes_stand_in_order_and_the_rest_is_zero(episodes, spare):
    data = filled(episodes, H * episodes + spare)
    assert int(data.size) == H * episodes
    for seed in range(episodes):
        x, u, rows = episode(seed).x, episode(seed).u, slice(H * seed, H * (seed + 1))
        assert np.array_equal(data.x[rows], x[:-1])
        assert np.array_equal(data.u[rows], u)
        after = np.asarray(data.x[rows] + data.y[rows])
        np.testing.assert_allclose(after[:, [0, 2]], x[1:, [0, 2]], atol=1e-5)
        np.testing.assert_allclose(np.cos(after[:, 1]), np.cos(x[1:, 1]), atol=1e-5)
        np.testing.assert_allclose(np.sin(after[:, 1]), np.sin(x[1:, 1]), atol=1e-5)
        assert np.all(np.abs(data.y[rows][:, 1]) <= np.float32(np.pi))  # never the long way round
    assert all(not np.any(rows[H * episodes :]) for rows in data[:3])


def test_grown_data_is_the_same_data_with_more_room():
    small, large = filled(2, 2 * H), filled(2, 5 * H)
    grown = dataset.grow(small, 5 * H)
    assert all(np.array_equal(a, b) for a, b in zip(grown, large, strict=True))
    again = add(grown, episode(2))
    assert all(np.array_equal(a, b) for a, b in zip(again, filled(3, 5 * H), strict=True))


@pytest.mark.parametrize(("x", "u"), [(1, U), (D, 1)])
def test_an_episode_of_another_width_is_refused(x, u):
    """It would fill every column with one."""
    narrow = episode(0)._replace(x=jnp.zeros((H + 1, x)), u=jnp.zeros((H, u)))
    with pytest.raises(ValueError, match=r"an episode's \w has shape \(\d, 1\); expected \(\d, \d\)"):
        dataset.add(dataset.empty(H, D, U), narrow, ())


def test_numbers_of_numpy_are_numbers():
    assert dataset.room(np.int64(10)) == dataset.room(10)
    data, one = dataset.empty(H, D, U), jax.device_get(episode(0))
    assert np.array_equal(dataset.add(data, one, (1,)).y, filled(1, H).y)
    fetched = jax.device_get(filled(1, H))
    batches = [
        jax.jit(lambda key, of=of: dataset.minibatch(key, of, 4))(jax.random.key(0)) for of in (fetched, filled(1, H))
    ]
    assert np.array_equal(batches[0].x, batches[1].x)


@given(st.integers(0, 2**16), st.integers(1, 3))
def test_a_minibatch_holds_whole_rows_in_use(seed, episodes):
    data = filled(episodes, 3 * H)
    batch = minibatch(jax.random.key(seed), data)
    used = np.concatenate([data.x, data.u, data.y], 1)[: H * episodes]
    for row in np.concatenate(batch, 1):
        assert np.any(np.all(used == row, 1))


def test_every_row_in_use_is_drawn_equally_often():
    data = filled(2, 4 * H)
    batch = dataset.minibatch(jax.random.key(0), data, 4000)
    counts = np.array([np.sum(np.all(batch.x == row, 1)) for row in data.x[: 2 * H]])
    assert counts.sum() == 4000
    np.testing.assert_allclose(counts, 400, atol=5 * np.sqrt(400))
