"""prob_mbrl (github.com/mcgillmrl/prob_mbrl), the paper's authors' program, from a checkout, imported as it is.

Its settings are those of its example deep_pilco_mm.py. What is adapted: the plant; its horizon in imagination (25 or 40
periods for 15, which swings nothing up here) and its first episode (random; its default is its first policy). Its
cost is that of its own cart-pole or pendulum, with this plant's length of the pole. `load` says what is put back that
its Python and its PyTorch still had. Its policy draws its masks and its noise again in each period, also when judged.
"""

import contextlib
import io
from functools import partial
from typing import Any

import numpy as np
import torch

from benchmarks.peers.of_prob_mbrl import load
from benchmarks.peers.solve.attempt import Attempt

CART_POLE = 0.6  # length of the pole [m]


class Episodes:
    """The plant as an environment of the older gym, which its `apply_controller` drives."""

    def __init__(self, attempt: Attempt, to_complex: Any) -> None:
        self.env, self.dt, self.angles = attempt.env, attempt.plant.dt, list(attempt.plant.angles)
        self.to_complex = to_complex

    def seen(self, x: np.ndarray) -> np.ndarray:
        """An observation as its own environments give it: angles as sines, cosines."""
        return self.to_complex(torch.tensor(np.asarray(x, np.float64)), self.angles).numpy()

    def reset(self) -> np.ndarray:
        return self.seen(self.env.reset()[0])

    def step(self, u: np.ndarray) -> tuple[np.ndarray, float, bool, dict]:
        x, reward, terminated, truncated, _ = self.env.step(np.asarray(u, np.float32))
        return self.seen(x), float(reward), terminated or truncated, {}


def reward(x: torch.Tensor, u: torch.Tensor, cart: bool) -> torch.Tensor:
    """Its reward [K, 1] of encoded states [K, D] and controls [K, U]: of the tip's distance from upright, and of u."""
    if cart:  # position, its rate, the angle's rate, sine, cosine; 0 hanging
        distance = (x[:, 0] + CART_POLE * x[:, 3]) ** 2 + CART_POLE**2 * (x[:, 4] + 1) ** 2
        weighed = 16 * distance / (2 * CART_POLE) ** 2
    else:  # cosine, sine, rate; 0 upright, length 1
        weighed = (x[:, 0] - 1) ** 2 + x[:, 1] ** 2
    return torch.exp(-0.5 * (weighed + 1e-4 * (u**2).sum(1)))[:, None]


def learn(attempt: Attempt, program: str) -> None:
    """Learn until the attempt ends."""
    del program
    attempt.begin()
    package = load(attempt.checkout)  # type: ignore[arg-type]
    models, utils, horizon = package.models, package.utils, attempt.plant.horizon
    torch.set_num_threads(1)
    torch.manual_seed(attempt.seed)
    np.random.seed(attempt.seed)
    torch.set_flush_denormal(True)
    env = Episodes(attempt, utils.angles.to_complex)
    states, high = len(env.reset()), attempt.env.action_space.high  # type: ignore[attr-defined]
    model = models.mlp(
        states + 1, 2 * states, [200, 200], dropout_layers=[models.CDropout(0.1 * np.ones(200)) for _ in range(2)]
    )
    density = models.DiagGaussianDensity(states)
    cost = partial(reward, cart=states > 3)
    dynamics = models.DynamicsModel(model, reward_func=cost, output_density=density).float()
    noisy = partial(models.DiagGaussianDensity, 1)
    drops = [models.BDropout(0.1) for _ in range(2)]
    net = models.mlp(states, 2, [200, 200], dropout_layers=drops, output_nonlin=noisy)
    policy = models.Policy(net, high, -high).float()
    fitting = torch.optim.Adam(dynamics.parameters(), 1e-4)
    searching = torch.optim.Adam(policy.parameters(), 1e-3)
    data = utils.ExperienceDataset()

    def episode(control: Any) -> None:
        data.append_episode(*utils.apply_controller(env, control, horizon), policy_params=[])

    attempt.env.action_space.seed(attempt.seed)
    episode(lambda x, t: attempt.env.action_space.sample())
    while True:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            x, y = data.get_dynmodel_dataset(deltas=True)
            dynamics.set_dataset(x.float(), y.float())
            utils.train_regressor(dynamics, 2000, 100, True, fitting, log_likelihood=density.log_prob)
            first = data.sample_states(100, timestep=0).float()
            package.search(
                first,
                dynamics,
                policy,
                horizon,
                searching,
                data,
                1000,
                mm_states=True,
                mm_rewards=True,
                clip_grad=1.0,
                resampling_period=499,
                step_idx_to_sample=0,
                init_state_noise=1e-2 * first.std(0),
            )
        attempt.judged(lambda x: policy(env.seen(x)))
        episode(lambda x, t: policy(x))
