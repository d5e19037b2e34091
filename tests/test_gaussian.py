"""Every moment against 10^6 samples, textbook formulas and finite differences.

Tolerances against samples are 5 standard errors, estimated from the same samples, for each number on its own.
"""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pegasus_jax.math import angles, gaussian

SAMPLES = 1_000_000
D, OUTPUTS, POINTS, WAVES = 3, 2, 8, 8

pytestmark = pytest.mark.usefixtures("x64")


def random_cov(seed, size, scale=0.5):
    root = np.random.default_rng(seed).normal(size=(size, size))
    return scale**2 * (root @ root.T / size + 0.2 * np.eye(size))


MEAN = np.array([0.4, -0.3, 2.0])
COV = random_cov(0, D)


def gp_arguments(seed=1, points=POINTS, signal_to_noise=30.0):
    noise = np.random.default_rng(seed)
    inputs = noise.normal(size=(points, D)) + MEAN
    lengthscales = noise.uniform(0.7, 2.0, size=(OUTPUTS, D))
    variance = np.array([1.0, 2.5])
    gram = kernel(inputs, inputs, lengthscales, variance)
    inverse = np.linalg.inv(gram + (variance / signal_to_noise**2)[:, None, None] * np.eye(points))
    targets = np.stack([np.sin(inputs.sum(1)), inputs[:, 0] * inputs[:, 2]])
    beta = np.einsum("enm,em->en", inverse, targets)
    return inputs, beta, inverse, lengthscales, variance


def policy_arguments():
    inputs, beta, _, lengthscales, variance = gp_arguments()
    return inputs, beta, None, lengthscales, variance


def kernel(x, y, lengthscales, variance):
    """[E, len(x), len(y)]."""
    x, y = x / lengthscales[:, None], y / lengthscales[:, None]
    squares = np.sum(x**2, -1)[:, :, None] + np.sum(y**2, -1)[:, None, :] - 2 * x @ y.swapaxes(1, 2)
    return variance[:, None, None] * np.exp(-0.5 * squares)


def gp_mean_and_variance(x, inputs, beta, inverse, lengthscales, variance):
    means, variances = [], []
    for e in range(len(beta)):
        k = kernel(x, inputs, lengthscales[e : e + 1], variance[e : e + 1])[0]
        means.append(k @ beta[e])
        variances.append(variance[e] - np.sum(k @ inverse[e] * k, 1) if inverse is not None else np.zeros(len(x)))
    return np.stack(means, 1), np.stack(variances, 1)


def ssgp_arguments(seed=2):
    noise = np.random.default_rng(seed)
    frequencies = noise.normal(size=(OUTPUTS, WAVES, D))
    cov = np.stack([random_cov(seed + e, 2 * WAVES, 0.3) for e in range(OUTPUTS)])
    return frequencies, noise.normal(size=(OUTPUTS, 2 * WAVES)), cov


def ssgp_mean_and_variance(x, frequencies, weight_mean, weight_cov):
    means, variances = [], []
    for w, m, s in zip(frequencies, weight_mean, weight_cov, strict=True):
        phase = x @ w.T
        features = np.concatenate([np.cos(phase), np.sin(phase)], 1)
        means.append(features @ m)
        variances.append(np.sum(features @ s * features, 1))
    return np.stack(means, 1), np.stack(variances, 1)


def squashed(x, low, high):
    return (high + low) / 2 + (high - low) / 2 * (9 * np.sin(x) + np.sin(3 * x)) / 8


def like(mean, arrays):
    return [None if a is None else jnp.asarray(a, mean.dtype) for a in arrays]


LOW, HIGH = np.array([-10.0, 0.0, -1.0]), np.array([10.0, 0.8, 1.0])
MATRIX, OFFSET = np.array([[1.0, 0.0, 0.5], [0.3, -1.0, 0.2]]), np.array([0.1, -0.4])

