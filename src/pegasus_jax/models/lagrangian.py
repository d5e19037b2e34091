"""A mechanism whose energies are a Bayesian network: Lagrange's equations, integrated (after Lutter et al. 2019)."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.scipy.stats
import numpy as np

from pegasus_jax.math.angles import encode
from pegasus_jax.math.normalize import Whitener, varied, whitener
from pegasus_jax.models._lagrangian_components import GREATEST_CHANGE, GREATEST_SPEED, LEAST_MASS, substituted
from pegasus_jax.models.networks import HEADS, Masks, noisy
from pegasus_jax.sharding import pallas_allowed
from pegasus_jax.types import Array, Batch, Dataset, Dynamics, Key, Params, Prediction
from pegasus_jax.vectorized import Vectorized

# Of Student's t, the likelihood. A pendulum that spins fast turns by radians between two steps of the integration, and
# no energies explain its next state: under a Gaussian, whose noise the head limits, a single such row would outweigh
# all others.
DEGREES_OF_FREEDOM = 4.0

# Runge and Kutta's four stages: how far ahead of the step's start each looks, by the slope before, and its share.
AHEAD, SHARE = np.array([0, 1 / 2, 1 / 2, 1]), np.array([1, 2, 2, 1]) / 6
UNROLL = {"gpu": 4}  # platform -> stages compiled as one, as in `rollout`


class Units(NamedTuple):
    """What makes the numbers of a mechanism of order one; from the data as a whole."""

    centre: Array  # [n] mean of the coordinates; 0 of angles
    spread: Array  # [n] their deviation; 1 of angles, infinite of what never varied
    speed: Array  # [n] deviation of the speeds
    control: Array  # [U] deviation of the controls; infinite of what never varied
    change: Array  # [D] deviation of a period's change of state
    size: Array  # [] rows these come from


class Posterior(NamedTuple):
    """A fitted mechanism."""

    params: Params
    units: Units


def lagrangian(
    *,
    states: int,
    controls: int,
    angles: tuple[int, ...],
    rates: tuple[int, ...],
    dt: float,
    substeps: int,
    hidden: tuple[int, ...],
    activation: str,
    weight_decay: float = 1.0,
    **noise: Any,
) -> Dynamics:
    """A distribution over mechanisms with n = D / 2 generalized coordinates q and speeds v, in any order in x [D].

    A network with noise on its units says, of q [n] alone, the lower triangular root L of the mass matrix and the
    potential V; M = L L'. With constants B, c and R beside it, and all in the data's units,

        M dv/dt = B u + c - R v - (dM/dt) v + d/dq (v' M v / 2 - V),

    integrated over a control period in `substeps` steps (Runge and Kutta's, of fourth order). The noise of the
    prediction is one std a dimension. `rates` are the entries of x that are rates of the other entries, in the order
    of those; `noise` describes the network, as `noisy` has it.
    """
    head = HEADS["sigmoid"]
    coordinates = coordinates_of(states, rates)
    moving = np.array(rates)
    n = len(coordinates)
    turning = tuple(i for i, coordinate in enumerate(coordinates) if coordinate in angles)
    rows, columns = np.tril_indices(n)
    widths: dict[str, Any] = dict(features=n + len(turning), hidden=hidden, outputs=len(rows) + 1)
    network = noisy(**widths, activation=activation, weight_decay=weight_decay, **noise)

    def init(key: Key) -> Params:
        net_key, control_key = jax.random.split(key)
        return network.init(net_key) | {
            "control": 0.5 * jax.random.normal(control_key, (n, controls)),
            "constant": jnp.zeros(n),
            "resistance": jnp.zeros((n, n)),
            "raw_std": jnp.zeros(states),
        }

    def prepare(data: Dataset) -> Units:
        x, u, y = (whitener(rows, data.size, full=False) for rows in (data.x, data.u, data.y))
        turns = np.isin(coordinates, angles)
        return Units(
            centre=jnp.where(turns, 0.0, x.mean[coordinates]),
            spread=jnp.where(turns, 1.0, unit_of(x)[coordinates]),
            speed=jnp.diagonal(x.root)[moving],
            control=unit_of(u),
            change=jnp.diagonal(y.root),
            size=data.size,
        )

    def energies(posterior: Posterior, masks: Masks, q: Array) -> tuple[Array, Array]:
        """L [n, n] and V [] at q [n]."""
        features = encode((q - posterior.units.centre) / posterior.units.spread, turning)
        out = network.apply(posterior.params["network"], features, masks)
        entries = jnp.where(rows == columns, LEAST_MASS + jax.nn.softplus(1 + out[:-1]), out[:-1])
        zero = jnp.zeros((), out.dtype)
        lower = [entries[i * (i + 1) // 2 + j] if j <= i else zero for i in range(n) for j in range(n)]
        return jnp.stack(lower).reshape(n, n), out[-1]

    def acceleration(posterior: Posterior, masks: Masks, q: Array, v: Array, u: Array) -> Array:
        """Change of v [n] in a control period; v and u [U] in their units."""
        params, units = posterior
        (lower, _), along = jax.linearize(lambda q: energies(posterior, masks, q), q)
        slopes, pull = jax.vmap(along)(jnp.diag(units.speed * dt))  # [n, n, n], [n]: of L and V by each coordinate
        # Sums, not matrix products: a few numbers each, they are compiled into one loop over particles.
        change, momentum = jnp.sum(v[:, None, None] * slopes, 0), jnp.sum(v[:, None] * lower, 0)  # dL/dt, and L' v
        force = params["control"] @ u + params["constant"] - params["resistance"] @ v - pull
        force += jnp.sum(jnp.sum(slopes * v[:, None], 1) * momentum, 1)
        force -= jnp.sum(change * momentum + lower * jnp.sum(v[:, None] * change, 0), 1)
        return within(solve(lower, force), GREATEST_CHANGE)

    def predict(posterior: Posterior, masks: Masks, x: Array, u: Array) -> Prediction:
        units, h = posterior.units, 1 / substeps
        u = u / units.control

        @jax.checkpoint  # the way back computes this again: cheaper than to store what it needs, stage by stage
        def rate(state: Array) -> Array:
            q, v = state
            return jnp.stack([dt * v, units.speed * acceleration(posterior, masks, q, v / units.speed, u)])

        def step(now: Array) -> Array:
            """One step of the integration; its stages in a loop, because four copies take longer to compile."""

            def stage(carry: tuple[Array, Array], weights: tuple[Array, Array]) -> tuple[tuple[Array, Array], None]:
                slope, total = carry
                ahead, share = weights
                slope = h * rate(now + ahead * slope)
                return (slope, total + share * slope), None

            weights = jnp.asarray(AHEAD, now.dtype), jnp.asarray(SHARE, now.dtype)
            nothing = jnp.zeros_like(now)
            unroll = UNROLL.get(jax.default_backend(), 1)
            (_, total), _ = jax.lax.scan(stage, (nothing, nothing), weights, unroll=unroll)
            now = now + total
            return now.at[1].set(within(now[1], GREATEST_SPEED * units.speed))

        start = now = jnp.stack([x[coordinates], x[moving]])
        for _ in range(substeps):
            now = step(now)
        change = jnp.zeros_like(x).at[coordinates].set(now[0] - start[0]).at[moving].set(now[1] - start[1])
        return Prediction(change, head(posterior.params["raw_std"]) * units.change)

    mechanics = dict(turning=turning, dt=dt, substeps=substeps, activation=activation)

    each = jax.vmap(predict, (None, 0, 0, 0))

    def together(posterior: Posterior, masks: Masks, x: Array, u: Array) -> Prediction:
        if not pallas_allowed(x):
            return each(posterior, masks, x, u)
        from pegasus_jax.models import _lagrangian_pallas as kernel  # what it needs of JAX is for GPUs

        if not kernel.suits(hidden, n):
            return each(posterior, masks, x, u)
        order = np.concatenate([coordinates, moving])
        change = kernel.fused(lambda *arguments: each(*arguments).mean, order, **mechanics)(posterior, masks, x, u)
        return Prediction(change, jnp.broadcast_to(head(posterior.params["raw_std"]) * posterior.units.change, x.shape))

    def loss(params: Params, key: Key, batch: Batch, units: Units) -> Array:
        """Eq. 2 / N, but of Student's t, with fresh noise for every row; the constants have the weights' prior."""
        masks = network.sample(key, params["noise"], batch.x.shape[0])
        predicted = jax.vmap(lambda masks, x, u: predict(Posterior(params, units), masks, x, u))(
            masks, batch.x, batch.u
        )
        likelihood = jax.scipy.stats.t.logpdf(batch.y, DEGREES_OF_FREEDOM, predicted.mean, predicted.std)
        return -jnp.mean(jnp.sum(likelihood, -1)) + penalty(params) / units.size

    def penalty(params: Params) -> Array:
        prior = weight_decay / 2 * sum(jnp.sum(params[name] ** 2) for name in ("control", "constant", "resistance"))
        return network.penalty(params) + prior

    return Dynamics(
        init=init,
        prepare=prepare,
        loss=loss,
        posterior=lambda params, data: Posterior(params, prepare(data)),
        sample=lambda key, posterior: network.sample(key, posterior.params["noise"]),
        apply=Vectorized(predict, together),
        penalty=penalty,
    )


def coordinates_of(states: int, rates: tuple[int, ...]) -> np.ndarray:
    """The entries [n] of a state that are no rates, in the order of their rates."""
    return np.array([i for i in range(states) if i not in rates])


def unit_of(w: Whitener) -> Array:
    """The deviation of each column [F]; infinite where it never varied: the model does not see it.

    A value a little beside where it always was would be thousands of units away.
    """
    return jnp.where(varied(w), jnp.diagonal(w.root), jnp.inf)


def within(v: Array, limit: Array | float) -> Array:
    """v, all but unchanged below half of the limit and never beyond it; smooth."""
    ratio = jnp.clip(v / limit, -100.0, 100.0)  # its eighth power exists
    return limit * ratio * (1 + ratio**8) ** -0.125


def solve(lower: Array, force: Array) -> Array:
    """a [n] with L L' a = force; unrolled, because for a few coordinates a library call costs more than the network."""

    def product(a: Array) -> Array:
        return jnp.sum(lower * jnp.sum(lower * a[:, None], 0), 1)

    def substitute(_: Any, force: Array) -> Array:
        return jnp.stack(substituted(lower, force))

    return jax.lax.custom_linear_solve(product, force, substitute, symmetric=True)
