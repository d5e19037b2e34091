"""Robots and costs that behave badly, as modules that a campaign writes into a folder. This file is copied there."""

import asyncio
import contextlib
import os
import signal
import sqlite3
import threading
import time

import gymnasium
import jax.numpy as jnp
import numpy as np

LOG = os.environ.get("ROBOT_LOG")
FAILS = int(os.environ.get("ROBOT_FAILS", "0"))  # the number of the step that raises, from 1


def note(what):
    """One line a call, with its time, at once in the file: what is there after a kill has happened."""
    if LOG:
        with open(LOG, "a") as file:
            file.write(f"{time.monotonic():.6f} {what} {threading.current_thread() is threading.main_thread()}\n")


def cost(x):
    return 1 - jnp.exp(-2 * (1 - jnp.cos(x[0])))


class Arm(gymnasium.Env):
    """A pendulum with a motor. Every other robot here is one with a fault."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-2.0, 2.0, (1,), np.float32)
    dt, pause, steps = 0.05, 0.02, 0

    def __init__(self):
        note("open")

    def reset(self, *, seed=None, options=None):
        note("reset")
        super().reset(seed=seed)
        self.x = np.array([np.pi, 0.0]) + self.np_random.normal(0, 0.05, 2)
        return self.seen(), {}

    def seen(self):
        return self.x.copy()

    def move(self, u):
        self.x = self.x + self.dt * np.array([self.x[1], 15 * np.sin(self.x[0]) + 5 * float(u)])

    def step(self, control):
        note("step")
        Arm.steps += 1
        time.sleep(self.pause)
        if Arm.steps == FAILS:
            note("fails")
            raise OSError("the motor driver does not answer")
        self.move(control[0])
        note("stepped")
        return self.seen(), 0.0, False, False, {}

    def close(self):
        note("close")


class Slow(Arm):
    pause = 0.25


class Swallows(Arm):
    """A driver whose bare except takes KeyboardInterrupt for a fault of the bus."""

    def step(self, control):
        with contextlib.suppress(BaseException):
            time.sleep(0.02)
        return super().step(control)


class Handlers(Arm):
    """A driver that has its own signal handlers, as ROS has."""

    def __init__(self):
        super().__init__()
        signal.signal(signal.SIGINT, lambda *_: None)
        signal.signal(signal.SIGTERM, lambda *_: None)


class Alarms(Arm):
    """A watchdog around each step."""

    def step(self, control):
        before = signal.signal(signal.SIGALRM, lambda *_: None)
        signal.setitimer(signal.ITIMER_REAL, 1.0)
        try:
            return super().step(control)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)


class Bound(Arm):
    """Objects that may be used in the thread only that made them."""

    def __init__(self):
        super().__init__()
        self.log, self.loop = sqlite3.connect(":memory:"), asyncio.new_event_loop()
        self.log.execute("create table log(u real)")

    def step(self, control):
        self.log.execute("insert into log values (?)", (float(control[0]),))
        self.loop.run_until_complete(asyncio.sleep(0))
        return super().step(control)


class InJax(Arm):
    def move(self, u):
        x = jnp.asarray(self.x)
        self.x = np.asarray(x + self.dt * jnp.stack([x[1], 15 * jnp.sin(x[0]) + 5 * u]), np.float64)


class Buffer(Arm):
    """Returns one array that it uses again."""

    held = np.zeros(2)

    def seen(self):
        self.held[:] = self.x
        return self.held


class InPlace(Arm):
    def step(self, control):
        control *= 0.5
        return super().step(control)


class Ends(Arm):
    """Ends its episodes itself, and takes no step after that."""

    def reset(self, **options):
        self.left = 8
        return super().reset(**options)

    def step(self, control):
        if not self.left:
            raise RuntimeError("a step after the end")
        self.left -= 1
        x, reward, _, _, info = super().step(control)
        return x, reward, not self.left, False, info


class Truncates(Ends):
    def step(self, control):
        x, reward, ended, _, info = super().step(control)
        return x, reward, False, ended, info


class Asks(Arm):
    def reset(self, **options):
        input("put the arm down, then press Enter ")
        return super().reset(**options)


class CloseRaises(Arm):
    def close(self):
        super().close()
        raise OSError("the port is gone")


class NaN(Arm):
    def step(self, control):
        _, *rest = super().step(control)
        return np.array([np.nan, 0.0]), *rest


GOOD = (Arm, Slow, Alarms, Bound, InJax, Buffer, InPlace, Ends, Truncates, CloseRaises, Swallows, Handlers)
for made in (*GOOD, Asks, NaN):
    gymnasium.register(f"{made.__name__}-v0", made)
