"""Multiplicative noise on the units of a layer: every kind is one `Dropout`, a tuple of pure functions.

    h * mask(params, noise),   noise = sample(key, width)

All trainable parameters are unconstrained reals, so any gradient step is valid; limits are imposed by a sigmoid, which,
unlike a clip, never stops the gradient. No mask is divided by its mean (the convention of the authors' code; `retain`
is that mean). `kl` is in nats, summed over units, one noise variable per unit; a loss that divides the log likelihood
by the number of data divides this by it too.

Sources: Gal et al. 2017 (concrete), Kingma et al. 2015 (gaussian), Molchanov et al. 2017 (sparse), Neklyudov et al.
2017 (log_normal).
"""

import math

import jax
import jax.numpy as jnp
from jax.scipy.special import erf, log_ndtr

from pegasus_jax.types import Dropout

# The log-uniform prior is improper, so its KL is known up to a constant. We fix the constant by KL -> 0 as alpha ->
# infinity: -E[log|e|] = (Euler's gamma + log 2) / 2 for e ~ N(0, 1). Kingma's and Molchanov's approximations then
# agree.
_LOG_UNIFORM_CONSTANT = 0.5 * (0.5772156649015329 + math.log(2.0))
_SQRT_2 = math.sqrt(2.0)
# erf_inv(x) / x as a polynomial in sqrt(2 - log(1 - x^2)), highest power first: minimax over 1 - |x| > 5e-6. With
# jax.lax.erf_inv, which is exact to the last bit, a fit step takes 1.07 of the time.
_ERF_INV = (-0.0097237873, 0.154730024, -0.980937942, 3.08985322, -4.82486895, 4.09892242, -0.873961558)

__all__ = ["binary", "concrete", "gaussian", "log_normal", "none", "sparse"]


def none() -> Dropout:
    """No noise: z = 1."""
    return Dropout(
        init=lambda key, width: {},
        sample=lambda key, width: jnp.ones((width,)),
        mask=lambda params, noise: jnp.ones_like(noise),
        kl=lambda params: jnp.zeros(()),
        retain=lambda params: jnp.ones(()),
        decay=_undiminished,
    )


def binary(rate: float = 0.1) -> Dropout:
    """Bernoulli noise with a fixed drop rate: z = 1 with probability 1 - rate, else 0.

    Its rate is not learned, so its KL is a constant, given here as 0. Without parameters `retain` cannot know the
    width: it is a scalar that broadcasts. ValueError unless 0 <= rate < 1.
    """
    if not 0.0 <= rate < 1.0:
        raise ValueError(f"binary dropout needs 0 <= rate < 1, got {rate}")
    keep = 1.0 - rate
    return Dropout(
        init=lambda key, width: {},
        sample=lambda key, width: jax.random.uniform(key, (width,)),
        mask=lambda params, noise: (noise < keep).astype(noise.dtype),
        kl=lambda params: jnp.zeros(()),
        retain=lambda params: jnp.full((), keep),
        decay=lambda params: jnp.full((), keep),
    )


def concrete(rate: float = 0.1, temperature: float = 0.1) -> Dropout:
    """Relaxed Bernoulli noise with a learned drop probability per unit (Gal et al. 2017, sec. 3).

    The probability is p = sigmoid(params["logit"]), initially `rate`, and
    z = sigmoid((noise - logit) / temperature) with logistic base noise (the logit of a uniform, drawn once so that
    `mask` takes no logarithms). `kl` is that of the unrelaxed Bernoulli(p) to Bernoulli(1/2): log 2 - H(p) per unit,
    which is Gal's entropy term plus a constant; his weight term, (1 - p) |W|^2 / 2, belongs to the layer (see
    `decay`). ValueError unless 0 < rate < 1 and temperature > 0.
    """
    if not (0.0 < rate < 1.0 and temperature > 0.0):
        raise ValueError(f"concrete dropout needs 0 < rate < 1 and temperature > 0, got {rate} and {temperature}")
    start = math.log(rate / (1.0 - rate))

    def kl(params):
        logit = params["logit"]
        drop = jax.nn.sigmoid(logit)
        entropy = drop * jax.nn.softplus(-logit) + (1.0 - drop) * jax.nn.softplus(logit)
        return jnp.sum(math.log(2.0) - entropy)

    def retain(params):
        # E[z] = P(noise - t y > logit) with y a second logistic variable = E_y[sigmoid(-(logit + t y))]: 1 - p but for
        # O(t^2). Three-point Gauss quadrature of the logistic distribution (moments pi^2/3, 7 pi^4/15) is exact to t^5.
        second, fourth = math.pi**2 / 3.0, 7.0 * math.pi**4 / 15.0
        step, side = temperature * math.sqrt(fourth / second), second**2 / (2.0 * fourth)
        logit = params["logit"]
        outer = jax.nn.sigmoid(-logit - step) + jax.nn.sigmoid(-logit + step)
        return side * outer + (1.0 - 2.0 * side) * jax.nn.sigmoid(-logit)

    return Dropout(
        init=lambda key, width: {"logit": jnp.full((width,), start, float)},
        sample=lambda key, width: _logit(_uniform(key, width)),
        mask=lambda params, noise: jax.nn.sigmoid((noise - params["logit"]) / temperature),
        kl=kl,
        retain=retain,
        decay=lambda params: jax.nn.sigmoid(-params["logit"]),
    )


