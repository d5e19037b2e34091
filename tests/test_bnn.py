"""Bayesian neural network dynamics: eq. 2 written out in NumPy, draws that are held, and functions it must learn."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy import stats

from pegasus_jax.learn.fit import fit
from pegasus_jax.models import dropout
from pegasus_jax.models.bnn import bnn
from pegasus_jax.models.networks import HEADS
from pegasus_jax.types import Batch, Dataset, TrainState
from probes import experience, network

BATCH = Batch(*(rows[:6] for rows in experience()[:3]))


def whitening(rows):
    """Mean and root of rows in float64, whose correlations count one more row, of uncorrelated columns."""
    found, n = np.cov(rows.astype(np.float64).T, bias=True), len(rows)
    return rows.mean(0), np.linalg.cholesky((n * found + np.diag(np.diag(found))) / (n + 1))


def log_normal_kl(params):
    """Sum over units of KL(truncated log-normal || log-uniform on [-10, 0]), by scipy's entropy."""
    mu = -10 + 10 / (1 + np.exp(-np.asarray(params["location"], np.float64)))
    sigma = 0.01 + (10 / np.sqrt(12) - 0.01) / (1 + np.exp(-np.asarray(params["scale"], np.float64)))
    entropies = [
        stats.truncnorm((-10 - m) / s, -m / s, loc=m, scale=s).entropy() for m, s in zip(mu, sigma, strict=True)
    ]
    return float(np.log(10) * len(mu) - np.sum(entropies))


@pytest.mark.parametrize("value", [0.0, 0.3, -1e4])
def test_an_input_that_has_never_varied_is_not_seen(value):
    """A goal during the first episode, say: beside it nothing is known, and the next episode's is elsewhere."""
    data = experience()
    data = data._replace(x=data.x.at[:, 0].set(value))
    model = network("none", True)
    posterior = model.posterior(model.init(jax.random.key(0)), data)
    x, u, draw = data.x[5], data.u[5], model.sample(jax.random.key(1), posterior)
    here, there = (model.apply(posterior, draw, x.at[0].set(a), u) for a in (value, value + 2))
    assert all(np.array_equal(a, b) for a, b in zip(here, there, strict=True))
    moved = model.apply(posterior, draw, x.at[1].add(0.1), u)
    assert not np.array_equal(here.mean, moved.mean)


@pytest.mark.parametrize(
    ("kind", "heteroscedastic"),
    [("none", True), ("none", False), ("log_normal", True)],
)
def test_the_loss_is_eq_2_over_n(kind, heteroscedastic):
    """-log likelihood a row without its 2 pi, plus KL and half the squared weights, over the rows of the data set.

    Log-normal noise is switched off by setting its location and scale where it is all but 1, so that NumPy need not
    know the base draws; its KL is then far from zero.
    """
    data = experience()
    model = network(kind, heteroscedastic, weight_decay=3.0, head=HEADS["softplus"])
    params = jax.jit(model.init)(jax.random.key(0))
    if kind == "log_normal":
        params["noise"] = ({}, {"location": jnp.full(8, 12.0), "scale": jnp.full(8, -30.0)})
    loss = jax.jit(model.loss)(params, jax.random.key(1), BATCH, model.prepare(data))

    size = int(data.size)
    rows = np.asarray(data.x)[:size], np.asarray(data.u)[:size], np.asarray(data.y)[:size]
    inputs = lambda x, u: np.concatenate([x[:, :2], np.sin(x[:, 2:]), np.cos(x[:, 2:]), u], 1)  # noqa: E731
    mean_in, root_in = whitening(inputs(rows[0], rows[1]))
    mean_out, root_out = whitening(rows[2])
    layers = [jax.tree.map(np.asarray, params["network"]["params"][f"layer_{i}"]) for i in range(2)]
    white = np.linalg.solve(root_in, (inputs(*(np.asarray(r) for r in BATCH[:2])) - mean_in).T).T
    mask = 1.0
    if kind == "log_normal":
        mask = np.exp(-0.008)  # sigma .01 under the upper end: E[log z] = -.008
    out = (
        np.maximum(white @ layers[0]["kernel"] + layers[0]["bias"], 0) * mask @ layers[1]["kernel"] + layers[1]["bias"]
    )
    mean = mean_out + out[:, :3] @ root_out.T
    raw = out[:, 3:] if heteroscedastic else np.zeros((6, 3))
    std = (np.log1p(np.exp(raw)) + 1e-6) * np.diag(root_out)
    nll = 0.5 * ((np.asarray(BATCH.y) - mean) / std) ** 2 + np.log(std)
    penalty = 1.5 * sum(np.sum(layer[k] ** 2) for layer in layers for k in ("kernel", "bias"))
    if kind == "log_normal":
        penalty += log_normal_kl(params["noise"][1])
    expected = nll.sum(1).mean() + penalty / size
    np.testing.assert_allclose(loss, expected, rtol=1e-2 if kind == "log_normal" else 1e-3)
    assert penalty / size > 0.1 * abs(expected)  # so that a wrong penalty, or N, would show


