"""Costs of states, and what a search makes of the costs of K imagined rollouts."""

from collections.abc import Callable
from functools import lru_cache, partial, wraps

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax.imagine.matching import wide
from pegasus_jax.math.gaussian import saturating_cost, sincos
from pegasus_jax.math.linalg import cholesky, mean_and_cov
from pegasus_jax.shapes import check_shape
from pegasus_jax.types import Array, Cost

__all__ = [
    "blind_to_memory",
    "expectation",
    "expected_by_nodes",
    "mean",
    "of_matched",
    "of_narrow",
    "of_particles",
    "saturating",
    "total",
    "until_stop",
    "widened",
]

OfState = Callable[[Array], Array]  # x [D] -> scalar
Error = Callable[[Array], Array]  # x [D] -> e [E], affine in the features of x

NODES = 512  # points of the quadrature for a cost whose expectation has no closed form


def saturating(error: Error, width: Array | float, angles: tuple[int, ...]) -> Cost:
    """The cost 1 - exp(-|error(x)|^2 / (2 width^2)) of a state x [D] (Deisenroth 2010; docs/reference.md 1.3).

    Its expectation is PILCO's: the sines and cosines of the state's `angles` are taken for Gaussian, with their exact
    moments. So it is exact without angles, and as close as that is with them.
    """

    def of_state(x: Array) -> Array:
        e = error(x) / width
        return 1 - jnp.exp(-0.5 * jnp.sum(e * e))

    def expected(mean: Array, cov: Array) -> Array:
        features = sincos(mean, cov, angles)
        matrix, offset = (a.astype(mean.dtype) for a in affine_error(error, mean.shape[0], angles))
        return saturating_cost(features.mean, features.cov, matrix, offset, width)

    return Cost(of_state, expected, lambda factor: saturating(error, width * factor, angles))


def affine_error(error: Error, states: int, angles: tuple[int, ...]) -> tuple[Array, Array]:
    """(matrix [E, F], offset [E]) with error(x) = matrix @ encode(x, angles) + offset.

    Exact for an error that is affine in the plain entries of x [D] and in the sines and cosines of its angles [rad].
    """
    plain = np.array([i for i in range(states) if i not in angles], int)
    angle = np.array(angles, int)
    unit = np.eye(states)
    at = jax.vmap(error)
    origin = error(jnp.zeros(states))
    linear = at(jnp.asarray(unit[plain])) - origin
    up, down = at(jnp.asarray(unit[angle] * np.pi / 2)), at(jnp.asarray(-unit[angle] * np.pi / 2))
    cosine = (origin - at(jnp.asarray(unit[angle] * np.pi))) / 2
    return jnp.concatenate([linear, (up - down) / 2, cosine]).T, origin - jnp.sum(cosine, 0)


def widened(cost: Cost, factor: Array | float) -> Cost:
    """The cost of `factor` times the width: in closed form where that is known, else 1 - (1 - c)^(1 / factor^2).

    They are the same for c = 1 - exp(-e^2 / (2 width^2)); for any other c in [0, 1] the order of states stays. An
    `expected` without `widen` is known at its own width alone; at any other there is a mean over nodes.
    """
    if cost.widen is not None:
        return cost.widen(factor)

    def of_state(x: Array) -> Array:
        rest = 1 - _scalar(cost.of_state(x))
        floored = jnp.maximum(rest, jnp.finfo(rest.dtype).eps)  # at c = 1 the slope is infinite: take that of c there
        return 1 - floored**factor**-2 + (floored - rest)

    known, nodes = cost.expected, expected_by_nodes(of_state)
    return Cost(of_state, None if known is None else lambda *x: jax.lax.cond(jnp.equal(factor, 1), known, nodes, *x))


def blind_to_memory(cost: Cost, states: int) -> Cost:
    """A cost of x [D] as one of x' [D + M], which has the memory behind x: it reads the first D entries only."""
    expected, widen = cost.expected, cost.widen
    return Cost(
        wraps(cost.of_state)(lambda x: cost.of_state(x[:states])),
        None if expected is None else lambda mean, cov: expected(mean[:states], cov[:states, :states]),
        None if widen is None else lambda factor: blind_to_memory(widen(factor), states),
    )


