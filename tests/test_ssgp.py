"""Sparse-spectrum Gaussian-process dynamics: the Bayesian linear model written out in NumPy, and its limit, the GP."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from pegasus_jax.pilco import gp as exact
from pegasus_jax.pilco import kernels
from pegasus_jax.pilco.ssgp import log_evidence, ssgp
from probes import experience

SHAPES = dict(states=3, controls=2, angles=(2,))


def parameters(points, noise=0.1, seed=0):
    draws = np.random.default_rng(seed)
    return {
        "log_lengthscale": jnp.asarray(0.7 + 0.2 * draws.normal(size=(3, 6))),
        "log_signal": jnp.asarray(0.2 * draws.normal(size=3)),
        "log_noise": jnp.asarray(np.log(noise) + 0.2 * draws.normal(size=3)),
        "points": jnp.asarray(draws.normal(size=(3, points, 6))),
    }


def rows_by_hand(data):
    """Scaled inputs [n, F] and targets [E, n], and the targets' mean and deviation."""
    x, u, y = (np.asarray(rows, float)[: int(data.size)] for rows in data[:3])
    inputs = np.concatenate([x[:, :2], np.sin(x[:, 2:]), np.cos(x[:, 2:]), u], 1)
    return (inputs - inputs.mean(0)) / inputs.std(0), ((y - y.mean(0)) / y.std(0)).T, y.mean(0), y.std(0)


def features_by_hand(params, e, inputs):
    """Features [n, 2m] with standard normal weights."""
    lengths, signal = np.exp(params["log_lengthscale"][e]), np.exp(params["log_signal"][e])
    points = np.asarray(params["points"][e])
    phase = inputs @ (points / lengths).T
    return signal / np.sqrt(len(points)) * np.concatenate([np.cos(phase), np.sin(phase)], 1)


def test_evidence_and_posterior_are_those_of_the_bayesian_linear_model(x64):
    data, model, params = experience(), ssgp(**SHAPES, points=12), parameters(12)
    rows, h = model.prepare(data), kernels.hyper(params)
    inputs, y, _, _ = rows_by_hand(data)
    posterior = jax.jit(model.posterior)(params, data)
    noise = np.exp(params["log_noise"])
    total = 0.0
    for e in range(3):
        features = features_by_hand(params, e, inputs)
        marginal = features @ features.T + noise[e] ** 2 * np.eye(30)
        expected = stats.multivariate_normal(cov=marginal).logpdf(y[e])
        frequencies = params["points"][e] / h.lengthscale[e]
        evidence = jax.jit(log_evidence)(frequencies, h.signal[e], h.noise[e], rows.y[e], rows)
        np.testing.assert_allclose(evidence, expected, rtol=1e-9)
        total += expected

        # The posterior by the other formula: covariance of functions, not precision of weights
        gain = features.T @ np.linalg.inv(marginal)
        scale = np.exp(params["log_signal"][e]) / np.sqrt(12)
        cov = np.eye(24) - gain @ features
        np.testing.assert_allclose(posterior.weights.mean[e], scale * gain @ y[e], rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(posterior.cov[e], scale**2 * cov, rtol=1e-7, atol=1e-11)
    high = np.sum(np.asarray(params["points"]) ** 2) / 12
    loss = jax.jit(model.loss)(params, None, None, rows)
    np.testing.assert_allclose(loss * 30, kernels.penalty(h) + high - total, rtol=1e-10)


def test_draws_are_functions_of_the_posterior():
    """Weights by weights: the values of 20000 draws at one input have the moments of the posterior predictive."""
    data, model, params = experience(), ssgp(**SHAPES, points=12), parameters(12)
    posterior = jax.jit(model.posterior)(params, data)
    x, u = data.x[3] + 0.3, data.u[5]
    draws = jax.jit(jax.vmap(model.sample, (0, None)))(jax.random.split(jax.random.key(0), 20_000), posterior)
    ahead = jax.jit(jax.vmap(model.apply, (None, 0, None, None)))(posterior, draws, x, u)
    raw = jnp.concatenate([x[:2], jnp.sin(x[2:]), jnp.cos(x[2:]), u])
    image = jax.jit(model.moments)(posterior, raw, jnp.zeros((6, 6)))
    std = np.sqrt(np.diag(image.cov))
    np.testing.assert_array_less(abs(np.mean(ahead.mean, 0) - image.mean), 5 * std / 20_000**0.5)
    np.testing.assert_allclose(np.std(ahead.mean, 0), std, rtol=0.03)

    inputs, y, mean_out, std_out = rows_by_hand(data)
    ours = np.asarray(raw, float)
    x_all = np.asarray(jnp.concatenate([data.x[:30, :2], jnp.sin(data.x[:30, 2:]), jnp.cos(data.x[:30, 2:])], 1))
    whole = np.concatenate([x_all, np.asarray(data.u)[:30]], 1).astype(float)
    at = (ours - whole.mean(0)) / whole.std(0)
    for e in range(3):
        features, here = features_by_hand(params, e, inputs), features_by_hand(params, e, at[None])[0]
        noise = float(np.exp(params["log_noise"][e]))
        precision = features.T @ features / noise**2 + np.eye(24)
        mean = here @ np.linalg.solve(precision, features.T @ y[e]) / noise**2
        np.testing.assert_allclose(image.mean[e], mean_out[e] + std_out[e] * mean, atol=1e-3)
        np.testing.assert_allclose(std[e], std_out[e] * np.sqrt(here @ np.linalg.solve(precision, here)), rtol=1e-2)
        np.testing.assert_allclose(ahead.std[0, e], std_out[e] * noise, rtol=3e-3)


@pytest.mark.slow
def test_with_many_frequencies_it_is_the_gaussian_process(x64):
    """Its error falls as the square root of their number: 16 times as many make it 4 times as small."""
    data, process = experience(), exact.gp(**SHAPES)
    params = parameters(1, noise=0.3)
    posterior = jax.jit(process.posterior)(params, data)
    at = np.asarray(jnp.concatenate([data.x[:10, :2], jnp.sin(data.x[:10, 2:]), jnp.cos(data.x[:10, 2:])], 1))
    at = np.concatenate([at, np.asarray(data.u)[:10]], 1)
    at = jnp.asarray(at + 0.3 * np.random.default_rng(1).normal(size=at.shape))
    nothing = jnp.zeros((6, 6))
    expected = jax.jit(jax.vmap(process.moments, (None, 0, None)))(posterior, at, nothing)
    evidence = jax.jit(exact.log_evidence)(kernels.hyper(params), process.prepare(data))

    def errors(points):
        model = ssgp(**SHAPES, points=points)

        @jax.jit
        def one(key):
            mine = params | {"points": jax.random.normal(key, (3, points, 6))}
            image = jax.vmap(model.moments, (None, 0, None))(model.posterior(mine, data), at, nothing)
            h, rows = kernels.hyper(mine), model.prepare(data)
            mine_evidence = jax.vmap(log_evidence, (0, 0, 0, 0, None))(
                mine["points"] / h.lengthscale[:, None], h.signal, h.noise, rows.y, rows
            )
            off = (image.mean - expected.mean, image.cov - expected.cov, mine_evidence - evidence)
            return jnp.array([jnp.sqrt(jnp.mean(error**2)) for error in off])

        return np.mean([one(jax.random.key(seed)) for seed in range(4)], 0)

    few, many = errors(20), errors(320)
    assert np.all(many < few / 2)
    scale = np.array([jnp.std(expected.mean), jnp.sqrt(jnp.mean(expected.cov**2)), jnp.mean(abs(evidence))])
    assert np.all(many < 0.35 * scale)