# name: (map under test, function on samples [N, D] -> mean [N, F] and variance [N, F] of the output given x)
MAPS = {
    "affine": (
        lambda m, s: gaussian.affine(m, s, *like(m, (MATRIX, OFFSET))),
        lambda x: (x @ MATRIX.T + OFFSET, 0.0),
    ),
    "sincos": (
        lambda m, s: gaussian.sincos(m, s, (2, 0)),
        lambda x: (np.stack([x[:, 1], *np.sin(x[:, [2, 0]]).T, *np.cos(x[:, [2, 0]]).T], 1), 0.0),
    ),
    "squash": (lambda m, s: gaussian.squash(m, s, LOW, HIGH), lambda x: (squashed(x, LOW, HIGH), 0.0)),
    "rbf_policy": (
        lambda m, s: gaussian.rbf_moments(m, s, *like(m, policy_arguments())),
        lambda x: gp_mean_and_variance(x, *policy_arguments()),
    ),
    "gp": (
        lambda m, s: gaussian.rbf_moments(m, s, *like(m, gp_arguments())),
        lambda x: gp_mean_and_variance(x, *gp_arguments()),
    ),
    "ssgp": (
        lambda m, s: gaussian.ssgp_moments(m, s, *like(m, ssgp_arguments())),
        lambda x: ssgp_mean_and_variance(x, *ssgp_arguments()),
    ),
    "residual_squash": (
        gaussian.residual(gaussian.squash),
        lambda x: (x + squashed(x, -1.0, 1.0), 0.0),
    ),
    "joint_sincos": (
        gaussian.joint(partial(gaussian.sincos, angles=(1,))),
        lambda x: (np.stack([*x.T, x[:, 0], x[:, 2], np.sin(x[:, 1]), np.cos(x[:, 1])], 1), 0.0),
    ),
}
every_map = pytest.mark.parametrize("name", MAPS)
every_nonlinear_map = pytest.mark.parametrize("name", ["sincos", "squash", "gp", "ssgp"])


@cache
def compiled(name, precision=64):
    """The map; `precision` only keeps the programs for float32 and float64 apart."""
    del precision
    return jax.jit(MAPS[name][0])


@cache
def compiled_sum(name):
    """A random linear combination of all moments, and its gradient in mean and cov."""

    def total(mean, cov):
        noise = np.random.default_rng(3)
        return sum(
            jnp.sum(noise.normal(size=leaf.shape).astype(leaf.dtype) * leaf) for leaf in MAPS[name][0](mean, cov)
        )

    return jax.jit(total), jax.jit(jax.grad(total, (0, 1)))


@cache
def standard_normals(size, count=SAMPLES):
    return np.random.default_rng(42).normal(size=(count, size))


@every_map
def test_moments_against_samples(name):
    image = compiled(name)(MEAN, COV)
    deviation = standard_normals(D) @ np.linalg.cholesky(COV).T
    y, variance = MAPS[name][1](MEAN + deviation)
    centered = y - y.mean(0)
    variance = np.broadcast_to(variance, y.shape)

    def agree(value, samples, what):
        error = 5 * samples.std(0) / np.sqrt(SAMPLES) + 1e-9
        np.testing.assert_array_less(abs(np.asarray(value) - samples.mean(0)), error, err_msg=what)

    agree(image.mean, y, "mean")
    for i in range(y.shape[1]):
        products = centered[:, i, None] * centered
        products[:, i] += variance[:, i]
        agree(image.cov[i], products, f"covariance, row {i}")
        agree((COV @ image.slope)[:, i], deviation * centered[:, i, None], f"input-output covariance, column {i}")


@every_map
def test_moments_of_a_point_are_the_function(name):
    plain = MAPS[name][1]
    image = compiled(name)(MEAN, np.zeros((D, D)))
    mean, variance = plain(MEAN[None])
    np.testing.assert_allclose(image.mean, mean[0], atol=1e-12)
    np.testing.assert_allclose(image.cov, np.diag(np.broadcast_to(variance, mean.shape)[0]), atol=1e-9)
    shifts = MEAN + 1e-5 * np.concatenate([np.eye(D), -np.eye(D)])
    there = plain(shifts)[0]
    np.testing.assert_allclose(image.slope, (there[:D] - there[D:]) / 2e-5, atol=1e-7)


@every_nonlinear_map
def test_gradients_against_finite_differences(name):
    value, gradient = compiled_sum(name)
    in_mean, in_cov = gradient(MEAN, COV)
    for seed in range(5):
        d_mean, d_cov = np.random.default_rng(seed).normal(size=D), random_cov(seed, D) - random_cov(seed + 9, D)
        ahead, behind = (value(MEAN + s * 1e-5 * d_mean, COV + s * 1e-5 * d_cov) for s in (1, -1))
        slope = np.sum(in_mean * d_mean) + np.sum(in_cov * d_cov)
        assert float(slope) == pytest.approx(float(ahead - behind) / 2e-5, rel=1e-6, abs=1e-8)


@every_nonlinear_map
def test_gradients_at_zero_covariance_are_one_sided_limits(name):
    """Off-diagonal covariances of exactly 0 sit where the stable formulas switch branches."""
    value, gradient = compiled_sum(name)
    direction = random_cov(5, D)
    for cov in (np.zeros((D, D)), np.diag([0.1, 0.3, 0.2])):
        slope = np.sum(gradient(MEAN, cov)[1] * direction)
        ahead, further = value(MEAN, cov + 1e-4 * direction), value(MEAN, cov + 2e-4 * direction)
        difference = (4 * ahead - 3 * value(MEAN, cov) - further) / 2e-4
        assert float(slope) == pytest.approx(float(difference), rel=1e-4, abs=1e-6)


