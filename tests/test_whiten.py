"""Whitening: an exact affine change of coordinates, from the rows in use and no others."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pegasus_jax.math import normalize as module

whitener = jax.jit(module.whitener, static_argnames="full")
whiten, unwhiten = jax.jit(module.whiten), jax.jit(module.unwhiten)
N, F = 40, 3
seeds = st.integers(0, 2**16)
both = pytest.mark.parametrize("full", [True, False])


def correlated(seed, rows=N, scale=1.0):
    noise = np.random.default_rng(seed)
    root = noise.normal(size=(F, F)) + 2 * np.eye(F)
    return (noise.normal(size=F) * 5 + scale * noise.normal(size=(rows, F)) @ root.T).astype(np.float32)


@given(seeds, st.integers(F + 2, N), st.booleans())
def test_unwhiten_undoes_whiten(seed, size, full):
    rows = jnp.asarray(correlated(seed))
    w = whitener(rows, jnp.int32(size), full=full)
    np.testing.assert_allclose(unwhiten(w, whiten(w, rows)), rows, atol=2e-4)
    np.testing.assert_allclose(w.root @ w.inverse, np.eye(F), atol=1e-3)


def covariance(rows):
    """Of the rows and one more, whose columns are uncorrelated: the correlations shrink by N / (N + 1)."""
    found = np.cov(rows.astype(np.float64).T, bias=True)
    return (len(rows) * found + np.diag(np.diag(found))) / (len(rows) + 1)


@given(seeds, st.integers(10, N))
def test_white_rows_have_zero_mean_and_identity_covariance(seed, size):
    """The covariance with one more row of uncorrelated columns, which shrinks towards that of the rows."""
    rows = correlated(seed)
    w = whitener(jnp.asarray(rows), jnp.int32(size))
    white = np.asarray(whiten(w, jnp.asarray(rows)), np.float64)[:size]
    np.testing.assert_allclose(white.mean(0), 0, atol=1e-3)
    inverse = np.asarray(w.inverse, np.float64)
    np.testing.assert_allclose(inverse @ covariance(rows[:size]) @ inverse.T, np.eye(F), atol=3e-3)


def test_a_thousand_rows_are_whitened_as_if_there_were_no_other():
    rows = correlated(5, rows=1000)
    w = whitener(jnp.asarray(rows), jnp.int32(1000))
    white = np.asarray(whiten(w, jnp.asarray(rows)), np.float64)
    np.testing.assert_allclose(np.cov(white.T, bias=True), np.eye(F), atol=2e-2)


@given(seeds)
def test_seven_rows_of_nearly_dependent_columns_are_not_enlarged(seed):
    """The rows of a first fall: a step of a tenth off their plane stays of the order of one."""
    noise = np.random.default_rng(seed)
    rows = np.zeros((N, F), np.float32)
    rows[:7] = noise.normal(size=(7, F))
    rows[:7, 2] = rows[:7, 0] + 0.02 * noise.normal(size=7)
    w = whitener(jnp.asarray(rows), jnp.int32(7))
    step = 0.1 * rows[:7].std(0) * np.array([0, 0, 1], np.float32)
    assert np.abs(np.asarray(whiten(w, jnp.asarray(rows[:7] + step))) - np.asarray(whiten(w, rows[:7]))).max() < 0.5


@given(seeds)
def test_diagonal_whitening_scales_each_column_alone(seed):
    rows = correlated(seed)
    w = whitener(jnp.asarray(rows), jnp.int32(N), full=False)
    np.testing.assert_allclose(whiten(w, rows), (rows - rows.mean(0)) / rows.std(0), atol=1e-4)


@both
@given(seed=seeds, size=st.integers(1, N - 1), junk=st.sampled_from([1e6, np.inf, np.nan]))
def test_rows_beyond_size_do_not_matter(full, seed, size, junk):
    rows = correlated(seed)
    clean, dirty = rows.copy(), rows.copy()
    clean[size:], dirty[size:] = 0, junk
    for a, b in zip(*(whitener(jnp.asarray(r), jnp.int32(size), full=full) for r in (clean, dirty)), strict=True):
        assert np.array_equal(a, b)


@both
@pytest.mark.parametrize("value", [0.0, 3.14, -1e4])
def test_a_constant_column_stays_finite(full, value):
    """An angle that has not moved yet; its mean in float32 may be off by a rounding."""
    rows = correlated(0)
    rows[:, 1] = value
    w = whitener(jnp.asarray(rows), jnp.int32(N), full=full)
    white = np.asarray(whiten(w, jnp.asarray(rows)))
    assert np.all(np.isfinite(white))
    assert np.max(np.abs(white)) < 10
    np.testing.assert_allclose(unwhiten(w, white), rows, atol=1e-4 * max(1, abs(value)))


@both
@pytest.mark.parametrize("value", [0.0, 3.14, -1e4])
def test_a_column_that_never_varied_is_told_from_small_and_correlated_ones(full, value):
    rows = correlated(0)
    rows[:, 1] = value
    rows[:, 0] *= 1e-4
    rows[:, 2] = rows[:, 0] + 2e-2 * np.std(rows[:, 0]) * rows[:, 2]
    w = whitener(jnp.asarray(rows), jnp.int32(N), full=full)
    assert module.varied(w).tolist() == [True, False, True]


@both
def test_a_dependent_column_stays_finite(full):
    rows = correlated(1)
    rows[:, 2] = rows[:, 0] - 2 * rows[:, 1]
    w = whitener(jnp.asarray(rows), jnp.int32(N), full=full)
    white = np.asarray(whiten(w, jnp.asarray(rows)))
    assert np.all(np.isfinite(white))
    np.testing.assert_allclose(unwhiten(w, white), rows, atol=2e-3)


@both
@pytest.mark.parametrize("size", [0, 1, 2])
def test_too_few_rows_stay_finite(full, size):
    rows = np.zeros((N, F), np.float32)
    rows[:size] = correlated(2)[:size]
    w = whitener(jnp.asarray(rows), jnp.int32(size), full=full)
    assert all(np.all(np.isfinite(part)) for part in w)
    assert np.all(np.isfinite(whiten(w, rows[:size])))


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_the_factor_is_lower_triangular_and_in_units_of_the_data(scale):
    """The predicted noise is a fraction of the root's diagonal: it must scale with the data."""
    rows = correlated(3) * np.float32(scale)
    w = whitener(jnp.asarray(rows), jnp.int32(N))
    assert np.array_equal(np.asarray(w.root), np.tril(w.root))
    expected = np.linalg.cholesky(covariance(rows))
    np.testing.assert_allclose(w.root, expected, rtol=2e-3, atol=2e-3 * scale)