def test_binary_dropout_thins_the_weight_prior_of_the_layers_it_acts_on():
    """docs/reference.md 4.4: half p_keep |W|^2; the first layer, whose inputs carry no noise, keeps all of it."""
    data, model = experience(), network("binary", weight_decay=1.0)
    plain = network("binary", weight_decay=0.0)
    params = jax.jit(model.init)(jax.random.key(0))
    both = [jax.jit(m.loss)(params, jax.random.key(1), BATCH, m.prepare(data)) for m in (model, plain)]
    layers = [params["network"]["params"][f"layer_{i}"] for i in range(2)]
    expected = 0.5 * sum(float(jnp.sum(layer["bias"] ** 2)) for layer in layers)
    expected += 0.5 * (float(jnp.sum(layers[0]["kernel"] ** 2)) + 0.9 * float(jnp.sum(layers[1]["kernel"] ** 2)))
    np.testing.assert_allclose((both[0] - both[1]) * int(data.size), expected, rtol=2e-2)


def test_every_row_of_a_batch_has_noise_of_its_own():
    """Kingma's local noise: a batch of one row repeated has as many losses as it has rows."""
    model, data = network("binary"), experience()
    params = jax.jit(model.init)(jax.random.key(0))
    one = Batch(*(rows[:1] for rows in BATCH))
    many = Batch(*(jnp.repeat(rows, 400, 0) for rows in one))
    loss = jax.jit(model.loss)
    scaling = model.prepare(data)
    single = np.array([loss(params, jax.random.key(s), one, scaling) for s in range(60)])
    batches = np.array([loss(params, jax.random.key(1000 + s), many, scaling) for s in range(10)])
    assert single.std() > 3 * batches.std()
    np.testing.assert_allclose(batches.mean(), single.mean(), atol=5 * single.std() / np.sqrt(60))


@pytest.mark.parametrize("kind", ["log_normal", "binary", "none"])
def test_a_draw_is_one_deterministic_function_and_draws_differ(kind):
    model = network(kind)
    posterior = jax.jit(lambda key, data: model.posterior(model.init(key), data))(jax.random.key(0), experience())
    draws = jax.jit(jax.vmap(model.sample, (0, None)))(jax.random.split(jax.random.key(1), 20), posterior)
    apply = jax.jit(jax.vmap(model.apply, (None, 0, None, None)))
    means = [apply(posterior, draws, x, u).mean for x, u in zip(BATCH.x[:2], BATCH.u[:2], strict=True)]
    again = apply(posterior, draws, BATCH.x[0], BATCH.u[0]).mean
    assert np.array_equal(means[0], again)
    different = len(np.unique(means[0], axis=0))
    assert different == 1 if kind == "none" else different > 3  # a dropped unit may have been silent anyway
    assert draws[0] is None  # no noise on the inputs


def test_angles_enter_by_sine_and_cosine():
    model = network()
    posterior = model.posterior(jax.jit(model.init)(jax.random.key(0)), experience())
    draw = model.sample(jax.random.key(1), posterior)
    x, u = BATCH.x[0], BATCH.u[0]
    here, there = (model.apply(posterior, draw, x.at[2].add(turn), u).mean for turn in (0.0, 2 * np.pi))
    np.testing.assert_allclose(here, there, atol=1e-5)


# Functions to learn: y = sin(2 x) + u / 2, one state and one control

STD = 0.05
CAPACITY = 300


def curve(x, u):
    return np.sin(2 * x) + u / 2


def observed(std, rows=240, seed=0):
    noise = np.random.default_rng(seed)
    x, u = noise.uniform(-2, 2, size=(rows, 1)), noise.uniform(-1, 1, size=(rows, 1))
    y = curve(x, u) + std(x) * noise.normal(size=x.shape)
    pad = lambda a: jnp.asarray(np.pad(a, ((0, CAPACITY - rows), (0, 0))), jnp.float32)  # noqa: E731
    return Dataset(pad(x), pad(u), pad(y), jnp.int32(rows))