def expectation(cost: Cost) -> Callable[[Array, Array], Array]:
    """The expected cost of a state's (mean [D], cov [D, D]): in closed form where that is known, else by nodes."""
    return cost.expected or expected_by_nodes(cost.of_state)


def expected_by_nodes(of_state: OfState, *, nodes: int = NODES) -> Callable[[Array, Array], Array]:
    """The expectation of any cost of a Gaussian state x [D]: the mean over as many fixed nodes, at least 2 D.

    Quasi-Monte Carlo with `normal_nodes`: exact for a cost that is a constant, linear or quadratic in x.
    """

    def expected(mean: Array, cov: Array) -> Array:
        z = nodes_for(mean.shape[0], nodes)
        return jnp.mean(jax.vmap(of_state)(mean + z.astype(mean.dtype) @ cholesky(cov).T))

    return expected


def nodes_for(states: int, nodes: int = NODES) -> np.ndarray:
    """The nodes [N, D] of an expectation over so many states; computed once."""
    return normal_nodes(max(nodes, 2 * states), states)


@lru_cache(maxsize=8)
def normal_nodes(count: int, size: int) -> np.ndarray:
    """Points [count, size] that stand for a standard normal, whose mean and covariance they have exactly.

    The normal's quantiles of Sobol's sequence, each moved to the middle of its interval, as none may be at 0.
    """
    # Not first in a thread while another one imports PyTorch: SciPy would use the half-imported module (runs/job.py).
    from scipy.stats import norm, qmc  # slow to import, and only a cost of one's own needs them

    intervals = 2 ** (count - 1).bit_length()
    z = norm.ppf(qmc.Sobol(size, scramble=False).random(count) + 0.5 / intervals)
    z -= z.mean(0)
    return np.linalg.solve(np.linalg.cholesky(z.T @ z / count), z.T).T


def of(cost: Cost, x: Array) -> Array:
    """The cost [] of one state. Raises ValueError where it is no scalar."""
    return _scalar(cost.of_state(x))


def of_particles(cost: Cost) -> Callable[[Array], Array]:
    """The cost of every particle: x [H, K, D] -> [H, K]. Raises ValueError where a state's cost is no scalar."""
    return jax.vmap(jax.vmap(partial(of, cost)))


def until_stop(costs: Array, x: Array, stop: Callable[[Array], Array], stop_cost: float) -> Array:
    """Costs [H, K] or [H, 1] of particles x [H, K, D] that end where `stop` says; after that a step costs `stop_cost`.

    A particle goes on after each state with probability 1 - stop(x); the state that ends it still has its own cost.
    """
    goes_on = jnp.cumprod(1 - jax.vmap(jax.vmap(stop))(x).astype(costs.dtype), 0)
    running = jnp.concatenate([jnp.ones_like(goes_on[:1]), goes_on[:-1]])
    running = running if costs.shape[1] == running.shape[1] else jnp.mean(running, 1, keepdims=True)
    return running * costs + (1 - running) * stop_cost


def of_matched(cost: Cost) -> Callable[[Array], Array]:
    """The expected cost of the Gaussian with the particles' mean and covariance: x [H, K, D] -> [H, 1]."""
    expected = expectation(cost)
    return jax.vmap(lambda x: expected(*mean_and_cov(x))[None])


def of_narrow(cost: Cost, angles: tuple[int, ...]) -> Callable[[Array], Array]:
    """`of_matched`, and at the times at which the particles are `matching.wide` their own: x [H, K, D] -> [H, K]."""
    own, matched = of_particles(cost), of_matched(cost)

    def each(x: Array) -> Array:
        far = wide(x, angles)[:, None]
        return jnp.where(far, own(x), matched(jnp.where(far[..., None], 0, x)))  # as `either` does

    return each


def mean(costs: Array) -> Array:
    """Mean cost a step and particle: what the authors' code minimizes."""
    return jnp.mean(costs)


def total(costs: Array) -> Array:
    """Cost of an episode, averaged over particles: eq. 1 and Alg. 3 line 15, of the H states after the first one."""
    return jnp.sum(jnp.mean(costs, 1))


def _scalar(value: Array) -> Array:
    """A state's cost, if it is one number. Raises ValueError."""
    check_shape("the cost of one state", value, ())
    return value
