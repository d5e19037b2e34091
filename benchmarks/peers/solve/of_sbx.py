"""SBX's SAC and CrossQ (github.com/araffin/sbx, `pip install sbx-rl`, MIT), with their own defaults, as in its README.

What is adapted: the cart-pole's observation has the sine and the cosine of the angle in place of it, as the
environments have with which such programs are tried; the reward is the environment's. A policy is judged every
`EVERY` seconds of plant time, without its noise. On one core a step of CrossQ took 80 to 100 ms, one of SAC 9.
"""

from typing import Any

import gymnasium
import numpy as np
import sbx
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks.peers.solve.attempt import Attempt

EVERY = 10.0  # [s]


def seen(x: np.ndarray, angles: list[int]) -> np.ndarray:
    """An observation with the sines and the cosines of its angles at its end."""
    return np.concatenate([np.delete(x, angles), np.sin(x[angles]), np.cos(x[angles])]).astype(np.float32)


def learn(attempt: Attempt, program: str) -> None:
    """Learn until the attempt ends."""
    attempt.begin()
    angles = list(attempt.plant.angles)
    size = attempt.env.observation_space.shape[0] + len(angles)  # type: ignore[index]
    space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
    env = gymnasium.wrappers.TransformObservation(attempt.env, lambda x: seen(x, angles), space)
    model: Any = {"sac": sbx.SAC, "crossq": sbx.CrossQ}[program]("MlpPolicy", env, seed=attempt.seed)
    every = round(EVERY / attempt.plant.dt)

    class Judged(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps % every == 0:
                attempt.judged(lambda x: model.predict(seen(x, angles), deterministic=True)[0])
            return True

    model.learn(total_timesteps=10**9, callback=Judged())
