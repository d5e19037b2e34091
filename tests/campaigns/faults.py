"""Costs and robots with a fault each, as a user may write them. A campaign copies this file and names them."""

import math
import sys

import gymnasium
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete
from robots import Arm, cost  # noqa: F401  (the cost is named by commands)


def in_numpy(x):
    return 1 - np.exp(-np.square(np.asarray(x))[0])


def in_math(x):
    return 1 - math.cos(x[0])


def branches(x):
    return 1.0 if abs(x[0]) > 0.1 else x[0] ** 2


def of_two(x, u):
    return jnp.tanh(x[0] ** 2 + u[0] ** 2)


def of_none():
    return 0.5


def nothing(x):
    x[0] ** 2


def text(x):
    return "cheap"


def pair(x):
    return x[0], x[1]


def raises(x):
    raise RuntimeError("not calibrated\nsecond line")


def leaves(x):
    sys.exit(7)


def asserts(x):
    assert x[0] < 100, "concrete"
    return jnp.tanh(x[0] ** 2)


def missing_key(x):
    return {"angle": x[0]}["rate"]


def vector(x):
    return jnp.tanh(x**2)


def reward(x):
    return jnp.cos(x[0]) - 1.5


def no_gradient(x):
    return jnp.where(x[0] > 1, 1.0, 0.0)


def constant(x):
    return jnp.float32(0.3)


def never_finite(x):
    return jnp.log(-jnp.abs(x[0]) - 1)


def gradient_nan(x):
    return jnp.tanh(jnp.sqrt(x[0] * 0))


def beyond_the_end(x):
    return jnp.tanh(x[5] ** 2)


def complex_number(x):
    return jnp.exp(1j * x[0])


number = 0.5


class OldReset(Arm):
    def reset(self, **_):
        return super().reset()[0]


class OldStep(Arm):
    def step(self, control):
        x, reward, ended, _, info = super().step(control)
        return x, reward, ended, info


class NoSeed(Arm):
    def reset(self):
        return super().reset()


class Gone(Arm):
    def __init__(self):
        open("/dev/no-such-port", "rb").close()


class Needs(Arm):
    def __init__(self, port):
        self.port = port


class Leaves(Arm):
    def __init__(self):
        sys.exit(3)


class NoFrames(Arm):
    metadata = {"render_fps": None}  # noqa: RUF012
    dt = property(lambda self: {}["dt"])


class PeriodIsMethod(Arm):
    def dt(self):
        return 0.05

    def move(self, u):
        self.x = self.x + 0.01


class NoPeriod(Arm):
    dt = 0.0

    def move(self, u):
        self.x = self.x + 0.01


class Columns(Arm):
    def seen(self):
        return self.x.reshape(2, 1)


class Longer(Arm):
    def seen(self):
        return np.append(self.x, 0.0)


class Nothing(Arm):
    def step(self, control):
        super().step(control)


class NoneSeen(Arm):
    def seen(self):
        return None


class Words(Arm):
    def seen(self):
        return ["left", "fast"]


class Infinite(Arm):
    def move(self, u):
        self.x = self.x * 1e200


class ResetRaises(Arm):
    def reset(self, **_):
        raise ConnectionError("no answer\nfrom the bus")


class StepLeaves(Arm):
    def step(self, control):
        sys.exit(9)


class Whole(Arm):
    action_space = Box(-5, 5, (1,), np.int32)


class Buttons(Arm):
    action_space = Discrete(3)


class Free(Arm):
    action_space = Box(-np.inf, np.inf, (1,), np.float32)


class Scalar(Arm):
    action_space = Box(-1, 1, (), np.float32)


class Stuck(Arm):
    action_space = Box(np.float32([2]), np.float32([2]), dtype=np.float32)


class Named(Arm):
    observation_space = Dict({"x": Box(-1, 1, (2,))})


class Picture(Arm):
    observation_space = Box(0, 255, (8, 8, 3), np.uint8)


class NoSpaces(gymnasium.Env):
    pass


class NotAnEnv:
    pass


FAULTS = [made for made in list(globals().values()) if isinstance(made, type) and made.__module__ == __name__]
for made in FAULTS:
    gymnasium.register(f"{made.__name__}-v0", made)
ROBOTS = [made.__name__ for made in FAULTS]
