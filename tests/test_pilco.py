"""PILCO: one step and many against samples and the published formulas, gradients, and the L-BFGS search."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.optimize import minimize

from pegasus_jax import build, preset
from pegasus_jax.imagine import costs
from pegasus_jax.imagine.rollout import NoiseUse
from pegasus_jax.math import angles, gaussian
from pegasus_jax.pilco import search
from pegasus_jax.pilco.rbf import NOISE, rbf
from pegasus_jax.policies.squash import SQUASHES, to_limits
from pegasus_jax.types import Cost, Policy, TrainState
from probes import PENDULUM, SCALAR, known, linear_policy, same

D, F, POINTS, UNITS = 3, 4, 12, 6  # the last state is an angle; one control
LOW, HIGH = -1.0, 2.0
MEAN = np.array([0.3, -0.5, 2.4])
COV = 0.15 * np.cov(np.random.default_rng(0).normal(size=(D, 9)))
STD = np.array([0.02, 0.05, 0.01])  # the model's observation noise


@pytest.fixture(autouse=True)
def x64():
    with jax.enable_x64(True):
        yield


def test_an_experiment_has_the_precision_of_who_runs_it():
    """A command builds it to look at its task, and Python's `train` may be given a config that was built before."""
    words = {"search.steps": 3, "fit.steps": 3}
    with jax.enable_x64(False):
        experiment = build(preset("cartpole", model="ssgp", policy="rbf", algorithm="pilco", settings=words))
    state = jax.eval_shape(experiment.init, jax.random.key(0))
    found, info = jax.eval_shape(experiment.search, state)
    assert {leaf.dtype for leaf in jax.tree.leaves(found.policy.params)} == {np.dtype(np.float64)}
    assert info.objective.dtype == np.float64


# A Gaussian process of changes over (features, control), and an RBF controller, both from a few random points


def se_kernel(a, b, lengths):
    a, b = a / lengths, b / lengths
    return np.exp(a @ b.T - 0.5 * np.sum(a**2, 1)[:, None] - 0.5 * np.sum(b**2, 1))


@cache
def process():
    """inputs [n, F + 1], beta [D, n], inverse [D, n, n], lengthscales [D, F + 1], variance [D]."""
    noise = np.random.default_rng(1)
    inputs = noise.normal(size=(POINTS, F + 1))
    lengths, variance = noise.uniform(1.0, 2.5, size=(D, F + 1)), np.array([0.3, 0.5, 0.2])
    grams = [v * se_kernel(inputs, inputs, s) for s, v in zip(lengths, variance, strict=True)]
    inverse = np.linalg.inv(np.stack(grams) + 1e-3 * np.eye(POINTS))
    return inputs, np.einsum("enm,em->en", inverse, 0.3 * noise.normal(size=(D, POINTS))), inverse, lengths, variance


def dynamics():
    inputs, beta, inverse, lengths, variance = process()

    def moments(posterior, mean, cov):
        return gaussian.rbf_moments(mean, cov, inputs, posterior * beta, inverse, lengths, variance)

    return known(PENDULUM)._replace(moments=moments)


def controller():
    low, high = jnp.array([LOW]), jnp.array([HIGH])
    return rbf(
        encode=partial(angles.encode, angles=(2,)),
        start=lambda key: jax.random.normal(key, (D,)),
        waves=2,
        controls=1,
        num_centers=UNITS,
        saturate=to_limits(SQUASHES["sine"], low, high),
        saturate_moments=partial(gaussian.squash, low=low, high=high),
    )


@cache
def policy_params():
    noise = np.random.default_rng(2)
    return {
        "centres": noise.normal(size=(UNITS, F)),
        "targets": 0.5 * noise.normal(size=(1, UNITS)),
        "lengthscales": noise.normal(size=(1, F)) + 1,
    }


def policy_function():
    """The length scales [F] and weights [n] of the RBF controller, in NumPy."""
    p = policy_params()
    lengths = np.log1p(np.exp(p["lengthscales"][0]))
    gram = se_kernel(p["centres"], p["centres"], lengths) + NOISE * np.eye(UNITS)
    return p["centres"], lengths, np.linalg.solve(gram, p["targets"][0])


PIECES = dict(dynamics=dynamics(), policy=controller(), angles=(2,))


