"""Gaussian-process dynamics: the exact process against scikit-learn, and what exact and sparse must both do."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from pegasus_jax.pilco import kernels
from pegasus_jax.pilco.gp import gp, log_evidence
from pegasus_jax.pilco.lbfgs import full_data
from pegasus_jax.pilco.ssgp import ssgp
from pegasus_jax.types import Dataset, TrainState
from probes import experience, same

SHAPES = dict(states=3, controls=2, angles=(2,))
MODELS = {"gp": partial(gp, features=20), "ssgp": partial(ssgp, points=20)}
both = pytest.mark.parametrize("kind", MODELS)


def parameters(model, seed=0, noise=0.1):
    """Hyperparameters that differ from each other and from every default."""
    params = jax.jit(model.init)(jax.random.key(seed))
    draws = np.random.default_rng(seed)
    shape = params["log_lengthscale"].shape
    return params | {
        "log_lengthscale": jnp.asarray(0.5 + 0.3 * draws.normal(size=shape)),
        "log_signal": jnp.asarray(0.2 * draws.normal(size=shape[0])),
        "log_noise": jnp.asarray(np.log(noise) + 0.2 * draws.normal(size=shape[0])),
    }


def scaled(data):
    """The rows in use in units of their own mean and deviation, by NumPy."""
    x, u, y = (np.asarray(rows, float)[: int(data.size)] for rows in data[:3])
    inputs = np.concatenate([x[:, :2], np.sin(x[:, 2:]), np.cos(x[:, 2:]), u], 1)
    return (inputs, y, *((rows.mean(0), rows.std(0)) for rows in (inputs, y)))


def reference(params, data):
    """scikit-learn's regressors of the scaled data, one an output."""
    inputs, y, (mean_in, std_in), (mean_out, std_out) = scaled(data)
    lengths, signal, noise = (np.exp(params[f"log_{name}"]) for name in ("lengthscale", "signal", "noise"))
    regressors = []
    for e in range(y.shape[1]):
        covariance = ConstantKernel(signal[e] ** 2) * RBF(lengths[e]) + WhiteKernel(noise[e] ** 2)
        regressor = GaussianProcessRegressor(covariance, alpha=0, optimizer=None)
        regressors.append(regressor.fit((inputs - mean_in) / std_in, (y[:, e] - mean_out[e]) / std_out[e]))
    return regressors


# The exact process


def test_predictions_and_evidence_are_scikit_learns(x64):
    data, model = experience(), gp(**SHAPES)
    params = parameters(model)
    regressors = reference(params, data)
    rows, h = model.prepare(data), kernels.hyper(params)
    evidence = jax.jit(log_evidence)(h, rows)
    np.testing.assert_allclose(evidence, [r.log_marginal_likelihood() for r in regressors], rtol=1e-9)
    loss = jax.jit(model.loss)(params, None, None, rows)
    np.testing.assert_allclose(loss * 30, kernels.penalty(h) - np.sum(evidence), rtol=1e-12)

    _, _, (mean_in, std_in), (mean_out, std_out) = scaled(data)
    points = mean_in + std_in * np.random.default_rng(1).normal(size=(20, 6))
    posterior = jax.jit(model.posterior)(params, data)
    images = jax.jit(jax.vmap(model.moments, (None, 0, None)))(posterior, jnp.asarray(points), jnp.zeros((6, 6)))
    for e, r in enumerate(regressors):
        mean, std = r.predict((points - mean_in) / std_in, return_std=True)
        noise = np.exp(params["log_noise"][e])
        np.testing.assert_allclose(images.mean[:, e], mean_out[e] + std_out[e] * mean, atol=1e-9)
        np.testing.assert_allclose(images.cov[:, e, e], std_out[e] ** 2 * (std**2 - noise**2), rtol=1e-8)
    draw = jax.jit(model.sample)(jax.random.key(0), posterior)
    std = jax.jit(model.apply)(posterior, draw, data.x[0], data.u[0]).std
    np.testing.assert_allclose(std, std_out * np.exp(params["log_noise"]), rtol=1e-9)


def test_draws_have_the_posterior_mean_and_covariance_whatever_the_number_of_features():
    """A draw is one function: its values at several points hang together as the posterior's do."""
    data, model = experience(), gp(**SHAPES, features=10)
    params = parameters(model)
    posterior = jax.jit(model.posterior)(params, data)
    count, points = 20_000, 5
    noise = np.random.default_rng(2)
    x = np.asarray(data.x)[3] + 0.3 * noise.normal(size=(points, 3)).astype(np.float32)
    u = np.asarray(data.u)[:1].repeat(points, 0)
    draws = jax.jit(jax.vmap(model.sample, (0, None)))(jax.random.split(jax.random.key(1), count), posterior)
    values = jax.jit(jax.vmap(jax.vmap(model.apply, (None, None, 0, 0)), (None, 0, None, None)))(posterior, draws, x, u)
    inputs = np.concatenate([x[:, :2], np.sin(x[:, 2:]), np.cos(x[:, 2:]), u], 1)
    _, _, (mean_in, std_in), (mean_out, std_out) = scaled(data)
    for e, r in enumerate(reference(params, data)):
        mean, cov = r.predict((inputs - mean_in) / std_in, return_cov=True)
        cov = std_out[e] ** 2 * (cov - np.exp(2 * params["log_noise"][e]) * np.eye(points))
        drawn = np.asarray(values.mean[:, :, e], float)
        std = np.sqrt(np.diag(cov))
        np.testing.assert_array_less(abs(drawn.mean(0) - (mean_out[e] + std_out[e] * mean)), 5 * std / count**0.5)
        error = (np.cov(drawn.T) - cov) / np.outer(std, std)
        assert abs(error).max() < 0.1  # the draws are a mixture of Gaussians, with heavier tails
        assert (abs(cov - np.diag(np.diag(cov))) / np.outer(std, std)).max() > 0.3