def learned(std, *, kind="none", head="softplus", heteroscedastic=True, steps=1500):
    """A small network fitted to the curve: (data, loss before, loss after, predictions(x, u) [draws, rows])."""
    model = bnn(
        states=1,
        controls=1,
        angles=(),
        hidden=(32, 32),
        dropout=getattr(dropout, kind)(),
        head=HEADS[head],
        heteroscedastic=heteroscedastic,
        weight_decay=0.01,
        initializer="glorot",
    )
    data = observed(std)
    optimizer = optax.adam(optax.cosine_decay_schedule(1e-2, steps))
    fitted = partial(fit, prepare=model.prepare, loss=model.loss, optimizer=optimizer, steps=steps, batch_size=64)

    @jax.jit
    def run(key, data):
        init_key, fit_key, draw_key = jax.random.split(key, 3)
        params = model.init(init_key)
        learner, info = fitted(fit_key, TrainState(params, optimizer.init(params)), data)
        posterior = model.posterior(learner.params, data)
        return posterior, jax.vmap(model.sample, (0, None))(jax.random.split(draw_key, 100), posterior), info

    posterior, draws, info = run(jax.random.key(0), data)
    of_rows = jax.vmap(model.apply, (None, None, 0, 0))
    predict = jax.jit(jax.vmap(of_rows, (None, 0, None, None)))
    return info, lambda x, u: predict(posterior, draws, jnp.asarray(x, jnp.float32), jnp.asarray(u, jnp.float32))


def test_it_learns_a_function_and_its_interval_covers():
    """Held-out rows: the mean is close, and most lie within the 95 % interval of functions and noise."""
    info, predict = learned(lambda x: STD, kind="log_normal")
    assert info.loss < info.first - 1
    held_out = observed(lambda x: STD, seed=1)
    x, u, y = (np.asarray(rows)[:200] for rows in held_out[:3])
    prediction = predict(x, u)
    mean = np.asarray(prediction.mean).mean(0)
    total = np.sqrt(np.asarray(prediction.mean).var(0) + np.asarray(prediction.std**2).mean(0))
    assert np.sqrt(np.mean((mean - curve(x, u)) ** 2)) < 0.15
    assert np.mean(np.abs(y - mean) < 1.96 * total) >= 0.8
    assert np.mean(total) < 6 * STD  # and does not cover by being vague


def test_a_heteroscedastic_head_finds_where_the_noise_is():
    _, predict = learned(lambda x: np.where(x > 0, 0.3, 0.03))
    x = np.linspace(-1.5, 1.5, 31)[:, None]
    std = np.asarray(predict(x, np.zeros_like(x)).std)[0, :, 0]
    quiet, loud = std[x[:, 0] < -0.4], std[x[:, 0] > 0.4]
    assert 0.01 < np.median(quiet) < 0.08
    assert 0.15 < np.median(loud) < 0.5


def test_a_homoscedastic_model_has_one_noise_and_learns_its_size():
    _, predict = learned(lambda x: 0.2, heteroscedastic=False)
    x = np.linspace(-1.5, 1.5, 7)[:, None]
    std = np.asarray(predict(x, np.zeros_like(x)).std)
    np.testing.assert_allclose(std, std[0, 0, 0])
    assert 0.15 < std[0, 0, 0] < 0.25


def test_heads_are_positive_and_the_sigmoid_is_at_most_a_tenth_of_the_targets_scale():
    for raw in (-1e4, -3.0, 0.0, 3.0, 1e4):
        assert 0 < HEADS["sigmoid"](jnp.float32(raw)) <= 0.1 + 2e-6
        assert HEADS["softplus"](jnp.float32(raw)) > 0
    np.testing.assert_allclose(HEADS["softplus"](jnp.float32(0)), np.log(2), rtol=1e-5)


def test_the_scaling_follows_the_data():
    """More data, other whitening; and only the rows in use enter."""
    data = experience()
    model = network()
    junk = data._replace(x=data.x.at[30:].set(1e6), y=data.y.at[30:].set(jnp.nan))
    first, second = model.prepare(data), model.prepare(junk)
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True))
    np.testing.assert_allclose(first.targets.mean, np.asarray(data.y[:30]).mean(0), atol=1e-5)
    half = model.prepare(data._replace(size=jnp.int32(15)))
    assert not np.allclose(half.targets.mean, first.targets.mean)
