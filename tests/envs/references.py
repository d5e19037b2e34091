"""Independent answers to hold the plants to: the paper's equations of motion by scipy, and C MuJoCo."""

from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.integrate import solve_ivp

from pegasus_envs.plant import Plant, simulate

GRAVITY, FRICTION, LENGTH, MASS = 9.82, 0.1, 0.6, 0.5


class Simulated(NamedTuple):
    plant: Plant
    run: Any
    """(state, controls [H, U]) -> x [H + 1, D]"""

    def start(self, seed: int = 0) -> Any:
        return self.plant.reset(jax.random.key(seed))

    def random(self, seed: int = 0, horizon: int | None = None) -> np.ndarray:
        """Controls [H, U], uniform between the limits."""
        plant = self.plant
        shape = (horizon or plant.horizon, len(plant.control_low))
        return np.random.default_rng(seed).uniform(plant.control_low, plant.control_high, shape).astype(np.float32)


def simulated(plant: Plant) -> Simulated:
    return Simulated(plant, jax.jit(lambda state, controls: simulate(plant, state, controls)))


def cartpole_rate(x: np.ndarray, force: float, length: float = LENGTH, friction: float = FRICTION) -> np.ndarray:
    """Time derivative of [position, speed, angle's rate, angle], angle 0 hanging; cart and pole weigh the same."""
    _, speed, rate, angle = x
    m = total = MASS
    s, c, pull = np.sin(angle), np.cos(angle), force - friction * speed
    bottom = 4 * (total + m) - 3 * m * c**2
    push = (2 * m * length * rate**2 * s + 3 * m * GRAVITY * s * c + 4 * pull) / bottom
    top = m * length * rate**2 * s * c + 2 * ((total + m) * GRAVITY * s + pull * c)
    return np.array([speed, push, -3 * top / (length * bottom), rate])


def double_cartpole_rate(x: np.ndarray, force: float, friction: float = FRICTION) -> np.ndarray:
    """Time derivative of [position, speed, both rates, both angles], angles 0 upright."""
    _, speed, w1, w2, t1, t2 = x
    m1 = m2 = m3 = MASS
    l2 = l3 = LENGTH
    c1, c2, c12 = np.cos(t1), np.cos(t2), np.cos(t1 - t2)
    left = np.array(
        [
            [2 * (m1 + m2 + m3), -(m2 + 2 * m3) * l2 * c1, -m3 * l3 * c2],
            [-3 * (m2 + 2 * m3) * c1, (2 * m2 + 6 * m3) * l2, 3 * m3 * l3 * c12],
            [-3 * c2, 3 * l2 * c12, 2 * l3],
        ]
    )
    s1, s2, s12 = np.sin(t1), np.sin(t2), np.sin(t1 - t2)
    right = np.array(
        [
            2 * (force - friction * speed) - (m2 + 2 * m3) * l2 * w1**2 * s1 - m3 * l3 * w2**2 * s2,
            3 * (m2 + 2 * m3) * GRAVITY * s1 - 3 * m3 * l3 * w2**2 * s12,
            3 * l2 * w1**2 * s12 + 3 * GRAVITY * s2,
        ]
    )
    return np.array([speed, *np.linalg.solve(left, right), w1, w2])


def integrate(rate, x: np.ndarray, forces: np.ndarray, dt: float = 0.1, **constants: float) -> np.ndarray:
    """States [H + 1, D] under forces [H, 1], each held for dt [s]."""
    states = [np.asarray(x, float)]
    for (force,) in np.asarray(forces, float):
        slope = lambda _, x, force=force: rate(x, force, **constants)  # noqa: E731
        states.append(solve_ivp(slope, (0, dt), states[-1], method="DOP853", rtol=1e-10, atol=1e-10).y[:, -1])
    return np.stack(states)


def energy(xs: np.ndarray) -> np.ndarray:
    """Mechanical energy [J] of states [T, D] of either cart-pole, from the rods' centres and turning."""
    double = xs.shape[1] == 6
    speed, rates, angles = xs[:, 1], xs[:, 2 : 4 if double else 3], xs[:, 4 if double else 3 :]
    # From the cart outwards: a rod points along (side sin, up cos), and its centre is half-way.
    side, up = (-1.0, 1.0) if double else (1.0, -1.0)
    vx, vz, height = speed.copy(), np.zeros_like(speed), np.zeros_like(speed)
    total = 0.5 * MASS * speed**2
    for w, a in zip(rates.T, angles.T, strict=True):
        dx, dz, rise = side * LENGTH * np.cos(a) * w, -up * LENGTH * np.sin(a) * w, up * LENGTH * np.cos(a)
        total += 0.5 * MASS * ((vx + dx / 2) ** 2 + (vz + dz / 2) ** 2) + MASS * GRAVITY * (height + rise / 2)
        total += 0.5 * MASS * LENGTH**2 / 12 * w**2
        vx, vz, height = vx + dx, vz + dz, height + rise
    return total