@cache
def compiled_step():
    return jax.jit(lambda mean, cov, blur: search.step(mean, cov, blur, policy_params(), 1.0, **PIECES))


@cache
def compiled_propagation(horizon):
    def propagate(mean, cov, noise):
        return search.propagate(policy_params(), 1.0, (mean, cov), STD, horizon=horizon, noise=noise, **PIECES)

    return jax.jit(propagate, static_argnums=2)


# Samples


def redraw(noise, *columns):
    """Fresh samples from the Gaussian with the moments of samples [N, ...], split as they came."""
    together = np.concatenate(columns, 1)
    mean, cov = together.mean(0), np.cov(together.T)
    values, vectors = np.linalg.eigh(cov)
    root = vectors * np.sqrt(np.maximum(values, 0))  # features and states are linearly dependent
    fresh = mean + noise.normal(size=together.shape) @ root.T
    return np.split(fresh, np.cumsum([c.shape[1] for c in columns])[:-1], axis=1)


def sampled_step(mean, cov, blur, count, seed):
    """(x, next x) [N, D] by samples, made Gaussian again after every map, as PILCO does."""
    noise = np.random.default_rng(seed)
    centres, lengths, weights = policy_function()
    x = noise.multivariate_normal(mean, cov, count)
    seen = x + np.sqrt(blur) * noise.normal(size=x.shape)
    encoded = [np.stack([s[:, 0], s[:, 1], np.sin(s[:, 2]), np.cos(s[:, 2])], 1) for s in (x, seen)]
    x, features, seen = redraw(noise, x, *encoded)
    v = se_kernel(seen, centres, lengths) @ weights
    x, features, v = redraw(noise, x, features, v[:, None])
    u = (LOW + HIGH) / 2 + (HIGH - LOW) / 2 * (9 * np.sin(v) + np.sin(3 * v)) / 8
    x, features, u = redraw(noise, x, features, u)
    inputs, beta, inverse, lengths, variance = process()
    change = np.empty_like(x)
    for e in range(D):
        k = variance[e] * se_kernel(np.concatenate([features, u], 1), inputs, lengths[e])
        spread = np.sqrt(variance[e] - np.sum(k @ inverse[e] * k, 1))
        change[:, e] = k @ beta[e] + spread * noise.normal(size=count)
    return x, x + change


def close_to(image_mean, image_cov, samples, tolerance):
    spread = samples.std(0)
    np.testing.assert_allclose((image_mean - samples.mean(0)) / spread, 0, atol=tolerance)
    np.testing.assert_allclose(image_cov / np.outer(spread, spread), np.corrcoef(samples.T), atol=2 * tolerance)


@pytest.mark.parametrize("blur", [0.0, 0.002])
def test_a_step_against_a_million_samples(blur):
    """Mean, covariance and input-output covariance; a standard error of the mean is .001 of a deviation."""
    image = compiled_step()(MEAN, COV, np.full(D, blur))
    x, after = sampled_step(MEAN, COV, blur, 1_000_000, seed=3)
    close_to(image.mean, image.cov, after, 5e-3)
    together = np.cov(x.T, after.T)[:D, D:] / np.outer(x.std(0), after.std(0))
    np.testing.assert_allclose(COV @ image.slope / np.outer(x.std(0), after.std(0)), together, atol=1e-2)


def test_many_steps_against_samples():
    """Six steps, each from the Gaussian of the samples before."""
    track = compiled_propagation(6)(MEAN, COV, NoiseUse(0.0))
    mean, cov = MEAN, COV
    np.testing.assert_array_equal(track.mean[0], MEAN)
    np.testing.assert_array_equal(track.cov[0], COV)
    for t in range(6):
        _, after = sampled_step(mean, cov, 0.0, 200_000, seed=t)
        close_to(track.mean[t + 1], track.cov[t + 1], after, 2e-2)
        mean, cov = after.mean(0), np.cov(after.T)


# The formulas as printed: Deisenroth 2010, eq. 2.34 to 2.70 and app. A, with plain differences and inverses