@every_nonlinear_map
@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 1000), scale=st.sampled_from([1e-4, 0.01, 1.0, 30.0, 1000.0]))
def test_float32_is_finite_and_near_float64(name, seed, scale):
    """From hardly any uncertainty to more than any robot can have."""
    mean, cov = 3 * np.random.default_rng(seed).normal(size=D), random_cov(seed, D, scale)
    exact = compiled(name)(mean, cov)
    with jax.enable_x64(False):
        single = jnp.float32(mean), jnp.float32(cov)
        image, gradient = compiled(name, 32)(*single), compiled_sum(name)[1](*single)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves((image, gradient)))
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves((image, gradient)))
    if name == "gp":  # the gram matrix's condition number is in its way
        return
    spread = np.sqrt(np.diag(exact.cov))
    np.testing.assert_allclose(image.mean, exact.mean, rtol=1e-3, atol=1e-4 * (abs(exact.mean) + spread).max())
    np.testing.assert_allclose(image.cov, exact.cov, atol=2e-3 * np.outer(spread, spread).max() + 1e-12)


def test_sincos_orders_features_as_encode_does():
    image = compiled("sincos")(MEAN, np.zeros((D, D)))
    np.testing.assert_allclose(image.mean, angles.encode(jnp.array(MEAN), (2, 0)), atol=1e-15)


def test_sincos_without_angles_is_the_identity():
    image = gaussian.sincos(jnp.array(MEAN), jnp.array(COV), ())
    for leaf, expected in zip(image, (MEAN, COV, np.eye(D)), strict=True):
        np.testing.assert_allclose(leaf, expected)


# Gaussian processes


def test_gp_moments_against_the_textbook():
    """Deisenroth's formulas as printed and as in nrontsis/PILCO's MGPR: with plain differences."""
    inputs, beta, inverse, lengthscales, variance = gp_arguments()
    image = compiled("gp")(MEAN, COV)
    nu = inputs - MEAN
    mean, slope, cov = np.zeros(OUTPUTS), np.zeros((D, OUTPUTS)), np.zeros((OUTPUTS, OUTPUTS))
    for a in range(OUTPUTS):
        squares = np.diag(lengthscales[a] ** 2)
        factor = variance[a] / np.sqrt(np.linalg.det(COV @ np.linalg.inv(squares) + np.eye(D)))
        q = factor * np.exp(-0.5 * np.sum(nu @ np.linalg.inv(COV + squares) * nu, 1))
        mean[a] = beta[a] @ q
        slope[:, a] = np.linalg.inv(COV + squares) @ nu.T @ (beta[a] * q)
    for a in range(OUTPUTS):
        for b in range(OUTPUTS):
            inverse_a, inverse_b = np.diag(lengthscales[a] ** -2), np.diag(lengthscales[b] ** -2)
            r = COV @ (inverse_a + inverse_b) + np.eye(D)
            z = (nu @ inverse_a)[:, None, :] + (nu @ inverse_b)[None, :, :]
            k_a = kernel(MEAN[None], inputs, lengthscales, variance)[a, 0]
            k_b = kernel(MEAN[None], inputs, lengthscales, variance)[b, 0]
            bilinear = np.einsum("ijf,fg,ijg->ij", z, np.linalg.inv(r) @ COV, z)
            q = np.outer(k_a, k_b) / np.sqrt(np.linalg.det(r)) * np.exp(0.5 * bilinear)
            cov[a, b] = beta[a] @ q @ beta[b] - mean[a] * mean[b]
            if a == b:
                cov[a, b] += variance[a] - np.trace(inverse[a] @ q)
    np.testing.assert_allclose(image.mean, mean, rtol=1e-10)
    np.testing.assert_allclose(image.slope, slope, rtol=1e-9)
    np.testing.assert_allclose(image.cov, cov, rtol=1e-8, atol=1e-10)


def test_unused_rows_of_the_inputs_do_not_count():
    inputs, beta, inverse, lengthscales, variance = gp_arguments()
    small = compiled("gp")(MEAN, COV)
    padded = jax.jit(gaussian.rbf_moments)(
        jnp.array(MEAN),
        jnp.array(COV),
        np.pad(inputs, ((0, 5), (0, 0))),
        np.pad(beta, ((0, 0), (0, 5))),
        np.pad(inverse, ((0, 0), (0, 5), (0, 5))),
        lengthscales,
        variance,
    )
    for one, other in zip(small, padded, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-13)


def test_known_weights_are_weights_of_zero_covariance():
    frequencies, weights, cov = ssgp_arguments()
    with_cov = jax.jit(gaussian.ssgp_moments)(jnp.array(MEAN), jnp.array(COV), frequencies, weights, 0 * cov)
    without = jax.jit(gaussian.ssgp_moments)(jnp.array(MEAN), jnp.array(COV), frequencies, weights)
    for one, other in zip(with_cov, without, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)