def test_the_penalty_is_a_wall():
    inside = kernels.Hyper(jnp.full((2, 3), 30.0), jnp.ones(2), jnp.full(2, 0.005))
    assert kernels.penalty(inside) < 0.01
    corner = kernels.Hyper(jnp.full((2, 3), 100.0), jnp.ones(2), jnp.full(2, 0.001))
    np.testing.assert_allclose(kernels.penalty(corner), 8, rtol=1e-3)
    beyond = kernels.Hyper(jnp.full((2, 3), 0.005), jnp.ones(2), jnp.full(2, 0.0005))
    assert kernels.penalty(beyond) > 100


# What both must do


@both
def test_gradients_agree_with_finite_differences(x64, kind):
    data, model = experience(), MODELS[kind](**SHAPES)
    params = parameters(model)
    loss = jax.jit(lambda p: model.loss(p, None, None, model.prepare(data)))
    gradient = jax.grad(loss)(params)
    noise = np.random.default_rng(3)
    for name, leaf in params.items():
        shift = 1e-5 * noise.normal(size=leaf.shape)
        above, below = (loss(params | {name: leaf + sign * shift}) for sign in (1, -1))
        np.testing.assert_allclose(np.sum(gradient[name] * shift), (above - below) / 2, rtol=1e-6, atol=1e-12)


@both
def test_rows_not_in_use_do_not_count(kind):
    """Nothing but NaN in them, and not one bit differs."""
    data, model = experience(), MODELS[kind](**SHAPES)
    used = (jnp.arange(40) < data.size)[:, None]
    spoiled = Dataset(*(jnp.where(used, rows, jnp.nan) for rows in data[:3]), data.size)

    @jax.jit
    def everything(params, data):
        rows, posterior = model.prepare(data), model.posterior(params, data)
        draw = model.sample(jax.random.key(0), posterior)
        ahead = model.apply(posterior, draw, jnp.ones(3), jnp.ones(2))
        image = model.moments(posterior, jnp.ones(6), 0.1 * jnp.eye(6))
        return jax.value_and_grad(model.loss)(params, None, None, rows), ahead, image

    params = parameters(model)
    clean = everything(params, data)
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(clean))
    assert same(clean, everything(params, spoiled))


@both
def test_capacity_does_not_change_the_model(x64, kind):
    model = MODELS[kind](**SHAPES)
    params = parameters(model)
    tight, roomy = (experience(rows=30, capacity=n) for n in (30, 50))
    loss = jax.jit(lambda data: model.loss(params, None, None, model.prepare(data)))
    losses = [loss(data) for data in (tight, roomy)]
    np.testing.assert_allclose(*losses, rtol=1e-12)


@both
def test_analytic_moments_are_those_of_the_draws(kind):
    """Every sample has an input of its own and a function of its own; the state has no angle, so that inputs are it."""
    shapes = dict(states=2, controls=1, angles=())
    model = MODELS[kind](**shapes)
    noise = np.random.default_rng(4)
    x, u = noise.normal(size=(25, 2)), noise.normal(size=(25, 1))
    y = np.stack([np.sin(x[:, 0] + u[:, 0]), x[:, 0] * x[:, 1]], 1)
    data = Dataset(*(jnp.asarray(rows, float) for rows in (x, u, y)), jnp.int32(25))
    posterior = jax.jit(model.posterior)(parameters(model), data)
    mean, root = np.array([0.3, -0.2, 0.5]), np.array([[0.5, 0, 0], [0.3, 0.4, 0], [-0.2, 0.1, 0.6]])
    image = jax.jit(model.moments)(posterior, jnp.asarray(mean), jnp.asarray(root @ root.T))

    count, chunk = 100_000, 2000
    inputs = mean + noise.normal(size=(count, 3)) @ root.T

    @jax.jit
    def outputs(rows):
        def one(key, row):
            return model.apply(posterior, model.sample(key, posterior), row[:2], row[2:]).mean

        keys = jax.random.split(jax.random.key(5), count).reshape(-1, chunk)
        return jax.lax.map(lambda both: jax.vmap(one)(*both), (keys, rows.reshape(-1, chunk, 3)))

    f = np.asarray(outputs(jnp.asarray(inputs, float)), float).reshape(-1, 2)
    std = f.std(0)
    np.testing.assert_array_less(abs(image.mean - f.mean(0)), 5 * std / count**0.5)
    np.testing.assert_allclose(image.cov / np.outer(std, std), np.cov(f.T) / np.outer(std, std), atol=0.03)
    crossed = (inputs - mean).T @ (f - f.mean(0)) / count
    scale = np.outer(np.sqrt(np.diag(root @ root.T)), std)
    np.testing.assert_allclose(root @ root.T @ image.slope / scale, crossed / scale, atol=0.02)


