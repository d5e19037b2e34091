"""Model fitting: it minimizes, it reads only rows in use, and a bad gradient never poisons it."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from pegasus_jax.checks import ConfigError
from pegasus_jax.learn.data import minibatch
from pegasus_jax.learn.fit import fit, minibatches
from pegasus_jax.models.ensemble import ensemble
from pegasus_jax.types import Dataset, TrainState
from probes import same

N, SIZE = 30, 12
NOISE = np.random.default_rng(0)
X = NOISE.normal(size=(SIZE, 2))
SLOPE = np.array([[1.0, -2.0], [0.5, 3.0]])
Y = X @ SLOPE.T + 0.3 * NOISE.normal(size=(SIZE, 2))


def data(junk):
    """SIZE rows of a linear relation in a data set of capacity N, whose other rows hold `junk`."""
    x, y = (np.vstack([rows, np.full((N - SIZE, 2), junk)]) for rows in (X, Y))
    return Dataset(jnp.asarray(x, jnp.float32), jnp.zeros((N, 1)), jnp.asarray(y, jnp.float32), jnp.int32(SIZE))


def squares(params, key, batch, context):
    del key, context
    return jnp.mean(jnp.sum((batch.y - batch.x @ params.T) ** 2, -1))


def make(loss=squares, optimizer=None, steps=50, batch_size=8, prepare=lambda data: None):
    optimizer = optimizer or optax.adam(optax.cosine_decay_schedule(0.1, steps))
    fitted = jax.jit(partial(fit, prepare=prepare, loss=loss, optimizer=optimizer, steps=steps, batch_size=batch_size))
    return fitted, TrainState(jnp.zeros((2, 2)), optimizer.init(jnp.zeros((2, 2))))


@pytest.mark.parametrize("junk", [0.0, np.nan])
def test_it_finds_the_least_squares_of_the_rows_in_use(junk):
    """One row beyond `size` in one batch, and the result is not a number."""
    fitted, learner = make(steps=1500, batch_size=64)
    learner, info = fitted(jax.random.key(0), learner, data(junk))
    expected = np.linalg.lstsq(X, Y, rcond=None)[0].T
    np.testing.assert_allclose(learner.params, expected, atol=0.03)
    assert info.skipped == 0
    assert info.loss < info.first


def test_the_losses_reported_are_those_of_the_first_and_last_tenth():
    """Each step's loss is its number here: gradient 1, step size 1, loss = -params."""
    fitted, learner = make(lambda p, key, batch, context: jnp.sum(p), optax.sgd(0.25), steps=40)
    _, info = fitted(jax.random.key(0), learner, data(0))
    np.testing.assert_allclose([info.first, info.loss], [-1.5, -37.5])
    fitted, learner = make(lambda p, key, batch, context: jnp.sum(p), optax.sgd(0.25), steps=3)
    _, info = fitted(jax.random.key(0), learner, data(0))
    np.testing.assert_allclose([info.first, info.loss], [0, -2])


def test_prepare_sees_the_whole_data_set_and_the_loss_its_answer():
    fitted, learner = make(
        lambda p, key, batch, context: jnp.sum((p - context) ** 2),
        optax.sgd(0.5),
        steps=1,
        prepare=lambda data: data.size.astype(jnp.float32),
    )
    learner, _ = fitted(jax.random.key(0), learner, data(0))
    np.testing.assert_allclose(learner.params, SIZE * np.ones((2, 2)))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_bad_gradient_skips_its_update_and_nothing_else(value):
    """Bad at random: what remains are so many unit gradients, of which descent and Adam must have seen each."""
    bad = []

    def loss(params, key, batch, context):
        spoiled = jax.random.bernoulli(key, 0.3)
        jax.debug.callback(lambda b: bad.append(bool(b)), spoiled)
        return jnp.sum(params * jnp.where(spoiled, value, 1.0))

    optimizer = optax.chain(optax.scale_by_adam(), optax.scale(-1.0))
    fitted, learner = make(loss, optimizer, steps=40)
    learner, info = fitted(jax.random.key(0), learner, data(0))
    jax.effects_barrier()
    assert len(bad) == 40
    assert 0 < sum(bad) < 40
    assert info.skipped == sum(bad)
    assert np.isfinite([info.loss, info.first]).all()
    good = 40 - sum(bad)
    np.testing.assert_allclose(learner.params, -good * np.ones((2, 2)), rtol=1e-4)  # Adam's step on a constant gradient
    assert learner.optimizer[0].count == good
    np.testing.assert_allclose(learner.optimizer[0].mu, 1 - 0.9**good, rtol=1e-5)
    _, again = fitted(jax.random.key(1), learner, data(0))
    jax.effects_barrier()
    assert again.skipped == sum(bad[40:])  # each call counts its own