def textbook_waves(mean, cov):
    """Mean and covariance of (sin a, cos a) for Gaussian angles a, and the covariance of a with them."""
    v = np.diag(cov)
    minus, plus = (np.exp(-0.5 * (v[:, None] + v) + s * cov) for s in (1, -1))
    difference, total = mean[:, None] - mean, mean[:, None] + mean
    sines = 0.5 * (minus * np.cos(difference) - plus * np.cos(total))
    cosines = 0.5 * (minus * np.cos(difference) + plus * np.cos(total))
    mixed = 0.5 * (minus * np.sin(difference) + plus * np.sin(total))
    m = np.concatenate([np.exp(-v / 2) * np.sin(mean), np.exp(-v / 2) * np.cos(mean)])
    second = np.block([[sines, mixed], [mixed.T, cosines]])
    cross = np.concatenate([cov * (np.exp(-v / 2) * np.cos(mean)), -cov * (np.exp(-v / 2) * np.sin(mean))], 1)
    return m, second - np.outer(m, m), cross


def textbook_gp(mean, cov, inputs, beta, inverse, lengths, variance):
    """Mean, covariance, and Cov(x)^-1 Cov(x, f); without `inverse` the function is certain."""
    outputs, nu = len(beta), inputs - mean
    m, c, s = np.zeros(outputs), np.zeros((len(mean), outputs)), np.zeros((outputs, outputs))
    for a in range(outputs):
        squares = np.diag(lengths[a] ** 2)
        both = np.linalg.inv(cov + squares)
        scale = variance[a] / np.sqrt(np.linalg.det(cov @ np.linalg.inv(squares) + np.eye(len(mean))))
        q = scale * np.exp(-0.5 * np.sum(nu @ both * nu, 1))
        m[a], c[:, a] = beta[a] @ q, both @ nu.T @ (beta[a] * q)
    for a in range(outputs):
        for b in range(outputs):
            wa, wb = np.diag(lengths[a] ** -2.0), np.diag(lengths[b] ** -2.0)
            r = cov @ (wa + wb) + np.eye(len(mean))
            z = (nu @ wa)[:, None] + (nu @ wb)[None]
            ka, kb = (variance[e] * np.exp(-0.5 * np.sum((nu / lengths[e]) ** 2, 1)) for e in (a, b))
            exponent = 0.5 * np.einsum("ijf,fg,ijg->ij", z, np.linalg.inv(r) @ cov, z)
            q = np.outer(ka, kb) / np.sqrt(np.linalg.det(r)) * np.exp(exponent)
            s[a, b] = beta[a] @ q @ beta[b] - m[a] * m[b]
            if a == b and inverse is not None:
                s[a, a] += variance[a] - np.trace(inverse[a] @ q)
    return m, s, c


def textbook_step(mean, cov):
    """The next state's moments and the covariance with the state; the joint Gaussian grows by one map at a time."""
    m, s = mean, cov

    def append(m, s, new_mean, new_cov, cross):
        return np.concatenate([m, new_mean]), np.block([[s, cross], [cross.T, new_cov]])

    wave_mean, wave_cov, cross = textbook_waves(mean[2:], cov[2:, 2:])
    m, s = append(m, s, wave_mean, wave_cov, cov[:, 2:] @ np.linalg.inv(cov[2:, 2:]) @ cross)
    phi = [0, 1, 3, 4]
    centres, lengths, weights = policy_function()
    v, v_cov, slope = textbook_gp(m[phi], s[np.ix_(phi, phi)], centres, weights[None], None, lengths[None], np.ones(1))
    m, s = append(m, s, v, v_cov, s[:, phi] @ slope)
    triple = np.array([[1.0], [3.0]])
    wave_mean, wave_cov, cross = textbook_waves(triple @ v, triple @ v_cov @ triple.T)
    amplitude = (HIGH - LOW) / 2 * np.array([9, 1]) / 8
    u, u_cov = (LOW + HIGH) / 2 + amplitude @ wave_mean[:2], amplitude @ wave_cov[:2, :2] @ amplitude
    v_u = cross[0, :2] @ amplitude  # Cov(v, u); the first angle is v itself
    m, s = append(m, s, u[None], np.full((1, 1), u_cov), s[:, 5:6] / v_cov * v_u)
    used = [*phi, 6]
    change, change_cov, slope = textbook_gp(m[used], s[np.ix_(used, used)], *process())
    cross = s[:D, used] @ slope
    return mean + change, cov + change_cov + cross + cross.T, cov + cross


