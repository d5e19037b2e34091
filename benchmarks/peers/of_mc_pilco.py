"""An adapter to MC-PILCO (github.com/merlresearch/MC-PILCO, AGPL-3), of which the user has a checkout: its policy
search on a workload of ours. Its modules are imported as they are; they are not part of this project.

It needs torch, of a version that still has `torch.cholesky` (2.13 does, with a warning).

What agrees: exact Gaussian processes with ARD squared exponential kernels, one for each dimension of the change of
state, of the same rows and hyperparameters; its sum of Gaussians, squashed by tanh, with the numbers of our RBF policy;
and the cost. Objective and gradient are compared, in float64 on both sides, of rollouts of the posterior mean from the
same states: the prior waves of our functions are zero, and its program predicts without noise. The gradient is by our
policy's parameters, to which its own is taken back. The posterior's standard deviations at the first states are
compared too. The processes are smooth ones, not fitted: see `comparable`.

What differs: its program draws every change of state of every particle afresh, with the posterior's variance there,
through which its gradient goes as well; a particle of ours follows one function, drawn at the start of a run and every
`search.period.dynamics` iterations. So the particles' states have the same distribution after one step and others
later. Its numbers are float64, as in its examples; ours are timed in float32 and in float64. Its gradient is not
clipped, its policy is asked at the last state too, and its run begins with one more rollout, without a gradient. The
timing therefore compares a step of each program's own search on the same problem, not the same arithmetic. Left out on
its side: the subset of the data and the dropout of its examples.
"""

import contextlib
import io
import sys
import types
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch
from jax.flatten_util import ravel_pytree
from torch import Tensor

from benchmarks.speed.suite import widened
from benchmarks.speed.workloads import EPISODES, Workload, goal, workload
from pegasus_jax.pilco import kernels
from pegasus_jax.pilco.gp import Posterior
from pegasus_jax.pilco.kernels import inputs_of
from pegasus_jax.pilco.rbf import regress
from pegasus_jax.task import Task
from pegasus_jax.types import Array, Params

# What makes a size comparable: a model and a policy that both have, each particle's own cost, room for the rows alone.
SETTINGS = {
    "model": "gp",
    "policy": "rbf",
    "policy.squash": "tanh",
    "search.matching": "never",
    "search.cost_estimator": "particles",
    "search.cost_width_start": "1",
    "trials": str(EPISODES),
}


def load(checkout: Path) -> types.SimpleNamespace:
    """The parts of the program that are used. Raises FileNotFoundError where it is not."""
    if not (checkout / "policy_learning" / "MC_PILCO.py").is_file():
        raise FileNotFoundError(f"{checkout} is not a checkout of MC-PILCO")
    sys.path.append(str(checkout.resolve()))  # its modules are in no package
    return types.SimpleNamespace(
        program=import_module("policy_learning.MC_PILCO").MC_PILCO,
        policy=import_module("policy_learning.Policy").Sum_of_gaussians_with_angles,
        cost=import_module("policy_learning.Cost_function").Expected_cost,
        model=import_module("model_learning.Model_learning").Model_learning_RBF_angle_state,
    )


def comparable(words: dict[str, str], horizon: int | None = None) -> Workload:
    """The workload of these words, `SETTINGS` among them, its length scales set to 4 standard deviations of the data.

    Processes fitted to the made-up data follow its noise, and rollouts of them are chaotic: no program has their
    gradient right.
    """
    work = workload(words, horizon)
    params = kernels.start(len(work.task.state_names), work.posterior.x.shape[1])
    params |= {"log_lengthscale": params["log_lengthscale"] + np.log(4)}
    return of_the_mean(work._replace(state=work.state._replace(model=work.state.model._replace(params=params))))


def in_double(work: Workload) -> Workload:
    """The same in float64, where JAX has that."""
    state, scenarios = jax.tree.map(widened, (work.state, work.scenarios))
    return of_the_mean(work._replace(state=state, scenarios=scenarios))


