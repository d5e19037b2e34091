"""A control period of a mechanism, for all particles, as one GPU kernel there and one back.

It makes a search step of ten policies on an H200 11.3 ms instead of 38: docs/decisions.md 0010.
"""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas
from jax.experimental.pallas import triton

from pegasus_jax.models import _lagrangian_components
from pegasus_jax.models._lagrangian_components import GREATEST_SPEED, Mechanism, State, within
from pegasus_jax.types import Array

# Particles of one program, the fewest that a matrix product takes, and its warps; of 16 to 64 and 1 to 8 the fastest.
BLOCK, WARPS = 16, 4
WIDEST = 64  # hidden units of a layer: more do not fit into a program's registers
MOST = 4  # coordinates: the equations are written out, which grows with their cube


def suits(hidden: Sequence[int], coordinates: int) -> bool:
    """Whether the kernel is for this network and mechanism."""
    return coordinates <= MOST and len(hidden) >= 1 and max(hidden) <= WIDEST


def fused(
    plain: Callable[..., Array], order: np.ndarray, **mechanics: Any
) -> Callable[[Any, Any, Array, Array], Array]:
    """`plain`, changes of state [K, D] of (posterior, masks, x [K, D], u [K, U]), as kernels.

    x[:, order] is the coordinates and then their speeds. The gradient by the posterior and the masks, which no search
    asks for, is that of `plain`.
    """
    forward, backward = period(**mechanics)
    inverse = np.argsort(order)

    def there(posterior: Any, masks: Sequence[Any], x: Array, u: Array) -> tuple[Array, Any]:
        state = x.T[order]
        after, saved = forward(*mechanism(posterior, masks), state, (u / posterior.units.control).T)
        return (after - state)[inverse].T, (posterior, masks, x, u, saved)

    def back(residuals: Any, cotangent: Array) -> Any:
        posterior, masks, x, u, saved = residuals
        given = cotangent.T[order]
        pulled = backward(*mechanism(posterior, masks), (u / posterior.units.control).T, saved, given)
        of_x, of_u = (pulled[: len(order)] - given)[inverse].T, pulled[len(order) :].T / posterior.units.control
        _, pull = jax.vjp(lambda posterior, masks: plain(posterior, masks, x, u), posterior, masks)
        return *pull(cotangent), of_x, of_u

    change = jax.custom_vjp(lambda *arguments: there(*arguments)[0])
    change.defvjp(there, back)
    return change