def test_a_step_agrees_with_the_published_formulas():
    image = compiled_step()(MEAN, COV, np.zeros(D))
    mean, cov, cross = textbook_step(MEAN, COV)
    np.testing.assert_allclose(image.mean, mean, rtol=1e-8)
    np.testing.assert_allclose(image.cov, cov, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(COV @ image.slope, cross, rtol=1e-8, atol=1e-9)


def test_many_steps_agree_with_the_published_formulas():
    track = compiled_propagation(6)(MEAN, COV, NoiseUse(0.0))
    mean, cov = MEAN, COV
    for t in range(6):
        mean, cov, _ = textbook_step(mean, cov)
        np.testing.assert_allclose(track.mean[t + 1], mean, rtol=1e-7, atol=1e-8)
        np.testing.assert_allclose(track.cov[t + 1], cov, rtol=1e-7, atol=1e-8)


# The objective


def test_the_gradient_equals_finite_differences():
    cost = costs.saturating(lambda x: jnp.array([x[0] - 1, jnp.sin(x[2]), x[1]]), 1.0, (2,))

    @jax.jit
    def value(params):
        return search.objective(params, 1.0, (MEAN, COV), STD, horizon=4, cost=cost, noise=NoiseUse(1.0, 0.5), **PIECES)

    params = jax.tree.map(jnp.asarray, policy_params())
    gradient = jax.jit(jax.grad(value))(params)
    assert 0 < float(value(params)) < 1
    for seed in range(4):
        noise = np.random.default_rng(seed)
        direction = jax.tree.map(lambda p, noise=noise: jnp.asarray(noise.normal(size=p.shape)), params)
        ahead, behind = (value(jax.tree.map(lambda p, d, s=s: p + s * d, params, direction)) for s in (1e-5, -1e-5))
        slope = (ahead - behind) / 2e-5
        assert abs(slope) > 1e-4
        np.testing.assert_allclose(optax.tree.vdot(gradient, direction), slope, rtol=1e-6)


def linear_pieces(plant):
    """A known linear plant under u = gain x, with the moments of both."""
    states = len(plant.mean)
    model = known(plant)._replace(
        moments=lambda posterior, mean, cov: gaussian.affine(mean, cov, np.hstack([plant.a - np.eye(states), plant.b]))
    )
    policy: Policy = linear_policy(*plant.b.shape)._replace(
        moments=lambda gain, mean, cov: gaussian.affine(mean, cov, gain)
    )
    return dict(dynamics=model, policy=policy, angles=())


def linear_recursion(plant, gain, std, noise):
    """Moments of the steps 0..H, exactly."""
    closed, mean, cov = plant.a + plant.b @ gain, plant.mean, np.diag(plant.std**2)
    means, covs = [mean], [cov]
    for t in range(plant.horizon):
        seen = plant.b @ gain @ np.diag((noise.policy * std * (t > 0)) ** 2) @ gain.T @ plant.b.T
        mean, cov = closed @ mean, closed @ cov @ closed.T + seen + np.diag((noise.state * std) ** 2)
        means.append(mean)
        covs.append(cov)
    return np.array(means), np.array(covs)


@pytest.mark.parametrize("noise", [NoiseUse(0.0), NoiseUse(1.0), NoiseUse(0.5, 0.7)])
@pytest.mark.parametrize("plant", [SCALAR, PENDULUM])
def test_a_linear_plant_is_propagated_exactly(plant, noise):
    """And its noise enters where it is said to, from the second step on for the policy."""
    gain = np.random.default_rng(0).normal(size=plant.b.T.shape) - 1
    std, start = 0.1 + np.arange(len(plant.mean)), (plant.mean, np.diag(plant.std**2))
    pieces = linear_pieces(plant)
    track = search.propagate(gain, None, start, std, horizon=plant.horizon, noise=noise, **pieces)
    means, covs = linear_recursion(plant, gain, std, noise)
    np.testing.assert_allclose(track.mean, means, rtol=1e-9)
    np.testing.assert_allclose(track.cov, covs, rtol=1e-9)
    spread = lambda mean, cov: mean @ plant.q @ mean + jnp.trace(plant.q @ cov)  # noqa: E731
    value = search.objective(
        gain,
        None,
        start,
        std,
        horizon=plant.horizon,
        cost=Cost(lambda x: x @ plant.q @ x, spread),
        noise=noise,
        aggregate=costs.total,
        **pieces,
    )
    np.testing.assert_allclose(value, sum(map(spread, means[1:], covs[1:])), rtol=1e-9)


# The search


def linear_search(plant):
    """The searcher for the best gain, whose posterior scales the cost."""
    start = (jnp.asarray(plant.mean), jnp.diag(jnp.asarray(plant.std**2)))

    def value(gain, posterior, std):
        return posterior * search.objective(
            gain, None, start, std, horizon=plant.horizon, **linear_pieces(plant),
            cost=Cost(lambda x: x @ plant.q @ x, lambda mean, cov: mean @ plant.q @ mean + jnp.trace(plant.q @ cov)),
        )  # fmt: skip

    searcher = search.analytic(value, lambda key, posterior: jnp.zeros(len(plant.mean)))
    return searcher, jax.jit(searcher.run, static_argnames="steps")


@pytest.mark.parametrize("plant", [SCALAR, PENDULUM])
def test_the_search_finds_the_best_gain(plant):
    shape = plant.b.T.shape

    def value(gain):
        means, covs = linear_recursion(plant, gain.reshape(shape), np.zeros(len(plant.mean)), NoiseUse())
        return np.mean([m @ plant.q @ m + np.trace(plant.q @ c) for m, c in zip(means[1:], covs[1:], strict=True)])

    best = minimize(value, np.full(shape, -1.0).ravel(), tol=1e-12)
    searcher, run = linear_search(plant)
    gain = jnp.zeros(shape)
    learner, info = run(jax.random.key(0), TrainState(gain, searcher.init(gain)), 1.0, first=0, steps=30)
    np.testing.assert_allclose(learner.params.ravel(), best.x, atol=1e-5)
    np.testing.assert_allclose(info.objective[0], value(np.zeros(shape)), rtol=1e-9)
    np.testing.assert_allclose(info.objective[-1], best.fun, rtol=1e-9, atol=1e-12)
    assert np.all(np.diff(info.objective) <= 0)
    assert float(info.gradient_norm[-1]) < 1e-4 < float(info.gradient_norm[0])
    assert int(info.skipped) == 0


@pytest.mark.slow
def test_a_search_in_pieces_is_the_same_search_to_the_bit():
    searcher, run = linear_search(PENDULUM)
    gain = jnp.zeros((1, 2))
    whole, info = run(jax.random.key(0), TrainState(gain, searcher.init(gain)), 1.0, first=0, steps=6)
    learner, values = TrainState(gain, searcher.init(gain)), []
    for first in (0, 2, 4):
        learner, part = run(jax.random.key(0), learner, 1.0, first=first, steps=2)
        values.append(part.objective)
    assert same(whole, learner)
    assert same(info.objective, jnp.concatenate(values))


def test_a_new_search_remembers_nothing_but_the_parameters():
    searcher, run = linear_search(PENDULUM)
    gain = jnp.full((1, 2), 0.1)
    used, _ = run(jax.random.key(0), TrainState(gain, searcher.init(gain)), 1.0, first=0, steps=6)
    key = jax.random.key(1)
    again, info = run(key, TrainState(gain, used.optimizer), 2.0, first=0, steps=6)
    fresh, expected = run(jax.random.clone(key), TrainState(gain, searcher.init(gain)), 2.0, first=0, steps=6)
    assert same(again, fresh)
    assert same(info, expected)


def test_the_search_stays_where_the_objective_is_finite():
    """The function ends at .5: beyond, it is NaN."""

    def value(x, posterior, std):
        return -x + jnp.where(x > 0.5, jnp.nan, 0.0) * x

    searcher = search.analytic(value, lambda key, posterior: jnp.zeros(1))
    start = jnp.zeros(())
    learner, info = jax.jit(partial(searcher.run, steps=20))(
        jax.random.key(0), TrainState(start, searcher.init(start)), None, first=0
    )
    assert 0.4 < float(learner.params) <= 0.5
    assert np.all(np.isfinite(info.objective))