def of_the_mean(work: Workload) -> Workload:
    """The workload with its model's posterior mean as the function of every particle, and no sensor noise."""
    posterior = jax.jit(work.experiment.dynamics.posterior)(work.state.model.params, work.state.data)
    draws, sensor = work.scenarios.dynamics, work.scenarios.sensor
    correction = jnp.broadcast_to(posterior.beta, draws.correction.shape)
    mean = draws._replace(weights=jnp.zeros_like(draws.weights), correction=correction)
    return work._replace(
        posterior=posterior, scenarios=work.scenarios._replace(dynamics=mean, sensor=jnp.zeros_like(sensor))
    )


def tensor(array: Any) -> Tensor:
    """A copy of an array, in PyTorch."""
    return torch.tensor(np.asarray(array, np.float64))


def dimensions(task: Task) -> tuple[list[int], list[int]]:
    """Those of the state that are no angles, and those that are."""
    return [i for i in range(len(task.state_names)) if i not in task.angles], list(task.angles)


def of_goal(task: Task) -> Callable[[Tensor, Any, Any], Tensor]:
    """The workload's cost [H, K] of states [H + 1, K, D], over H: its program adds steps up, and counts the first."""
    (plain, angles), target = dimensions(task), tensor(goal(task))

    def costs(x: Tensor, u: Any, trial: Any) -> Tensor:
        del u, trial
        x = x[1:]
        error = torch.cat([x[..., plain], x[..., angles].sin(), x[..., angles].cos()], -1) - target
        return (1 - torch.exp(-0.5 * (error * error).mean(-1))) / task.horizon

    return costs


def of_policy(params: Params, task: Task) -> dict[str, Array]:
    """The parameters of its policy, of cosines before sines and exp(-d^2 / l^2), that make it ours."""
    lengthscales, weights = regress(params)
    plain, angles = map(len, dimensions(task))
    order = np.r_[:plain, plain + angles : plain + 2 * angles, plain : plain + angles]
    return {
        "log_lengthscales": jnp.log(2**0.5 * lengthscales[:, order]),
        "centers": params["centres"][:, order],
        "f_linear.weight": jnp.asarray(task.control_high)[:, None] * weights,
    }


def of_processes(posterior: Posterior) -> list[dict[str, Any]]:
    """The settings of its processes, in raw units and of exp(-d^2 / l^2), that make them ours."""
    h, (inputs, targets) = jax.tree.map(np.asarray, (posterior.hyper, posterior.scaling))
    scale = np.diagonal(targets.root)
    columns = {
        "lengthscales_init": 2**0.5 * h.lengthscale * np.diagonal(inputs.root),
        "lambda_init": (h.signal * scale)[:, None] ** 2,
        "sigma_n_init": (h.noise * scale)[:, None],
        "mean_init": targets.mean[:, None],
    }
    dims = {"active_dims": np.arange(h.lengthscale.shape[1])}
    return [dims | {name: column[i] for name, column in columns.items()} for i in range(len(scale))]


def program(package: Any, work: Workload, policy: dict[str, Array]) -> Any:
    """Its program with our processes, rows, policy and cost. Raises ValueError for more controls than one, between
    which its policy shares length scales."""
    task, rows = work.task, int(work.state.data.size)
    x, u, y = (tensor(column[:rows]) for column in work.state.data[:3])
    if u.shape[1] > 1:
        raise ValueError(f"task={task.name} has {u.shape[1]} controls; MC-PILCO's policy is ours for 1 only")
    plain, angles = dimensions(task)
    sizes = {"state_dim": x.shape[1], "input_dim": u.shape[1]}
    of_model = dict(num_gp=x.shape[1], init_dict_list=of_processes(work.posterior))
    of_control = dict(num_basis=len(policy["centers"]), flg_squash=True, u_max=float(task.control_high[0]))
    arrays = dict(angle_indices=np.asarray(angles), non_angle_indices=np.asarray(plain))
    with contextlib.redirect_stdout(io.StringIO()):
        theirs = package.program(
            **sizes,
            T_sampling=1.0,
            f_sim=None,
            f_model_learning=package.model,
            model_learning_par=of_model | dict(angle_indeces=angles, not_angle_indeces=plain),
            f_rand_exploration_policy=dict,
            rand_exploration_policy_par={},
            f_control_policy=package.policy,
            control_policy_par=sizes | of_control | arrays,
            f_cost_function=package.cost,
            cost_function_par=dict(cost_function=of_goal(task)),
        )
        theirs.control_policy.load_state_dict({name: tensor(value) for name, value in policy.items()})
        model = theirs.model_learning
        model.gp_inputs, model.gp_output_list = model.data_to_gp_input(x, u), list(y.split(1, dim=1))
        with torch.no_grad():
            for i in range(model.num_gp):
                model.pretrain_gp(i)
        model.set_eval_mode()
    return theirs


