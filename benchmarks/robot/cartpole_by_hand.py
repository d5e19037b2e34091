"""The equations of a cart and a uniform rod, written down by hand, as a simulator for `prior=`."""

from functools import partial

import jax
import jax.numpy as jnp

PERIOD, STEPS, GRAVITY = 0.1, 4, 9.82  # [s] of control, Runge-Kutta's steps in it, [m/s^2]


def simulate(x, u, *, length, pole, cart, friction):
    """x [4], as task=cartpole has it, and a force u [1] [N] -> x a control period later; lengths in m, masses in kg."""

    def slope(x):
        _, speed, rate, angle = x
        sine, cosine = jnp.sin(angle), jnp.cos(angle)
        # (cart + pole) a + pole l/2 (cos w' - sin w^2) = u - friction v  and  l/3 w' + cos a / 2 + g sin / 2 = 0
        force = u[0] - friction * speed + pole * length / 2 * sine * rate**2
        acceleration = (force + 0.75 * pole * GRAVITY * sine * cosine) / (cart + pole - 0.75 * pole * cosine**2)
        return jnp.stack([speed, acceleration, -1.5 * (acceleration * cosine + GRAVITY * sine) / length, rate])

    def step(x, _):
        h = PERIOD / STEPS
        a = slope(x)
        b = slope(x + h / 2 * a)
        c = slope(x + h / 2 * b)
        d = slope(x + h * c)
        return x + h / 6 * (a + 2 * b + 2 * c + d), None

    return jax.lax.scan(step, x, None, STEPS)[0]


TRUE = {"length": 0.6, "pole": 0.5, "cart": 0.5, "friction": 0.1}  # of task=cartpole [m, kg, kg, N s/m]
# What a simulator takes them for: factors.
OFF = {
    "exact": dict.fromkeys(TRUE, 1.0),
    "low": dict.fromkeys(TRUE, 0.7),
    "high": dict.fromkeys(TRUE, 1.3),
    "mixed": {"length": 1.3, "pole": 0.7, "cart": 1.3, "friction": 0.7},
}


def constants(off):
    """Those of a simulator."""
    return {name: value * OFF[off][name] for name, value in TRUE.items()}


exact, low, high, mixed = (partial(simulate, **constants(off)) for off in OFF)
