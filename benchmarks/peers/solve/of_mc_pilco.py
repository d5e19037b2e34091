"""MC-PILCO (github.com/merlresearch/MC-PILCO, AGPL-3) from the user's checkout, imported as it is.

Its settings are those of its example test_mcpilco_cartpole.py: Gaussian processes with squared exponential and
polynomial kernels for the change of the rates, 200 basis functions, 400 particles, dropout, at most 2000 and then 4000
iterations. What is adapted: the plant, its period (.1 s for .05 s), horizon (2.5 s for 3 s) and start, and more trials
than five. Newer versions of PyTorch have no `torch.cholesky`, which it calls: it is put back.

A first episode is random, as in its program; then each search is followed by an episode, before which its policy is
judged. So is the policy in hand when the time is over, without its dropout.
"""

import sys
from collections.abc import Callable
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from benchmarks.peers.solve.attempt import Attempt

TRIALS, ANGLE = 50, 2


ORDER = [0, 1, 3, 2]  # its state: position, its rate, the angle (0 hanging), its rate


def system(attempt: Attempt) -> Any:
    """The plant in the place of its simulated system; the policy of every episode but the first is judged."""
    episodes = 0

    def rollout(s0: Any, policy: Callable, T: float, dt: float, noise: Any) -> tuple[np.ndarray, ...]:
        del s0, noise  # the plant's own
        nonlocal episodes
        if episodes:
            attempt.judged(lambda x: policy(x[ORDER], 0.0))
        episodes += 1
        x, _ = attempt.env.reset()
        states, controls = [x[ORDER]], []
        for step in range(round(T / dt)):
            controls.append(np.ravel(policy(states[-1], step * dt)))
            x, *_ = attempt.env.step(controls[-1].astype(np.float32))
            states.append(x[ORDER])
        controls.append(np.ravel(policy(states[-1], T)))  # its rollouts have one at the last state too
        whole = np.array(states, np.float64)
        return whole, np.array(controls, np.float64), whole

    return SimpleNamespace(rollout=rollout)


def processes(states: int, dt: float) -> dict[str, Any]:
    """The settings of its Gaussian processes, one for each rate, as its example begins them."""
    rates, inputs = list(range(1, states, 2)), states + 2
    usual = {"dtype": torch.float64, "device": torch.device("cpu")}
    dims = usual | {"active_dims": np.arange(inputs)}
    squared = {"lengthscales_init": np.ones(inputs), "flg_train_lengthscales": True, "lambda_init": np.ones(1)}
    squared |= {"flg_train_lambda": False, "sigma_n_init": np.ones(1), "flg_train_sigma_n": True, "sigma_n_num": None}
    weights = [np.ones(inputs + 1), np.ones(2 * inputs)]
    polynomial = {"poly_deg": 2, "Sigma_pos_par_init_list": weights, "flg_train_Sigma_pos_par_list": [True, True]}
    subset = {"SOD_threshold_mode": "relative", "SOD_threshold": 0.5, "flg_SOD_permutation": False}
    return usual | {
        "num_gp": len(rates),
        "T_sampling": dt,
        "angle_indeces": [ANGLE],
        "not_angle_indeces": [i for i in range(states) if i != ANGLE],
        "vel_indeces": rates,
        "not_vel_indeces": [i - 1 for i in rates],
        "approximation_mode": "SOD",
        "approximation_dict": subset,
        "init_dict_list": [[dims | squared, dims | polynomial]] * len(rates),
    }


def policy(states: int, limit: float, basis: int = 200) -> dict[str, Any]:
    """Those of its policy, whose centers and weights are drawn."""
    others, angle = [i for i in range(states) if i != ANGLE], 2 * np.pi * (np.random.rand(basis, 1) - 0.5)
    centres = [2 * np.pi * (np.random.rand(basis, len(others)) - 0.5), np.cos(angle), np.sin(angle)]
    return {
        "angle_indices": np.array([ANGLE]),
        "non_angle_indices": np.array(others),
        "num_basis": basis,
        "centers_init": np.concatenate(centres, 1),
        "lengthscales_init": np.ones(states + 1),
        "weight_init": limit * (np.random.rand(1, basis) - 0.5),
        "flg_squash": True,
        "flg_drop": True,
    }


def search(states: int, limit: float) -> dict[str, Any]:
    """Those of its search."""
    again = {"centers_par": np.array([np.pi] * (states - 1) + [1.0, 1.0]), "weight_par": limit}
    return {
        "num_particles": 400,
        "opt_steps_list": [2000] + [4000] * TRIALS,
        "lr_list": [0.01] * TRIALS,
        "f_optimizer": "lambda p, lr : torch.optim.Adam(p, lr)",
        "num_step_print": 100,
        "p_dropout_list": [0.25] * TRIALS,
        "p_drop_reduction": 0.25 / 2,
        "alpha_diff_cost": 0.99,
        "min_diff_cost": 0.08,
        "num_min_diff_cost": 200,
        "min_step": 200,
        "lr_min": 0.0025,
        "policy_reinit_dict": again | {"lenghtscales_par": np.ones(states + 1)},
    }


def learn(attempt: Attempt, program: str) -> None:
    """Learn until the attempt ends."""
    del program
    attempt.begin()
    sys.path.append(str(attempt.checkout))  # its modules are in no package
    likelihood = import_module("gpr_lib.Likelihood.Gaussian_likelihood").Marginal_log_likelihood
    import_module("gpr_lib.Utils.Parameters_covariance_functions")  # it uses that without importing it
    policies, package = import_module("policy_learning.Policy"), import_module("policy_learning.MC_PILCO")
    torch.cholesky = lambda matrix, upper=False: torch.linalg.cholesky(matrix, upper=upper)
    torch.manual_seed(attempt.seed)
    np.random.seed(attempt.seed)
    torch.set_num_threads(1)
    states, limit, dt = len(ORDER), float(attempt.env.action_space.high[0]), attempt.plant.dt  # type: ignore[attr-defined]
    sizes, span = {"state_dim": states, "input_dim": 1}, attempt.plant.horizon * dt
    theirs: Any = package.MC_PILCO(
        **sizes,
        T_sampling=dt,
        f_sim=None,
        f_model_learning=import_module("model_learning.Model_learning").Speed_Model_learning_RBF_MPK_angle_state,
        model_learning_par=processes(states, dt),
        f_rand_exploration_policy=policies.Random_exploration,
        rand_exploration_policy_par=sizes | {"u_max": limit},
        f_control_policy=policies.Sum_of_gaussians_with_angles,
        control_policy_par=sizes | {"u_max": limit} | policy(states, limit),
        f_cost_function=import_module("policy_learning.Cost_function").Cart_pole_cost,
        cost_function_par={
            "pos_index": 0,
            "angle_index": ANGLE,
            "target_state": torch.tensor([np.pi, 0.0], dtype=torch.float64),
            "lengthscales": torch.tensor([3.0, 1.0], dtype=torch.float64),
        },
    )
    theirs.system = system(attempt)
    attempt.at_end = lambda x: theirs.control_policy.forward_np(x[ORDER])
    fit = {"f_optimizer": "lambda p : torch.optim.Adam(p, lr = 0.01)", "criterion": likelihood}
    theirs.reinforce(
        initial_state=np.zeros(states),
        initial_state_var=np.full(states, 0.2**2),
        T_exploration=span,
        T_control=span,
        num_trials=TRIALS,
        model_optimization_opt_list=[fit | {"N_epoch": 1501, "N_epoch_print": 500}] * (states // 2),
        policy_optimization_dict=search(states, limit),
    )
