"""Moment matching: replacing particles by fresh ones from the Gaussian with their mean and covariance."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax.math.linalg import cholesky, mean_and_cov
from pegasus_jax.types import Array

__all__ = ["Match", "keep", "match", "narrow", "wide"]

Match = Callable[[Array, Array], Array]

# [rad] Particles that are spread evenly over half a circle have a standard deviation of .91, over all of it 1.81.
WIDEST = 1.0


def match(x: Array, z: Array) -> Array:
    """Particles [K, D] redrawn as mean + L z from the Gaussian fitted to x [K, D]; z [K, D] is standard normal.

    Alg. 3 line 14, whose Sigma z is a slip of notation for L z with L L' = Sigma.
    """
    mean, cov = mean_and_cov(x)
    return mean + z @ cholesky(cov).T


def keep(x: Array, z: Array) -> Array:
    """No moment matching: every particle goes on along its own trajectory."""
    del z
    return x


def narrow(angles: tuple[int, ...]) -> Match:
    """`match` while the particles are close together, and `keep` at the times at which they are `wide`.

    Particles all around a circle are no Gaussian: one of the same moments forgets which of them swings which way, and
    what a policy does to them averages out.
    """
    return lambda x, z: either(wide(x, angles), keep, match)(x, z)


def either(condition: Array | None, yes: Callable[..., Array], no: Callable[..., Array]) -> Callable[..., Array]:
    """A function that is `yes` where the condition holds and `no` elsewhere; without a condition, `no`.

    Both are computed, because a branch at each time step costs a GPU more than they do. The one that is not chosen is
    given zeros: else a diverged particle could give it a gradient of NaN.
    """
    if condition is None:
        return no

    def chosen(*arguments: Array) -> Array:
        of_yes, of_no = ([jnp.where(c, a, 0) for a in arguments] for c in (condition, ~condition))
        return jnp.where(condition, yes(*of_yes), no(*of_no))

    return chosen


def wide(x: Array, angles: tuple[int, ...]) -> Array:
    """Whether one of the angles of particles x [..., K, D] has a standard deviation of more than 1 rad -> [...]."""
    turns = jax.lax.stop_gradient(x)[..., np.array(angles, int)]
    return jnp.any(jnp.std(turns, -2) > WIDEST, -1)
