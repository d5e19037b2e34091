"""A robot of your own: a Gymnasium environment with a cost. It learns by command; its controller is a function.

    pegasus-train task=gym env=own_robot:Arm-v0 cost=own_robot:cost angles=[0] start_mean=[3.14,0] start_std=[0.05] \
        horizon=60 trials=8 explore.kind=walk eval_episodes=0 out=runs/arm
    python own_robot.py runs/arm

An arm hangs down, and its motor is too weak to lift it at once. Put your drivers in place of the simulation.
"""

import sys

import gymnasium
import jax.numpy as jnp
import numpy as np

import pegasus_jax as pg


class Arm(gymnasium.Env):
    """Observes the angle [rad], 0 upright, and its rate [rad/s]; is driven by a torque [N m]."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,))
    action_space = gymnasium.spaces.Box(-2.0, 2.0, (1,))
    dt = 0.05  # control period [s]
    gravity, inertia, substeps = 3.0, 0.2, 10  # m g l [N m], m l^2 [kg m^2], steps of integration a control period

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.angle, self.rate = np.array([np.pi, 0.0]) + self.np_random.normal(0, 0.05, 2)
        return self.read(), {}

    def step(self, control):
        for _ in range(self.substeps):
            self.rate += self.dt / self.substeps * (self.gravity * np.sin(self.angle) + control[0]) / self.inertia
            self.angle += self.dt / self.substeps * self.rate
        return self.read(), 0.0, False, False, {}  # the reward is not used: the cost below is

    def read(self):
        return np.array([self.angle, self.rate]) + self.np_random.normal(0, 0.01, 2)


gymnasium.register("Arm-v0", Arm)


def cost(x):
    """Of one observation [2]: 0 upright, near 1 hanging. In JAX, because the search differentiates it."""
    return 1 - jnp.exp(-2 * (1 - jnp.cos(x[0])))


def main(run: str) -> None:
    """One more episode, driven by the policy of the run that did best."""
    control = pg.controller(run)
    arm = Arm()
    x, _ = arm.reset(seed=1)
    control.reset()
    for t in range(60):
        x = arm.step(control(x))[0]
        if t % 6 == 5:
            print(f"{(t + 1) * arm.dt:.1f} s  angle {(x[0] + np.pi) % (2 * np.pi) - np.pi:+.2f}  cost {cost(x):.2f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