def start(mean: Tensor, std: Tensor, particles: int) -> dict[str, Any]:
    """Where its rollouts start: so many particles of a normal distribution."""
    return dict(
        num_particles=particles,
        particles_initial_state_mean=mean,
        particles_initial_state_var=std**2,
        flg_particles_init_uniform=False,
        particles_init_up_bound=None,
        particles_init_low_bound=None,
        flg_particles_init_multi_gauss=False,
    )


def disagreement(package: Any, work: Workload) -> dict[str, float]:
    """How far its objective and gradient are from ours, and its standard deviations of the first step, both relative
    but the objective. Of a workload `in_double`, where JAX has that."""
    task, params, posterior = work.task, work.state.policy.params, work.posterior
    x = work.scenarios.start
    ours, gradient = jax.jit(jax.value_and_grad(work.objective))(params, posterior, work.scenarios)
    inputs = inputs_of(x, jax.vmap(work.experiment.policy.apply, (None, None, 0))(params, None, x), task.angles)
    moments: Any = work.experiment.dynamics.moments  # a Gaussian process has them
    image = jax.vmap(moments, (None, 0, None))(posterior, inputs, jnp.zeros((inputs.shape[1],) * 2))

    policy, back = jax.vjp(partial(of_policy, task=task), params)
    theirs = program(package, work, policy)
    model, first = theirs.model_learning, tensor(x)
    with torch.no_grad():
        _, _, variance = model.get_next_state(first, theirs.control_policy(first))
    model.get_next_state = partial(model.get_next_state, particle_pred=False)
    # One particle, whose mean is all of ours; a normal distribution needs some spread.
    begin = start(first, torch.full_like(first[0], 1e-16), particles=1)
    cost, _ = theirs.cost_function(*theirs.apply_policy(**begin, T_control=task.horizon + 1))
    cost.backward()
    (taken,) = back({name: jnp.asarray(theirs.control_policy.get_parameter(name).grad.numpy()) for name in policy})
    flat, other = (ravel_pytree(tree)[0] for tree in (gradient, taken))
    return {
        "objective": abs(float(ours) - cost.item()),
        "gradient": float(jnp.linalg.norm(flat - other) / jnp.linalg.norm(flat)),
        "std": float(jnp.max(jnp.abs(variance.numpy() / jnp.diagonal(image.cov, axis1=1, axis2=2) - 1)) / 2),
    }


def search(package: Any, work: Workload, steps: int) -> Callable[[], None]:
    """Its `reinforce_policy` of so many steps, silent, on a workload `in_double`, where JAX has that."""
    config: Any = work.config.search
    task = work.task
    theirs = program(package, work, of_policy(work.state.policy.params, task))
    options = start(tensor(task.start_mean), tensor(task.start_std), config.particles) | dict(
        T_control=task.horizon + 1,  # states, the first included
        trial_index=0,
        opt_steps_list=[steps],
        lr_list=[config.learning_rate],
        f_optimizer="lambda p, lr: torch.optim.Adam(p, lr)",
    )

    def run() -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            theirs.reinforce_policy(**options)

    return run
