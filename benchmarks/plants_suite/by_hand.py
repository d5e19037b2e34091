"""Plants as a user writes them, in NumPy: held back, so no setting was chosen on them.

`gymnasium.make("benchmarks.plants_suite.by_hand:Quadrotor-v0")`. A reward is 1 minus the cost beside the plant.
"""

from abc import abstractmethod
from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.spaces import Box

from benchmarks.plants_suite.costs import saturating
from pegasus_jax.types import Array

LIMIT = 200  # periods of an episode, several times what a trial has


def quadrotor(x: Array) -> Array:
    """[x, z, pitch, their rates]: near the origin, level."""
    return saturating(x[0] / 0.5, x[1] / 0.5, x[2] / 0.5)


def ball_on_beam(x: Array) -> Array:
    """[ball, beam's angle, their rates]: the ball in the middle."""
    return saturating(x[0] / 0.1, x[1] / 0.5)


def four_tanks(x: Array) -> Array:
    """[four levels, cm]: 12 and 14 in the lower two."""
    return saturating((x[0] - 12) / 2, (x[1] - 14) / 2)


def car(x: Array) -> Array:
    """[x, y, heading, speed]: parked at the origin."""
    return saturating(x[0] / 0.5, x[1] / 0.3, x[2] / 0.4, x[3] / 0.5)


class ByHand(gymnasium.Env):
    """dx/dt of a state s [D] under a control u [U], by Runge-Kutta; what is observed is s and a little noise."""

    cost: Any
    dt: float
    noise: float
    low: list[float]
    high: list[float]
    start: tuple[list[float], list[float]]  # mean and standard deviation
    substeps = 5

    def __init__(self) -> None:
        self.observation_space = Box(-np.inf, np.inf, (len(self.start[0]),), np.float64)
        self.action_space = Box(np.float32(self.low), np.float32(self.high))
        self.costs = jax.jit(type(self).cost)

    @abstractmethod
    def rates(self, s: np.ndarray, u: np.ndarray) -> np.ndarray:
        """ds/dt [D]."""

    def within(self, s: np.ndarray) -> np.ndarray:
        """The state that stops let through [D]."""
        return s

    def observed(self) -> np.ndarray:
        """The state [D] with the sensors' noise."""
        return self.s + self.noise * self.np_random.normal(size=self.s.shape)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """Begin near the plant's start."""
        super().reset(seed=seed)
        self.s = self.within(self.np_random.normal(*self.start))
        return self.observed(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Hold a control for one period."""
        u, h = np.clip(np.asarray(action, float), self.low, self.high), self.dt / self.substeps
        for _ in range(self.substeps):
            k1 = self.rates(self.s, u)
            k2 = self.rates(self.s + h / 2 * k1, u)
            k3 = self.rates(self.s + h / 2 * k2, u)
            k4 = self.rates(self.s + h * k3, u)
            self.s = self.within(self.s + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4))
        return self.observed(), 1 - float(self.costs(self.s)), False, False, {}


class Quadrotor(ByHand):
    """A planar one of .5 kg, from about a meter away; two rotors of at most 6 N, .2 m from its middle."""

    cost, dt, noise, low, high = quadrotor, 0.05, 0.005, [0.0, 0.0], [6.0, 6.0]
    start = [0.0] * 6, [1.0, 1.0, 0.2, 0.1, 0.1, 0.1]

    def rates(self, s: np.ndarray, u: np.ndarray) -> np.ndarray:
        """ds/dt [6]."""
        lift, turn = sum(u) / 0.5, 0.2 * (u[1] - u[0]) / 0.01
        return np.array([*s[3:], -lift * np.sin(s[2]), lift * np.cos(s[2]) - 9.81, turn])


class BallOnBeam(ByHand):
    """A ball of .1 kg that rolls on a beam of 1 m, which a motor of 2 N m tilts by at most .6 rad."""

    cost, dt, noise, low, high = ball_on_beam, 0.05, 0.002, [-2.0], [2.0]
    start = [0.3, 0.0, 0.0, 0.0], [0.05, 0.05, 0.02, 0.02]

    def rates(self, s: np.ndarray, u: np.ndarray) -> np.ndarray:
        """ds/dt [4]."""
        p, a, v, w = s
        torque = u[0] - 0.2 * p * v * w - 0.981 * p * np.cos(a) - 0.05 * w
        return np.array([v, w, 5 / 7 * (p * w**2 - 9.81 * np.sin(a)) - 0.1 * v, torque / (0.05 + 0.1 * p**2)])

    def within(self, s: np.ndarray) -> np.ndarray:
        """At a stop a speed is 0."""
        held = np.clip(s[:2], (-0.5, -0.6), (0.5, 0.6))
        return np.concatenate([held, np.where(held == s[:2], s[2:], 0)])


class FourTanks(ByHand):
    """Johansson's four tanks (2000), minimum phase: two pumps of 10 V fill all, the upper two run into the lower."""

    cost, dt, noise, low, high = four_tanks, 5.0, 0.05, [0.0, 0.0], [10.0, 10.0]
    start, substeps = ([4.0] * 4, [1.0] * 4), 20

    def rates(self, s: np.ndarray, u: np.ndarray) -> np.ndarray:
        """ds/dt [4], cm/s."""
        area, hole = np.array([28, 32, 28, 32]), np.array([0.071, 0.057, 0.071, 0.057])
        out = hole * np.sqrt(2 * 981 * np.maximum(s, 0))
        first, second = 3.33 * u[0], 3.35 * u[1]
        filled = np.array([out[2] + 0.7 * first, out[3] + 0.6 * second, 0.4 * second, 0.3 * first])
        return (filled - out) / area

    def within(self, s: np.ndarray) -> np.ndarray:
        """A tank is not less than empty, and 25 cm high."""
        return np.clip(s, 0, 25)


class Car(ByHand):
    """One of .5 m between the axles, that parks 2 m ahead and 1 m beside: acceleration, and steering of .5 rad."""

    cost, dt, noise, low, high = car, 0.2, 0.01, [-1.0, -0.5], [1.0, 0.5]
    start = [-2.0, 1.0, 0.0, 0.0], [0.1, 0.1, 0.1, 0.02]

    def rates(self, s: np.ndarray, u: np.ndarray) -> np.ndarray:
        """ds/dt [4]."""
        heading, speed = s[2:]
        return np.array(
            [speed * np.cos(heading), speed * np.sin(heading), speed * np.tan(u[1]) / 0.5, u[0] - 0.1 * speed]
        )


for plant in (Quadrotor, BallOnBeam, FourTanks, Car):
    gymnasium.register(f"{plant.__name__}-v0", plant, max_episode_steps=LIMIT)
