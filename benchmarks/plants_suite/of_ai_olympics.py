"""The AI-Olympics' two arms of two links with one motor as Gymnasium environments, in the organizers' own simulator.

Needs a checkout of github.com/dfki-ric-underactuated-lab/double_pendulum on the Python path (its folder src/python),
with matplotlib and pyyaml; none of its code is here. `gymnasium.make(
"benchmarks.plants_suite.of_ai_olympics:ai_olympics/Pendubot-v0")`.
"""

from pathlib import Path

import double_pendulum
import gymnasium
import numpy as np
from double_pendulum.model.model_parameters import model_parameters
from double_pendulum.model.plant import DoublePendulumPlant
from double_pendulum.simulation.simulation import Simulator
from gymnasium.spaces import Box

# Of the second leaderboard in simulation: design, motor, time step and length of a run.
PARAMETERS = "data/system_identification/identified_parameters/design_C.1/model_1.0/model_parameters.yml"
TORQUE, STEP, SECONDS = 6.0, 0.002, 10.0
PERIOD = 0.04  # a control is held for so long [s]
START = 0.02  # deviation of the first state, which is 0 there
LINE = 0.9  # of the whole length: who is above has swung up


class TwoLinks(gymnasium.Env):
    """[2 angles, 2 rates], 0 hanging, the second angle relative; the torque of motor 0 (pendubot) or 1 (acrobot).

    The return of an episode is for how many periods the tip has been above the line when the 10 s end.
    """

    def __init__(self, motor: int) -> None:
        root = Path(double_pendulum.__file__).parents[3]
        parameters = model_parameters(filepath=str(root / PARAMETERS))
        parameters.set_motor_inertia(0.0)
        parameters.set_damping([0.0, 0.0])
        parameters.set_cfric([0.0, 0.0])
        self.simulator, self.motor = Simulator(DoublePendulumPlant(model_pars=parameters)), motor
        self.observation_space = Box(-np.inf, np.inf, (4,), np.float64)
        self.action_space = Box(-TORQUE, TORQUE, (1,), np.float32)
        self.metadata = {"render_fps": round(1 / PERIOD)}
        self.dt = PERIOD

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """Hang, at rest."""
        super().reset(seed=seed)
        self.periods = self.above = 0
        self.simulator.reset()
        self.simulator.set_state(0.0, START * self.np_random.normal(size=4))
        return self.simulator.x.copy(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Hold a torque for a period."""
        torque = np.zeros(2)
        torque[self.motor] = np.clip(action[0], -TORQUE, TORQUE)
        for _ in range(round(PERIOD / STEP)):
            self.simulator.step(torque, STEP)
        plant, before, x = self.simulator.plant, self.above, self.simulator.x.copy()
        height = plant.forward_kinematics(x[:2])[1][1]
        self.above = before + 1 if height > LINE * sum(plant.l) else 0
        self.periods += 1
        return x, float(self.above - before), False, self.periods * PERIOD >= SECONDS - 1e-9, {}


gymnasium.register("ai_olympics/Pendubot-v0", TwoLinks, kwargs=dict(motor=0))
gymnasium.register("ai_olympics/Acrobot-v0", TwoLinks, kwargs=dict(motor=1))
