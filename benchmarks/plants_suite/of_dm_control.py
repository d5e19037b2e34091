"""dm_control's swing-ups as Gymnasium environments: joints as observations, and its own reward, start and time limit.

Needs the package dm_control (`pip install pegasus-jax[suite]`); none of its code is here. `gymnasium.make(
"benchmarks.plants_suite.of_dm_control:dm_control/CartPole-v0")`.
"""

from typing import Any

import gymnasium
import numpy as np
from dm_control import suite
from gymnasium.spaces import Box


class DmControl(gymnasium.Env):
    """One task of the suite, whose control is held for `repeat` of its own control steps.

    An observation is the positions of the joints and then their rates [D]; a step's reward is the sum of theirs.
    """

    def __init__(self, domain: str, task: str, repeat: int) -> None:
        self.domain, self.task, self.repeat = domain, task, repeat
        self.env: Any = suite.load(domain, task)
        limits, physics = self.env.action_spec(), self.env.physics
        self.action_space = Box(limits.minimum.astype(np.float32), limits.maximum.astype(np.float32))
        self.observation_space = Box(-np.inf, np.inf, (physics.model.nq + physics.model.nv,), np.float32)
        self.metadata = {"render_fps": round(1 / (repeat * self.env.control_timestep()))}
        self.dt = repeat * self.env.control_timestep()

    def observed(self) -> np.ndarray:
        """The joints' positions, then their rates [D]."""
        data = self.env.physics.data
        return np.concatenate([data.qpos, data.qvel]).astype(np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """Start as the suite does. A seed is that of its random numbers."""
        super().reset(seed=seed)
        if seed is not None:
            self.env = suite.load(self.domain, self.task, task_kwargs={"random": seed})
        self.env.reset()
        return self.observed(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Hold a control for `repeat` steps of the suite's."""
        total = 0.0
        for _ in range(self.repeat):
            now = self.env.step(action)
            total += float(now.reward or 0)
            if now.last():
                break
        return self.observed(), total, False, now.last(), {}


PLANTS = {
    "dm_control/CartPole-v0": dict(domain="cartpole", task="swingup", repeat=10),
    "dm_control/Pendulum-v0": dict(domain="pendulum", task="swingup", repeat=5),
}
for name, arguments in PLANTS.items():
    gymnasium.register(name, DmControl, kwargs=arguments)