def gaussian(rate: float = 0.1, limit: float = 0.5) -> Dropout:
    """Gaussian variational dropout, z ~ N(1, alpha) with alpha learned per unit (Kingma et al. 2015, sec. 3.3).

    alpha = limit * sigmoid(params["logit"]), initially rate / (1 - rate): the variance of binary dropout at that rate.
    The prior is log-uniform, KL by their cubic approximation (appendix C), which holds for alpha <= 1 only. ValueError
    unless 0 < rate / (1 - rate) < limit <= 1.
    """
    start = _relative_variance(rate)
    if not start < limit <= 1.0:
        raise ValueError(f"gaussian dropout needs rate / (1 - rate) < limit <= 1, got rate {rate} and limit {limit}")

    def log_alpha(params):
        return math.log(limit) - jax.nn.softplus(-params["logit"])

    def kl(params):
        log_variance = log_alpha(params)
        alpha = jnp.exp(log_variance)
        cubic = alpha * (1.16145124 + alpha * (-1.50204118 + alpha * 0.58629921))
        return jnp.sum(_LOG_UNIFORM_CONSTANT - 0.5 * log_variance - cubic)

    return _normal("logit", math.log(start / (limit - start)), log_alpha, kl)


def sparse(rate: float = 0.1, low: float = -10.0, high: float = 4.0) -> Dropout:
    """Sparse variational dropout: z ~ N(1, alpha), alpha learned per unit and large if need be (Molchanov et al. 2017).

    log alpha lies in (low, high) through a sigmoid of params["position"] and starts at log(rate / (1 - rate)); a unit
    with log alpha > 3 is as good as pruned. The prior is log-uniform, KL by their approximation (eq. 14), good for
    every alpha. ValueError unless low < log(rate / (1 - rate)) < high.
    """
    start = math.log(_relative_variance(rate))
    if not low < start < high:
        raise ValueError(f"sparse dropout needs low < log(rate / (1 - rate)) < high, got {low}, {start:.3f}, {high}")

    def log_alpha(params):
        return _between(params["position"], low, high)

    def kl(params):
        log_variance = log_alpha(params)
        rise = 0.63576 * jax.nn.sigmoid(-(1.8732 + 1.48695 * log_variance))
        return jnp.sum(rise + 0.5 * jax.nn.softplus(-log_variance))

    return _normal("position", math.log((start - low) / (high - start)), log_alpha, kl)