STD = 0.05


def curve(x, u):
    return np.sin(2 * x) + u / 2


def noisy_curve(rows=100, capacity=120, seed=0):
    noise = np.random.default_rng(seed)
    x, u = noise.uniform(-2, 2, (capacity, 1)), noise.uniform(-1, 1, (capacity, 1))
    y = curve(x, u) + STD * noise.normal(size=(capacity, 1))
    return Dataset(*(jnp.asarray(a, float) for a in (x, u, y)), jnp.int32(rows))


def fitted(model, starts=5, steps=100):
    fitter = full_data(model, num_starts=starts)

    @jax.jit
    def run(key, data):
        first, second = jax.random.split(key)
        learner = TrainState(model.init(first), fitter.init(None))
        return fitter.run(second, learner, data, steps)

    return run


@both
def test_a_fit_finds_a_known_function_and_its_noise(kind):
    model = MODELS[kind](states=1, controls=1, angles=())
    run = fitted(model)
    learners, info = jax.vmap(run, (0, None))(jax.random.split(jax.random.key(0), 3), noisy_curve())
    assert np.all(info.loss < info.first - 0.1)
    assert np.all(info.skipped == 0)
    posterior = jax.jit(jax.vmap(model.posterior, (0, None)))(learners.params, noisy_curve())
    x = np.linspace(-1.8, 1.8, 30)[:, None]
    u = np.linspace(0.9, -0.9, 30)[:, None]
    for i in range(3):
        b = jax.tree.map(lambda leaf, i=i: leaf[i], posterior)
        draws = jax.jit(jax.vmap(model.sample, (0, None)))(jax.random.split(jax.random.key(9), 200), b)
        ahead = jax.jit(jax.vmap(jax.vmap(model.apply, (None, None, 0, 0)), (None, 0, None, None)))(b, draws, x, u)
        error = np.asarray(ahead.mean).mean(0) - curve(x, u)
        assert np.sqrt(np.mean(error**2)) < 0.6 * STD
        np.testing.assert_allclose(ahead.std[0, 0], STD, rtol=0.2)


def degenerate(name):
    noise = np.random.default_rng(6)
    x, u, y = noise.normal(size=(25, 3)), noise.normal(size=(25, 2)), 0.1 * noise.normal(size=(25, 3))
    if name == "constant columns":
        x[:, 0], u[:, 1], y[:, 2] = 3.3, 1e4, 0.0
    elif name == "repeated rows":
        x, u, y = (np.repeat(rows[:5], 5, 0) for rows in (x, u, y))
    elif name == "no noise":
        y = np.stack([x[:, 0], x[:, 1] + u[:, 0], 0 * x[:, 0]], 1)
    elif name == "no change":
        y = 0 * x
    size = {"one row": 1, "no rows": 0}.get(name, 25)
    x, u, y = (np.concatenate([rows, 0 * rows]).astype(np.float32) for rows in (x, u, y))
    return Dataset(jnp.asarray(x), jnp.asarray(u), jnp.asarray(y), jnp.int32(size))


@both
def test_no_data_make_nan(kind):
    """One program, any data: it is traced once, and every number it makes is finite in float32."""
    model = MODELS[kind](**SHAPES)
    fitter, traces = full_data(model, num_starts=3), 0

    @jax.jit
    def everything(data):
        nonlocal traces
        traces += 1
        learner = TrainState(model.init(jax.random.key(0)), fitter.init(None))
        learner, info = fitter.run(jax.random.key(1), learner, data, 30)
        posterior = model.posterior(learner.params, data)
        draw = model.sample(jax.random.key(2), posterior)
        moved = jax.value_and_grad(lambda x: jnp.sum(model.apply(posterior, draw, x, data.u[1])[0]))(data.x[1] + 0.1)
        image = model.moments(posterior, jnp.ones(6), 0.1 * jnp.eye(6))
        return learner.params, info, moved, image

    for name in ("plain", "constant columns", "repeated rows", "no noise", "no change", "one row", "no rows"):
        params, info, moved, image = everything(degenerate(name))
        for leaf in jax.tree.leaves((params, info, moved, image)):
            assert np.all(np.isfinite(leaf)), name
            assert leaf.dtype in (jnp.float32, jnp.int32)
        assert info.loss <= info.first, name
        assert np.all(np.diag(image.cov) >= 0), name
        h = kernels.hyper(params)  # of targets that are all equal, too: their squares are numbers
        assert np.all(h.noise >= kernels.LEAST_NOISE), name
        assert np.all(h.signal >= kernels.LEAST_NOISE / 2000), name
    assert traces == 1
