"""What a truncated normal's draws are made of: uniforms, and the inverse of the error function."""

import math

import jax
import jax.numpy as jnp

from pegasus_jax.types import Array, Key

# Giles 2012, "Approximating the erfinv function", GPU Computing Gems 2, single precision: erf_inv(x) / x as a
# polynomial in w - 2.5 where w = -log(1 - x^2) < 5, and in sqrt(w) - 3 beyond; highest power first.
_CENTRE = (2.81022636e-08, 3.43273939e-07, -3.5233877e-06, -4.39150654e-06, 0.00021858087)
_CENTRE += (-0.00125372503, -0.00417768164, 0.246640727, 1.50140941)
_TAIL = (-0.000200214257, 0.000100950558, 0.00134934322, -0.00367342844, 0.00573950773)
_TAIL += (-0.0076224613, 0.00943887047, 1.00167406, 2.83297682)


def uniforms(key: Key, count: int) -> Array:
    """[count] draws in (0, 1), the middles of 2^16 equal intervals, two from each 32 random bits.

    A training step draws tens of thousands of them, and the generator is most of what they cost. What the rounding
    takes from a normal draw's variance is 2e-5 of it.
    """
    bits = jax.random.bits(key, ((count + 1) // 2,), jnp.uint32)
    halves = jnp.concatenate([bits >> 16, bits & 0xFFFF])[:count]
    return (halves.astype(float) + 0.5) / 2**16


@jax.custom_jvp
def erf_inv(x: Array) -> Array:
    """The y with erf(y) = x, for |x| < 1, to 6e-6 of it in float32.

    `jax.lax.erf_inv` is more careful with x near 0 and 1, and takes a processor more than twice as long.
    """
    if x.dtype != jnp.float32:
        return jax.lax.erf_inv(x)
    w = -jnp.log((1 - x) * (1 + x))
    central = w < 5
    t = jnp.where(central, w - 2.5, jnp.sqrt(w) - 3)
    ratio = jnp.zeros_like(x)
    for centre, tail in zip(_CENTRE, _TAIL, strict=True):
        ratio = ratio * t + jnp.where(central, centre, tail)
    return ratio * x


@erf_inv.defjvp
def _erf_inv_jvp(primals, tangents):
    y = erf_inv(*primals)
    return y, (0.5 * math.sqrt(math.pi)) * jnp.exp(y * y) * tangents[0]
