"""A Furuta pendulum that has two encoders and nothing else, with any delay: around the FurutaSafe-v0 of `robot.py`."""

import gymnasium
import numpy as np


class TwoEncoders(gymnasium.ObservationWrapper):
    """Arm and pendulum angle [rad]; controls act `delay` periods after they were sent."""

    def __init__(self, delay: int = 1) -> None:
        inner = gymnasium.make("robot:FurutaSafe-v0", disable_env_checker=True)
        super().__init__(inner)
        inner.unwrapped.rig.delay = delay  # type: ignore[attr-defined]
        self.dt, self.observation_space = inner.unwrapped.dt, gymnasium.spaces.Box(-np.inf, np.inf, (2,))  # type: ignore[attr-defined]

    def observation(self, observation: np.ndarray) -> np.ndarray:
        return observation[:2]


gymnasium.register("TwoEncoders-v0", TwoEncoders)
