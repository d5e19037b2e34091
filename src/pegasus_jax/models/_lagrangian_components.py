"""Lagrange's equations of `models/lagrangian` by components, for blocks of B particles: what a GPU kernel can do.

A kernel has no small matrices, so each of their entries is an array [B] of its own. Its network is of [B, W].
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from pegasus_jax.models.networks import ACTIVATIONS
from pegasus_jax.types import Array

# In units of the data's own deviations: the least diagonal of the mass matrix's factor, and the greatest change of a
# speed in a control period. Where there are no data a mass matrix may be all but singular, and nothing else would keep
# a particle from going to infinity within one step.
LEAST_MASS, GREATEST_CHANGE, GREATEST_SPEED = 0.1, 20.0, 6.0

State = tuple[Array, ...]  # 2n of [B]: the coordinates, then their speeds


class Mechanism(NamedTuple):
    """What the equations need of a posterior: numbers and rows here, whole arrays outside of the GPU kernel."""

    centre: Any  # [n]
    spread: Any  # [n]
    speed: Any  # [n]
    constant: Any  # [n]
    control: Any  # [n][U]
    resistance: Any  # [n][n]
    kernels: Any  # the first layer's rows [F] of [1, W], the others [W, W], and a row [1, W] for each output
    biases: Any  # [1, W] a layer, and one number for each output


def slope(
    m: Mechanism, masks: Sequence[Any], state: State, u: State, *, turning: tuple[int, ...], dt: float, **network: Any
) -> State:
    """Change of the state in a control period at the rates it has; `masks` [B, W] or None multiply hidden units."""
    n = len(state) // 2
    q, v = state[:n], state[n:]
    change = acceleration(m, masks, q, tuple(v[i] / m.speed[i] for i in range(n)), u, turning=turning, dt=dt, **network)
    return tuple(dt * speed for speed in v) + tuple(m.speed[i] * change[i] for i in range(n))


def acceleration(m: Mechanism, masks: Sequence[Any], q: State, v: State, u: State, **network: Any) -> State:
    """Change of v in a control period; v and u in their units."""
    n = len(q)
    out, slopes = energies(m, masks, q, **network)
    entry = {(i, j): i * (i + 1) // 2 + j for i in range(n) for j in range(i + 1)}  # L_ij's place in the outputs
    lower = {ij: LEAST_MASS + softplus(1 + out[o]) if ij[0] == ij[1] else out[o] for ij, o in entry.items()}
    turned = {ij: jax.nn.sigmoid(1 + out[o]) if ij[0] == ij[1] else 1.0 for ij, o in entry.items()}
    by = {(a, *ij): turned[ij] * slopes[o][a] for ij, o in entry.items() for a in range(n)}  # L_ij by q_a
    change = {ij: sum(v[a] * by[a, *ij] for a in range(n)) for ij in entry}  # dL/dt
    momentum = [sum(v[i] * lower[i, j] for i in range(j, n)) for j in range(n)]  # L' v
    moved = [sum(v[i] * change[i, j] for i in range(j, n)) for j in range(n)]
    force = []
    for a in range(n):
        f = m.constant[a] - slopes[-1][a] + sum(m.control[a][b] * u[b] for b in range(len(u)))
        f -= sum(m.resistance[a][b] * v[b] for b in range(n))
        f += sum(sum(by[a, i, j] * v[i] for i in range(j, n)) * momentum[j] for j in range(n))
        f -= sum(change[a, j] * momentum[j] + lower[a, j] * moved[j] for j in range(a + 1))
        force.append(f)
    return tuple(within(a, GREATEST_CHANGE)[0] for a in substituted(lower, force))


def energies(
    m: Mechanism,
    masks: Sequence[Any],
    q: State,
    *,
    turning: tuple[int, ...],
    dt: float,
    activation: str,
    product: Callable[[Array, Array], Array],
) -> tuple[list[Array], list[list[Array]]]:
    """The network's outputs [o] at q, and [o][a] their changes in a period in which only q_a moves, at unit speed."""
    n = len(q)
    scaled = [(q[i] - m.centre[i]) / m.spread[i] for i in range(n)]
    along = [m.speed[i] * dt / m.spread[i] for i in range(n)]
    plain = [i for i in range(n) if i not in turning]
    sines, cosines = [jnp.sin(scaled[i]) for i in turning], [jnp.cos(scaled[i]) for i in turning]
    rows = m.kernels[0]
    features = [scaled[i] for i in plain] + sines + cosines
    z = m.biases[0] + sum(feature[:, None] * row for feature, row in zip(features, rows, strict=True))
    slopes = []
    for i in range(n):
        if i in turning:
            place = turning.index(i)
            up, down = len(plain) + place, len(plain) + len(turning) + place
            slope = (cosines[place] * along[i])[:, None] * rows[up] - (sines[place] * along[i])[:, None] * rows[down]
        else:
            slope = rows[plain.index(i)] * along[i]
        slopes.append(jnp.broadcast_to(slope, z.shape))

    def active(mask: Any, z: Array, slopes: list[Array]) -> tuple[Array, list[Array]]:
        y, push = jax.linearize(ACTIVATIONS[activation], z)
        scale = 1.0 if mask is None else mask
        return y * scale, [push(slope) * scale for slope in slopes]

    y, slopes = active(masks[0], z, slopes)
    for mask, kernel, bias in zip(masks[1:], m.kernels[1:-1], m.biases[1:-1], strict=True):
        y, slopes = active(mask, product(y, kernel) + bias, [product(slope, kernel) for slope in slopes])
    out = [jnp.sum(y * row, 1) + bias for row, bias in zip(m.kernels[-1], m.biases[-1], strict=True)]
    return out, [[jnp.sum(slope * row, 1) for slope in slopes] for row in m.kernels[-1]]


def substituted(lower: Any, force: Any) -> list[Array]:
    """a [n] with L L' a = force [n], entry by entry; lower[i, j] are those of L."""
    n, half, whole = len(force), [], {}
    for i in range(n):
        half.append((force[i] - sum(lower[i, j] * half[j] for j in range(i))) / lower[i, i])
    for i in reversed(range(n)):
        whole[i] = (half[i] - sum(lower[j, i] * whole[j] for j in range(i + 1, n))) / lower[i, i]
    return [whole[i] for i in range(n)]


def softplus(z: Array) -> Array:
    """log(1 + exp(z)), of functions that a kernel has."""
    return jnp.maximum(z, 0.0) + jnp.log(1.0 + jnp.exp(-jnp.abs(z)))


def within(v: Array, limit: Array | float) -> tuple[Array, Array]:
    """`lagrangian.within` and its slope."""
    ratio = jnp.clip(v / limit, -100.0, 100.0)
    square = ratio * ratio
    fourth = square * square
    grown = jnp.log(1.0 + fourth * fourth)
    return limit * ratio * jnp.exp(-0.125 * grown), jnp.exp(-1.125 * grown)