def log_normal(
    low: float = -10.0,
    high: float = 0.0,
    min_scale: float = 0.01,
    initial_location: float = 0.99,
    initial_scale: tuple[float, float] = (-3.0, -1.0),
) -> Dropout:
    """Truncated log-normal noise (Neklyudov et al. 2017): log z ~ N(mu, sigma^2) cut to [low, high].

    The prior is uniform in log z on [low, high].
    mu = low + (high - low) sigmoid(params["location"]); sigma lies in the same way between min_scale and the prior's
    standard deviation (high - low) / sqrt(12), by params["scale"]. Initially mu is at the fraction `initial_location`
    of the interval, and params["scale"] is uniform between the two `initial_scale`. The KL is the exact one; the
    authors' code has a stray 1 / sigma in it. ValueError for an empty interval or scale range.

    Float32: low <= mu <= high gives alpha <= 0 <= beta, and sigma <= (high - low) / sqrt(12) gives beta - alpha >=
    3.46, so the normalizer Z is never under .499: neither it nor the quantile can suffer cancellation, wherever the
    parameters go.
    """
    max_scale = (high - low) / math.sqrt(12.0)
    if not (0.0 < min_scale < max_scale and 0.0 < initial_location < 1.0):
        raise ValueError(
            "log-normal dropout needs low < high, 0 < min_scale < (high - low) / sqrt(12), 0 < initial_location < 1; "
            f"got low {low}, high {high}, min_scale {min_scale}, initial_location {initial_location}"
        )

    def init(key, width):
        location = math.log(initial_location / (1.0 - initial_location))
        scale = jax.random.uniform(key, (width,), minval=initial_scale[0], maxval=initial_scale[1])
        return {"location": jnp.full((width,), location, float), "scale": scale}

    def normal(params):
        """mu, sigma of log z before truncation, and the interval in units of sigma, alpha <= 0 <= beta."""
        above = (high - low) * jax.nn.sigmoid(params["location"])
        below = (high - low) * jax.nn.sigmoid(-params["location"])  # not high - mu: it would round to 0 in float32
        sigma = _between(params["scale"], min_scale, max_scale)
        return low + above, sigma, -above / sigma, below / sigma

    def mask(params, noise):
        mu, sigma, alpha, beta = normal(params)
        start, end = erf(alpha / _SQRT_2), erf(beta / _SQRT_2)  # 2 Phi - 1, so the quantile is one _erf_inv on (-1, 1)
        log_z = mu + (_SQRT_2 * sigma) * _erf_inv(start + noise * (end - start))
        return jnp.exp(jnp.clip(log_z, low, high))  # the clip only undoes rounding

    def kl(params):
        _, sigma, alpha, beta = normal(params)
        mass = _mass(alpha, beta)
        truncation = (_times_density(alpha) - _times_density(beta)) / (2.0 * mass)
        entropy = jnp.log(sigma * mass) + 0.5 * math.log(2.0 * math.pi * math.e) + truncation
        return jnp.sum(math.log(high - low) - entropy)

    def retain(params):
        mu, sigma, alpha, beta = normal(params)
        # exp(mu + sigma^2 / 2) (Phi(beta - sigma) - Phi(alpha - sigma)) / Z, in logarithms: the factors over- and
        # underflow.
        upper, lower = log_ndtr(beta - sigma), log_ndtr(alpha - sigma)
        return jnp.exp(mu + 0.5 * sigma**2 + upper + jnp.log1p(-jnp.exp(lower - upper))) / _mass(alpha, beta)

    return Dropout(init=init, sample=_uniform, mask=mask, kl=kl, retain=retain, decay=_undiminished)


def _normal(name, start, log_alpha, kl):
    """z ~ N(1, alpha) with log alpha a function of the one parameter `name`."""
    return Dropout(
        init=lambda key, width: {name: jnp.full((width,), start, float)},
        sample=lambda key, width: jax.random.normal(key, (width,)),
        mask=lambda params, noise: 1.0 + jnp.exp(0.5 * log_alpha(params)) * noise,
        kl=kl,
        retain=lambda params: jnp.ones_like(params[name]),
        decay=_undiminished,
    )


def _undiminished(params):
    """`decay` of a kind whose noise does not thin the weight prior."""
    return jnp.ones(())


def _relative_variance(rate):
    """Variance over squared mean of a Bernoulli variable that is 0 with probability `rate`."""
    if not 0.0 < rate < 1.0:
        raise ValueError(f"the initial rate must be between 0 and 1, got {rate}")
    return rate / (1.0 - rate)


def _uniform(key, width):
    """[width] draws in (0, 1), the middles of 2^16 intervals: never an end, where a quantile is infinite."""
    bits = jax.random.bits(key, ((width + 1) // 2,), jnp.uint32)  # two draws from each: .94 of a fit step
    return (jnp.concatenate([bits >> 16, bits & 0xFFFF])[:width].astype(float) + 0.5) / 2**16


def _logit(u):
    return jnp.log(u) - jnp.log1p(-u)


def _erf_inv(x):
    """The y with erf(y) = x, to 4e-5 of it, for |x| < 1 - 5e-6: noise of 16 bits comes no nearer to 1."""
    s = jnp.sqrt(2.0 - jnp.log((1.0 - x) * (1.0 + x)))
    ratio = jnp.full_like(s, _ERF_INV[0])
    for coefficient in _ERF_INV[1:]:
        ratio = ratio * s + coefficient
    return ratio * x


def _between(raw, low, high):
    return low + (high - low) * jax.nn.sigmoid(raw)


def _mass(alpha, beta):
    """Phi(beta) - Phi(alpha) for alpha <= 0 <= beta."""
    return 0.5 * (erf(beta / _SQRT_2) - erf(alpha / _SQRT_2))


def _times_density(a):
    """a phi(a)."""
    return a * jnp.exp(-0.5 * a**2) / math.sqrt(2.0 * math.pi)