# Composition


def test_linear_maps_compose_exactly():
    noise = np.random.default_rng(6)
    policy, model = noise.normal(size=(1, D)), noise.normal(size=(D, D + 1))
    step = gaussian.residual(
        gaussian.chain(
            gaussian.joint(partial(gaussian.affine, matrix=policy, offset=0.3)),
            partial(gaussian.affine, matrix=model),
        )
    )
    image = step(jnp.array(MEAN), jnp.array(COV))
    whole = np.eye(D) + model @ np.concatenate([np.eye(D), policy])
    np.testing.assert_allclose(image.mean, whole @ MEAN + model[:, -1] * 0.3, rtol=1e-12)
    np.testing.assert_allclose(image.cov, whole @ COV @ whole.T, rtol=1e-12)
    np.testing.assert_allclose(image.slope, whole.T, rtol=1e-12)


def test_chain_is_pilcos_composition_of_covariances():
    """Cov(x, f(g(x))) ~= Cov(x, g) Cov(g)^-1 Cov(g, f), for a g whose covariance is invertible."""
    first = partial(gaussian.rbf_moments, **gp_keywords())
    inner = compiled("gp")(MEAN, COV)
    outer = jax.jit(gaussian.squash)(inner.mean, inner.cov)
    image = jax.jit(gaussian.chain(first, gaussian.squash))(jnp.array(MEAN), jnp.array(COV))
    pilco = (COV @ inner.slope) @ np.linalg.inv(inner.cov) @ (inner.cov @ outer.slope)
    np.testing.assert_allclose(COV @ image.slope, pilco, rtol=1e-9)
    np.testing.assert_allclose(image.cov, outer.cov)


def gp_keywords():
    names = ("inputs", "beta", "inverse_gram", "lengthscales", "variance")
    return dict(zip(names, gp_arguments(), strict=True))


def test_a_whole_step_agrees_with_samples_while_the_state_is_well_known():
    """Composition is an approximation, off by the order of the covariance: .015 of a variance, .003 of a deviation."""
    noise = np.random.default_rng(7)
    features = D + 1
    centres, targets, lengths = noise.normal(size=(8, features)), noise.normal(size=(1, 8)), np.ones((1, features))
    frequencies = 0.6 * noise.normal(size=(D, WAVES, features + 1)) * np.array([1, 1, 1, 1, 0.3])
    weights = noise.normal(size=(D, 2 * WAVES)) / 3
    sincos = partial(gaussian.sincos, angles=(2,))
    rbf = partial(
        gaussian.rbf_moments, inputs=centres, beta=targets, inverse_gram=None, lengthscales=lengths, variance=np.ones(1)
    )
    squash = partial(gaussian.squash, low=-3.0, high=3.0)
    dynamics = partial(gaussian.ssgp_moments, frequencies=frequencies, weight_mean=weights)
    control = gaussian.chain(rbf, squash)
    step = gaussian.residual(gaussian.chain(sincos, gaussian.joint(control), dynamics))

    cov = 0.02 * COV
    image = jax.jit(step)(jnp.array(MEAN), jnp.array(cov))
    x = MEAN + standard_normals(D, 200_000) @ np.linalg.cholesky(cov).T
    phi = np.concatenate([x[:, :2], np.sin(x[:, 2:]), np.cos(x[:, 2:])], 1)
    u = squashed(kernel(phi, centres, lengths, np.ones(1))[0] @ targets.T, -3.0, 3.0)
    certain = np.zeros((D, 2 * WAVES, 2 * WAVES))
    change, _ = ssgp_mean_and_variance(np.concatenate([phi, u], 1), frequencies, weights, certain)
    after = x + change
    spread = after.std(0)
    np.testing.assert_array_less(abs(image.mean - after.mean(0)), 0.02 * spread)
    np.testing.assert_allclose(image.cov / np.outer(spread, spread), np.corrcoef(after.T), atol=0.03)
    together = np.cov(x.T, after.T)[:D, D:]
    np.testing.assert_allclose(
        cov @ image.slope / np.outer(x.std(0), spread), together / np.outer(x.std(0), spread), atol=0.03
    )


@every_map
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), scale=st.floats(0.0, 4.0))
def test_covariances_are_positive_semidefinite(name, seed, scale):
    """Of the image, and of input and image together: the one that PILCO hands to the next map."""
    mean, cov = np.random.default_rng(seed).normal(size=D), random_cov(seed, D, scale)
    image = compiled(name)(mean, cov)
    cross = cov @ image.slope
    together = np.block([[cov, cross], [cross.T, image.cov]])
    assert np.linalg.eigvalsh(together).min() > -1e-9 * (1 + np.trace(together))