@given(seeds)
def test_what_dependent_columns_need_changes_nothing_where_there_are_none(seed):
    """To the last bit, against a whitener that takes every column for a free one."""
    rows = jnp.asarray(correlated(seed))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "independent", lambda correlation: jnp.ones(F, bool))
        expected = module.whitener(rows, jnp.int32(N))
    for found, value in zip(module.whitener(rows, jnp.int32(N)), expected, strict=True):
        assert np.array_equal(found, value)


def repeated(rows, how):
    """The columns [N, F] with one more that follows from them, or never changes."""
    first, second = rows[:, 0], rows[:, 1]
    made = {
        "twice": first,
        "degrees": np.rad2deg(first),
        "both": 3 * first - second + 1,
        "enlarged": 1e4 * first,
        "reduced": 1e-4 * first,
        "offset": 1000 + 500 * first,
        "constant": np.full_like(first, 0.7),
        "large": np.full_like(first, 1e4),
    }
    return np.column_stack([rows, made[how]]).astype(np.float32)


@pytest.mark.parametrize("how", ["twice", "degrees", "both", "enlarged", "reduced", "offset", "constant", "large"])
@given(seed=seeds)
def test_what_follows_from_other_columns_is_not_enlarged(how, seed):
    """White rows are the data again, and a step off the data's plane, as imagined states take, stays a small one."""
    rows = repeated(correlated(seed), how)
    w = whitener(jnp.asarray(rows), jnp.int32(N))
    white = np.asarray(whiten(w, jnp.asarray(rows)))
    assert np.abs(white).max() < 20
    scale = np.abs(rows).max(0)
    np.testing.assert_allclose(unwhiten(w, white) / scale, rows / scale, atol=2e-4)
    if how in ("twice", "degrees", "both", "enlarged", "reduced", "offset"):
        assert not module.independent(jnp.corrcoef(rows.T))[-1]
        off = whiten(w, jnp.asarray(rows + 0.1 * rows.std(0) * np.eye(F + 1, dtype=np.float32)[-1]))
        assert np.abs(np.asarray(off) - white).max() < 0.2


def test_several_dependent_columns_leave_the_free_ones_as_they_are():
    rows = correlated(4)
    more = np.column_stack([rows, rows @ np.array([1.0, 2.0, 0.0]), rows @ np.array([0.0, 1.0, -1.0])]).astype(
        np.float32
    )
    free = module.independent(jnp.corrcoef(more.T))
    assert free.tolist() == [True, True, True, False, False]
    one, two = (whitener(jnp.asarray(r), jnp.int32(N)) for r in (rows, more))
    np.testing.assert_allclose(two.root[:F, :F], one.root, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(np.abs(two.root[F:, :F]), 0, atol=1e-5)
