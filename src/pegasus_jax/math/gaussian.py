"""Gaussian moment calculus: mean and covariance of functions of a Gaussian, for PILCO's analytic propagation.

Every map takes a Gaussian input, mean [D] and cov [D, D], and returns an `Image`: the exact mean and covariance of
f(x), and the slope [D, F], Cov(x)^-1 Cov(x, f(x)), which by Stein's lemma is the mean Jacobian E[df/dx]' and so exists
for a singular covariance too. The input-output covariance itself is cov @ slope. Slopes compose like Jacobians: where
PILCO approximates Cov(x, f(g(x))) by Cov(x, g) Cov(g)^-1 Cov(g, f), slopes just multiply, without an inverse. One step
of PILCO reads

    control = chain(rbf_policy, squash)                         # features -> u
    step = residual(chain(sincos, joint(control), dynamics))    # x -> features -> (features, u) -> change -> next x

where each name stands for a function of (mean, cov) with its other arguments bound. Sources: Deisenroth 2010 (thesis),
ch. 3 and app. A; Deisenroth & Rasmussen 2011. Covariances are computed as scale * expm1(log ratio), not as E[fg] - E[f]
E[g], so they keep their precision for small input covariances, in float32 too.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax.math.angles import check_places
from pegasus_jax.math.linalg import cholesky
from pegasus_jax.types import Array

__all__ = ["Image", "affine", "chain", "joint", "residual", "sincos", "squash"]


class Image(NamedTuple):
    """The Gaussian that matches f(x), and its covariance with x."""

    mean: Array  # [F] E[f(x)]
    cov: Array  # [F, F] Cov(f(x))
    slope: Array  # [D, F] Cov(x)^-1 Cov(x, f(x)) = E[df/dx]'


Map = Callable[[Array, Array], Image]  # (mean [D], cov [D, D]) -> Image


# Composition


def chain(*maps: Map) -> Map:
    """The maps one after the other, each taking the image of the one before for Gaussian."""

    def composed(mean: Array, cov: Array) -> Image:
        image = Image(mean, cov, jnp.eye(mean.shape[0], dtype=mean.dtype))
        for f in maps:
            after = f(image.mean, image.cov)
            image = Image(after.mean, after.cov, image.slope @ after.slope)
        return image

    return composed


def joint(f: Map) -> Map:
    """x [D] -> (x, f(x)) [D + F]."""

    def paired(mean: Array, cov: Array) -> Image:
        image = f(mean, cov)
        cross = cov @ image.slope
        return Image(
            jnp.concatenate([mean, image.mean]),
            jnp.block([[cov, cross], [cross.T, image.cov]]),
            jnp.concatenate([jnp.eye(mean.shape[0], dtype=mean.dtype), image.slope], axis=1),
        )

    return paired


def residual(f: Map) -> Map:
    """x [D] -> x + f(x) [D], for a model of changes."""

    def added(mean: Array, cov: Array) -> Image:
        image = f(mean, cov)
        cross = cov @ image.slope
        slope = image.slope + jnp.eye(mean.shape[0], dtype=mean.dtype)
        return Image(mean + image.mean, cov + cross + cross.T + image.cov, slope)

    return added


def affine(mean: Array, cov: Array, matrix: Array, offset: Array | float = 0.0) -> Image:
    """Moments of matrix [F, D] @ x + offset [F]."""
    return Image(matrix @ mean + offset, matrix @ cov @ matrix.T, matrix.T)


# Sines and cosines
#
# With v = m + d, d ~ N(0, C): a sin v + b cos v = even cos d + odd sin d for some amplitudes `even` and `odd`, and cos
# d_i and sin d_j are uncorrelated. So every covariance of waves is a sum over two kinds of terms, and needs two
# exponentials a pair.


def _wave_moments(variance_i: Array, variance_j: Array, cov: Array) -> tuple[Array, Array, Array]:
    """E[cos d_i cos d_j], Cov(cos d_i, cos d_j) and E[sin d_i sin d_j] for zero-mean Gaussian d.

    They are q cosh(c), q (cosh(c) - 1), q sinh(c) with c = Cov(d_i, d_j) and q = exp(-(variance_i + variance_j) / 2),
    arranged so that nothing overflows for large variances or cancels for small ones.
    """
    sign = jnp.where(cov >= 0, 1.0, -1.0).astype(cov.dtype)  # never 0: the derivative of |c| at 0 must not vanish
    size = sign * cov
    scale = 0.5 * jnp.exp(size - 0.5 * (variance_i + variance_j))
    rise = -jnp.expm1(-size)
    return scale * (1 + (1 - rise) ** 2), scale * rise**2, sign * scale * rise * (2 - rise)


def _wave_cov(even: Array, odd: Array, cov: Array) -> Array:
    """Covariance [A, A] of even_i cos d_i + odd_i sin d_i for d ~ N(0, cov [A, A])."""
    variance = jnp.diagonal(cov)
    _, cosines, sines = _wave_moments(variance[:, None], variance[None, :], cov)
    return jnp.outer(even, even) * cosines + jnp.outer(odd, odd) * sines


def sincos(mean: Array, cov: Array, angles: tuple[int, ...]) -> Image:
    """Moments of the features [F] of x [D] in the order of `angles.encode`: other dimensions, sines, cosines.

    `angles` are the indices of the angle dimensions [rad], maybe none; F = D + len(angles). Exact (PILCO's gTrig).
    """
    size = mean.shape[0]
    check_places(angles, size)
    plain = np.array([i for i in range(size) if i not in angles], int)
    twice = np.array([*angles, *angles], int)  # the dimension behind each wave
    sine, cosine = jnp.sin(mean[twice[: len(angles)]]), jnp.cos(mean[twice[: len(angles)]])
    even, odd = jnp.concatenate([sine, cosine]), jnp.concatenate([cosine, -sine])
    damping = jnp.exp(-0.5 * jnp.diagonal(cov)[twice])
    slope = jnp.zeros((size, len(twice)), mean.dtype).at[twice, np.arange(len(twice))].set(damping * odd)
    cross = cov[plain] @ slope
    waves = _wave_cov(even, odd, cov[np.ix_(twice, twice)])
    return Image(
        jnp.concatenate([mean[plain], damping * even]),
        jnp.block([[cov[np.ix_(plain, plain)], cross], [cross.T, waves]]),
        jnp.concatenate([jnp.eye(size, dtype=mean.dtype)[:, plain], slope], axis=1),
    )


def squash(mean: Array, cov: Array, low: Array | float = -1.0, high: Array | float = 1.0) -> Image:
    """Moments of the saturated control in [low, high]: middle + half range * (9 sin v + sin 3v) / 8 of v [U].

    `low` and `high` are scalars or [U]. Exact (PILCO's gSat).
    """
    size = mean.shape[0]
    low, high = jnp.asarray(low, mean.dtype), jnp.asarray(high, mean.dtype)
    half, middle = jnp.broadcast_to((high - low) / 2, (size,)), (high + low) / 2
    times = jnp.repeat(jnp.array([1.0, 3.0], mean.dtype), size)
    amplitude = jnp.repeat(jnp.array([9.0, 1.0], mean.dtype) / 8, size) * jnp.tile(half, 2)
    angle = times * jnp.tile(mean, 2)
    angle_cov = jnp.outer(times, times) * jnp.tile(cov, (2, 2))
    even, odd = amplitude * jnp.sin(angle), amplitude * jnp.cos(angle)
    damping = jnp.exp(-0.5 * jnp.diagonal(angle_cov))
    waves = _wave_cov(even, odd, angle_cov).reshape(2, size, 2, size)
    return Image(
        middle + jnp.sum((damping * even).reshape(2, size), 0),
        jnp.sum(waves, (0, 2)),
        jnp.diag(jnp.sum((damping * times * odd).reshape(2, size), 0)),
    )


def saturating_cost(
    mean: Array, cov: Array, matrix: Array, offset: Array | float = 0.0, width: Array | float = 1.0
) -> Array:
    """E[1 - exp(-|matrix @ phi + offset|^2 / (2 width^2))], in [0, 1], for Gaussian features phi [F].

    `matrix` [E, F], `offset` [E] and `width` share the unit of the error, [m] for the distance of a tip from its goal
    (Deisenroth 2010, sec. 3.7.1). Only a matrix of E + 1 dimensions is factorised.
    """
    error, spread, _ = affine(mean, cov, matrix / width, offset / width)
    ratio = jnp.eye(error.shape[0], dtype=mean.dtype) + spread
    # Bordered by the error, the ratio R = L L' has a factor whose last row is L^-1 error: error' R^-1 error and log |R|
    # are read off it. R is at least the identity, so this corner keeps the last pivot positive.
    corner = 1 + error @ error
    root = cholesky(jnp.block([[ratio, error[:, None]], [error[None], corner[None, None]]]))
    exponent = jnp.sum(root[-1, :-1] ** 2) + 2 * jnp.sum(jnp.log(jnp.diagonal(root)[:-1]))
    return 1 - jnp.exp(-0.5 * exponent)


# Models


def rbf_moments(
    mean: Array,
    cov: Array,
    inputs: Array,
    beta: Array,
    inverse_gram: Array | None,
    lengthscales: Array,
    variance: Array,
) -> Image:
    """Moments of E independent Gaussian processes with ARD squared exponential kernels (Deisenroth 2010, sec. 2.3).

    inputs [n, F] shared by the outputs; beta [E, n] = inverse_gram @ targets; inverse_gram [E, n, n] of the kernel
    matrix with noise, or None for the deterministic function sum_i beta_i k(x, inputs_i), such as an RBF policy;
    lengthscales [E, F]; variance [E] of the signal. The observation noise is not in the covariance. Unused rows of a
    fixed-capacity `inputs` do not count where beta and inverse_gram are zero. Cost: E (E + 1) / 2 matrices [n, n]; in a
    scan over time under `grad`, wrap the step in `jax.checkpoint` when n is in the hundreds, else they are all kept.
    """
    inputs, beta, lengthscales, variance = (jnp.asarray(a) for a in (inputs, beta, lengthscales, variance))
    inverse_gram = None if inverse_gram is None else jnp.asarray(inverse_gram)
    size, outputs = mean.shape[0], beta.shape[0]
    identity = jnp.eye(size, dtype=mean.dtype)
    precision = lengthscales**-2  # [E, F]
    centered = inputs - mean  # [n, F]
    scaled = centered * precision[:, None, :]  # [E, n, F]
    ratio = identity + cov * precision[:, None, :]  # [E, F, F], I + S W
    reach = jnp.linalg.solve(ratio, jnp.broadcast_to(cov, ratio.shape))  # [E, F, F], (S^-1 + W)^-1
    smooth = scaled - (scaled @ reach) * precision[:, None, :]  # [E, n, F], (S + W^-1)^-1 (x_i - m)
    log_det = jnp.linalg.slogdet(ratio)[1]  # [E]
    log_kernel = jnp.log(variance)[:, None] - 0.5 * (jnp.sum(smooth * centered, -1) + log_det[:, None])
    kernel = jnp.exp(log_kernel)  # [E, n], E[k(x, x_i)]
    terms = beta * kernel

    def pair(a: Array, b: Array) -> tuple[Array, Array]:
        """log E[k_a(x, x_i)] + log E[k_b(x, x_j)], and by how much log E[k_a k_b] exceeds it, [n, n]."""
        both = identity + cov * (precision[a] + precision[b])
        inner = jnp.linalg.solve(both, cov)  # (S^-1 + W_a + W_b)^-1
        left, right = scaled[a] @ inner, scaled[b] @ inner
        quadratic_i = jnp.sum(left * precision[b] * (scaled[a] @ reach[a]), -1)
        quadratic_j = jnp.sum(right * precision[a] * (scaled[b] @ reach[b]), -1)
        constant = log_det[a] + log_det[b] - jnp.linalg.slogdet(both)[1]
        excess = left @ scaled[b].T + 0.5 * (constant - quadratic_i[:, None] - quadratic_j[None, :])
        return log_kernel[a][:, None] + log_kernel[b][None, :], excess

    def covariance(a: Array, b: Array) -> Array:
        return beta[a] @ _scaled_expm1(*pair(a, b)) @ beta[b]

    def own_variance(a: Array) -> Array:
        spread = _scaled_expm1(*pair(a, a))
        explained = beta[a] @ spread @ beta[a]
        if inverse_gram is None:
            return explained
        return explained + variance[a] - jnp.sum(inverse_gram[a] * (jnp.outer(kernel[a], kernel[a]) + spread))

    slope = jnp.einsum("en,enf->fe", terms, smooth)
    return Image(jnp.sum(terms, -1), _symmetric(own_variance, covariance, outputs), slope)


def ssgp_moments(
    mean: Array, cov: Array, frequencies: Array, weight_mean: Array, weight_cov: Array | None = None
) -> Image:
    """Moments of E independent sparse-spectrum Gaussian processes (Quinonero-Candela 2010; Lazaro-Gredilla et al.
    2010).

    Output e is weights_e @ (cos(W_e x), sin(W_e x)) with frequencies W [E, m, F], rad per unit of x, and Gaussian
    weights, weight_mean [E, 2m], weight_cov [E, 2m, 2m] (None: known weights); all m cosines come first. The
    observation noise is not in the covariance. Cost: E (E + 1) / 2 matrices [m, m], whatever the number of data.
    """
    frequencies, weight_mean = jnp.asarray(frequencies), jnp.asarray(weight_mean)
    weight_cov = None if weight_cov is None else jnp.asarray(weight_cov)
    outputs, waves, _ = frequencies.shape
    phase = frequencies @ mean  # [E, m]
    variance = jnp.einsum("emf,fg,emg->em", frequencies, cov, frequencies)
    cosine, sine = jnp.cos(phase), jnp.sin(phase)
    first, second = weight_mean[:, :waves], weight_mean[:, waves:]
    even, odd = first * cosine + second * sine, second * cosine - first * sine
    damping = jnp.exp(-0.5 * variance)

    def covariance(a: Array, b: Array) -> Array:
        phase_cov = frequencies[a] @ cov @ frequencies[b].T
        _, cosines, sines = _wave_moments(variance[a][:, None], variance[b][None, :], phase_cov)
        return even[a] @ cosines @ even[b] + odd[a] @ sines @ odd[b]

    def own_variance(a: Array) -> Array:
        phase_cov = frequencies[a] @ cov @ frequencies[a].T
        own = jnp.diagonal(phase_cov)  # not variance[a]: equal to the last bit where waves are much damped
        second_moment, cosines, sines = _wave_moments(own[:, None], own[None, :], phase_cov)
        explained = even[a] @ cosines @ even[a] + odd[a] @ sines @ odd[a]
        if weight_cov is None:
            return explained
        (cc, cs), (sc, ss) = weight_cov[a].reshape(2, waves, 2, waves).transpose(0, 2, 1, 3)
        c, s = cosine[a], sine[a]
        of_even = (c[:, None] * cc + s[:, None] * sc) * c + (c[:, None] * cs + s[:, None] * ss) * s
        of_odd = (c[:, None] * ss - s[:, None] * cs) * c - (c[:, None] * sc - s[:, None] * cc) * s
        return explained + jnp.sum(of_even * second_moment + of_odd * sines)

    slope = jnp.einsum("em,emf->fe", damping * odd, frequencies)
    return Image(jnp.sum(damping * even, -1), _symmetric(own_variance, covariance, outputs), slope)


def _symmetric(diagonal: Callable[[Array], Array], off_diagonal: Callable[[Array, Array], Array], size: int) -> Array:
    """The symmetric matrix [size, size] of diagonal(a) and off_diagonal(a, b), the latter evaluated for a < b only."""
    result = jnp.diag(jax.vmap(diagonal)(jnp.arange(size)))
    if size == 1:
        return result
    a, b = np.triu_indices(size, 1)
    entries = jax.vmap(off_diagonal)(jnp.asarray(a), jnp.asarray(b))
    return result.at[a, b].set(entries).at[b, a].set(entries)


def _scaled_expm1(log_scale: Array, exponent: Array) -> Array:
    """exp(log_scale) (exp(exponent) - 1) without overflow where the product is moderate."""
    sign = jnp.where(exponent >= 0, 1.0, -1.0).astype(exponent.dtype)
    return sign * jnp.exp(log_scale + jnp.maximum(exponent, 0)) * -jnp.expm1(-sign * exponent)