def period(
    *, turning: tuple[int, ...], dt: float, substeps: int, activation: str, interpret: bool = False
) -> tuple[Callable[..., Any], Callable[..., Array]]:
    """(forward, backward) of a period; arguments as in `lagrangian`, `interpret` runs them without a GPU.

    forward (mechanism, masks [hidden] of [K, W] or None, state [2n, K], u [U, K]) -> (state after [2n, K], saved);
    backward (mechanism, masks, u, saved, cotangent [2n, K]) -> cotangents of state and u [2n + U, K].
    """
    stages = 4 * substeps
    precision = None if interpret else jax.lax.DotAlgorithmPreset.TF32_TF32_F32_X3

    def product(a: Array, b: Array) -> Array:
        return jax.lax.dot_general(a, b, (((1,), (0,)), ((), ())), precision=precision)

    rates = partial(_lagrangian_components.slope, turning=turning, dt=dt, activation=activation, product=product)

    def slope(m: Mechanism, masks: Sequence[Any], state: State, u: State) -> State:
        """Change of the state in one step of the integration, by its rates at `state`."""
        return tuple(rate / substeps for rate in rates(m, masks, state, u))

    def limits(m: Mechanism) -> list[Array]:
        return [GREATEST_SPEED * speed for speed in m.speed]

    def there(m: Mechanism, masks: Any, state: Any, u: Any, after: Any, saved: Any, ends: Any) -> None:
        n, own = state.shape[0] // 2, Rows(state.shape[1])
        m, drawn, controls = loaded(m), own.masks(masks), own.read(u)
        nothing = tuple(jnp.zeros(BLOCK, jnp.float32) for _ in range(2 * n))

        def stage(k: Array, carry: tuple[State, State, State]) -> tuple[State, State, State]:
            now, before, total = carry
            step, s = jax.lax.div(k, 4), jax.lax.rem(k, 4)
            at = plus(now, before, ahead(s))
            own.write(saved, at, k)
            change = slope(m, drawn, at, controls)
            total = plus(total, change, share(s))
            end = plus(now, total)
            own.write(ends, end[n:], step)  # four times; that of the last stage stays
            end = end[:n] + tuple(within(v, limit)[0] for v, limit in zip(end[n:], limits(m), strict=True))
            return either(s == 3, end, now), change, either(s == 3, nothing, total)

        now, _, _ = jax.lax.fori_loop(0, stages, stage, (own.read(state), nothing, nothing))
        own.write(after, now)

    def back(m: Mechanism, masks: Any, u: Any, saved: Any, ends: Any, cotangent: Any, out: Any) -> None:
        n, own = saved.shape[1] // 2, Rows(u.shape[1])
        m, drawn, controls = loaded(m), own.masks(masks), own.read(u)
        nothing = tuple(jnp.zeros(BLOCK, jnp.float32) for _ in range(2 * n))

        def stage(k: Array, carry: tuple[State, State, State, State]) -> tuple[State, State, State, State]:
            now, end, later, of_u = carry
            k = stages - 1 - k
            step, s = jax.lax.div(k, 4), jax.lax.rem(k, 4)
            reached = own.read(ends, step)
            limited = tuple(c * within(v, most)[1] for c, v, most in zip(now[n:], reached, limits(m), strict=True))
            limited = now[:n] + limited
            now, end, later = either(s == 3, limited, now), either(s == 3, limited, end), either(s == 3, nothing, later)
            _, pull = jax.vjp(partial(slope, m, drawn), own.read(saved, k), controls)
            at, by_u = pull(plus(later, end, share(s)))
            return plus(now, at), end, tuple(ahead(s) * a for a in at), plus(of_u, by_u)

        start = own.read(cotangent), nothing, nothing, tuple(jnp.zeros(BLOCK, jnp.float32) for _ in controls)
        now, _, _, of_u = jax.lax.fori_loop(0, stages, stage, start)
        own.write(out, (*now, *of_u))

    def call(kernel: Callable, particles: int, shapes: Any) -> Callable:
        how = None if interpret else triton.CompilerParams(num_warps=WARPS, num_stages=1)
        grid = (pallas.cdiv(particles, BLOCK),)
        return pallas.pallas_call(kernel, grid=grid, out_shape=shapes, interpret=interpret, compiler_params=how)

    def forward(m: Mechanism, masks: Any, state: Array, u: Array) -> tuple[Array, tuple[Array, Array]]:
        d, k = state.shape
        shapes = [jax.ShapeDtypeStruct(s, jnp.float32) for s in ((d, k), (stages, d, k), (substeps, d // 2, k))]
        after, saved, ends = call(there, k, shapes)(m, masks, state, u)
        return after, (saved, ends)

    def backward(m: Mechanism, masks: Any, u: Array, saved: tuple[Array, Array], cotangent: Array) -> Array:
        d, k = cotangent.shape
        shape = jax.ShapeDtypeStruct((d + u.shape[0], k), jnp.float32)
        return call(back, k, shape)(m, masks, u, *saved, cotangent)

    return forward, backward


class Rows:
    """The particles of this program, of K: reads and writes [B] of what is [.., K]; those beyond K are 0."""

    def __init__(self, particles: int) -> None:
        self.rows = pallas.program_id(0) * BLOCK + jnp.arange(BLOCK)
        self.there = self.rows < particles

    def read(self, ref: Any, *index: Any) -> State:
        places = range(ref.shape[len(index)])
        return tuple(triton.load(ref.at[(*index, i, self.rows)], mask=self.there, other=0.0) for i in places)

    def write(self, ref: Any, values: State, *index: Any) -> None:
        for i, value in enumerate(values):
            triton.store(ref.at[(*index, i, self.rows)], value, mask=self.there)

    def masks(self, refs: Any) -> list[Any]:
        """[B, W] of each [K, W]."""

        def load(ref: Any) -> Array:
            width = ref.shape[1]
            there = jnp.broadcast_to(self.there[:, None], (BLOCK, width))
            return triton.load(ref.at[self.rows[:, None], jnp.arange(width)[None, :]], mask=there, other=0.0)

        return [None if ref is None else load(ref) for ref in refs]


def mechanism(posterior: Any, masks: Sequence[Any]) -> tuple[Mechanism, list[Any]]:
    """A posterior's arrays and the hidden units' masks [K, width], layers padded with idle units to powers of two."""
    params, units = posterior
    layers = [params["network"]["params"][f"layer_{i}"] for i in range(len(masks))]
    widths = [max(16, 1 << (layer["bias"].shape[0] - 1).bit_length()) for layer in layers[:-1]]

    def filled(value: Array, *shape: int) -> Array:
        return jnp.pad(value, [(0, most - size) for size, most in zip(value.shape, shape, strict=True)])

    first, last = layers[0]["kernel"], layers[-1]["kernel"].T
    sizes = pairwise(widths)
    middle = [filled(layer["kernel"], *size) for layer, size in zip(layers[1:-1], sizes, strict=True)]
    kernels = filled(first, first.shape[0], widths[0]), *middle, filled(last, last.shape[0], widths[-1])
    biases = [filled(layer["bias"], width) for layer, width in zip(layers, widths, strict=False)]
    constants = (params[name] for name in ("constant", "control", "resistance"))
    wide = [None if mask is None else filled(mask, mask.shape[0], w) for mask, w in zip(masks[1:], widths, strict=True)]
    arrays = units.centre, units.spread, units.speed, *constants, kernels, (*biases, layers[-1]["bias"])
    return Mechanism._make(arrays), wide


def loaded(m: Mechanism) -> Mechanism:
    """The numbers behind references, as the equations take them: constants one by one, and the outer layers by rows."""

    def numbers(ref: Any) -> list[Any]:
        return [ref[i] for i in range(ref.shape[0])]

    def table(ref: Any) -> list[list[Any]]:
        return [[ref[i, j] for j in range(ref.shape[1])] for i in range(ref.shape[0])]

    def rows(ref: Any) -> list[Array]:
        return [ref[i, :][None, :] for i in range(ref.shape[0])]

    (first, *middle, last), (*biases, outputs) = m.kernels, m.biases
    return Mechanism(
        centre=numbers(m.centre),
        spread=numbers(m.spread),
        speed=numbers(m.speed),
        constant=numbers(m.constant),
        control=table(m.control),
        resistance=table(m.resistance),
        kernels=(rows(first), *(kernel[...] for kernel in middle), rows(last)),
        biases=(*(bias[...][None, :] for bias in biases), numbers(outputs)),
    )


def plus(a: State, b: State, factor: Array | float = 1.0) -> State:
    """a + factor b."""
    return tuple(x + factor * y for x, y in zip(a, b, strict=True))


def either(chosen: Array, a: State, b: State) -> State:
    """a where chosen, else b."""
    return tuple(jnp.where(chosen, x, y) for x, y in zip(a, b, strict=True))


def ahead(stage: Array) -> Array:
    """0, 1/2, 1/2, 1: how far ahead of the step's start a stage looks, by the slope before."""
    s = stage.astype(jnp.float32)
    return 0.5 * jnp.minimum(s, 1.0) + 0.5 * jnp.maximum(s - 2.0, 0.0)


def share(stage: Array) -> Array:
    """1/6, 1/3, 1/3, 1/6: a stage's share of the step."""
    s = stage.astype(jnp.float32)
    return (1.0 + jnp.minimum(s, 1.0) * jnp.minimum(3.0 - s, 1.0)) / 6.0