@pytest.mark.parametrize("spoil", [lambda total: total * jnp.nan, lambda total: total + jnp.nan])
def test_a_fit_that_sees_nothing_but_bad_numbers_changes_nothing(spoil):
    """Bad gradients, then good ones of a bad loss."""
    fitted, learner = make(lambda p, key, batch, context: spoil(jnp.sum(p)))
    after, info = fitted(jax.random.key(0), learner, data(0))
    assert same(after.params, learner.params)
    assert same(after.optimizer, learner.optimizer)
    assert info.skipped == 50
    assert np.isnan([info.loss, info.first]).all()


OPTIMIZERS = {
    "adam": optax.adam(0.05),
    "momentum": optax.sgd(0.02, momentum=0.9),
    "clipped": optax.chain(optax.clip_by_global_norm(1.0), optax.adamw(0.05)),
    "several steps": optax.MultiSteps(optax.adam(0.1), 2).gradient_transformation(),
    "told the loss": optax.chain(optax.adam(0.05), optax.contrib.reduce_on_plateau(patience=20)),
    "line search": optax.lbfgs(),
    "guarded already": optax.apply_if_finite(optax.adam(0.05), 3),
}


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_any_optimizer_fits_and_is_handed_back_in_its_own_state(name):
    optimizer = OPTIMIZERS[name]
    fitted, learner = make(optimizer=optimizer, steps=200, batch_size=32)
    after, info = fitted(jax.random.key(0), learner, data(0))
    assert info.loss < 0.5 * info.first
    assert info.skipped == 0
    assert jax.tree.structure(after.optimizer) == jax.tree.structure(optimizer.init(learner.params))
    again, _ = fitted(jax.random.key(1), after, data(0))  # it goes on from that state
    assert jnp.all(jnp.isfinite(again.params))


def test_a_fit_is_the_loop_that_a_user_would_write():
    """The guard costs no bit: the same updates, one after the other, by optax alone."""
    optimizer = optax.adam(0.05)
    fitted, learner = make(optimizer=optimizer, steps=5)
    after, _ = fitted(jax.random.key(3), learner, data(0))
    params, state = learner.params, optimizer.init(learner.params)
    for key in jax.random.split(jax.random.key(3), 5):
        row_key, noise_key = jax.random.split(key)
        gradient = jax.grad(squares)(params, noise_key, minibatch(row_key, data(0), 8), None)
        updates, state = optimizer.update(gradient, state, params)
        params = optax.apply_updates(params, updates)
    np.testing.assert_allclose(after.params, params, rtol=1e-6)
    np.testing.assert_allclose(after.optimizer[0].mu, state[0].mu, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "value"), [("x", jnp.zeros(N)), ("u", jnp.zeros((N + 1, 1))), ("y", jnp.zeros((N, 3)))]
)
def test_data_of_other_shapes_are_refused_by_name(name, value):
    fitted, learner = make()
    with pytest.raises(ValueError, match=rf"^data\.{name} has shape .*; expected \[N, .\] "):
        fitted(jax.random.key(0), learner, data(0)._replace(**{name: value}))


def test_steps_differ_in_rows_and_noise_and_keys_decide_them():
    """No two steps see the same key, and none sees the key of the rows."""
    keys, rows = [], []

    def loss(params, key, batch, context):
        jax.debug.callback(lambda k: keys.append(k.tobytes()), jax.random.key_data(key))
        jax.debug.callback(lambda x: rows.append(x.tobytes()), batch.x)
        return jnp.sum(params * jax.random.normal(key))

    fitted, learner = make(loss)
    first, _ = fitted(jax.random.key(0), learner, data(0))
    jax.effects_barrier()
    assert len(set(keys)) == len(set(rows)) == 50
    again, _ = fitted(jax.random.key(0), learner, data(0))
    other, _ = fitted(jax.random.key(1), learner, data(0))
    assert same(first, again)
    assert not same(first.params, other.params)


def test_more_data_does_not_trace_again():
    traces = 0

    def loss(params, key, batch, context):
        nonlocal traces
        traces += 1
        return squares(params, key, batch, context)

    fitted, learner = make(loss)
    for trial in (4, 8, 12):
        learner, _ = fitted(jax.random.key(trial), learner, data(0)._replace(size=jnp.int32(trial)))
        if trial == 4:
            once = traces
    assert traces == once


@pytest.mark.parametrize(
    ("what", "said"),
    [
        (
            lambda: minibatches(None, optax.adam(1e-3), batch_size=5.5),
            "batch_size=5.5 is not a whole number; for example batch_size=6",
        ),
        (
            lambda: minibatches(None, optax.adam(1e-3), batch_size=5.0),
            "batch_size=5 is not a whole number as written, 5.0; write batch_size=5",
        ),
        (lambda: minibatches(None, optax.adam(1e-3), batch_size="10"), "as written, '10'; write batch_size=10"),
        (lambda: ensemble(None, members=0), "members=0 is out of range"),
    ],
)
def test_pieces_that_cannot_be_are_one_line(what, said):
    with pytest.raises(ConfigError, match=said):
        what()
