"""An adapter to prob_mbrl (github.com/mcgillmrl/prob_mbrl), the method's authors' PyTorch code, of which the user has
a checkout: its search and its fit on a workload of ours. Its package is used as it is; it is not part of this project.

It needs torch and tqdm. What the package imports and this does not use (Gym environments) is left out, and what its
Python or its PyTorch still had (`collections.Iterable`, `torch.cholesky`) is put back.

Its rollout and ours are one computation except for where noise and cost enter, so the states are compared, of the same
weights, masks and draws: its model's noise moves the state where ours blurs what the policy sees (both are 0 in the
comparison), it standardizes the draws of the moment matching and rolls them over the particles from step to step (given
to ours in that form), and it takes the cost before the moment matching (both objectives here are of the states after).
"""

import collections
import collections.abc
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
from torch import Tensor

from benchmarks.peers.plain_torch import Layers
from benchmarks.speed.workloads import Workload, goal
from pegasus_jax.imagine import costs as cost
from pegasus_jax.imagine import matching
from pegasus_jax.imagine.objective import objective
from pegasus_jax.imagine.rollout import NoiseUse
from pegasus_jax.math.angles import encode

Tensors = Callable[[Any], Tensor]


def load(checkout: Path) -> types.SimpleNamespace:
    """The parts of the package that are used. Raises FileNotFoundError where it is not."""
    root = checkout / "prob_mbrl"
    if not (root / "algorithms" / "mc_pilco.py").is_file():
        raise FileNotFoundError(f"{checkout} is not a checkout of prob_mbrl")
    collections.Iterable = collections.abc.Iterable  # type: ignore[attr-defined]
    Tensor.cholesky = lambda matrix: torch.linalg.cholesky(matrix)  # type: ignore[attr-defined]
    for name, folder in {"": root, ".algorithms": root / "algorithms"}.items():
        package = types.ModuleType(f"prob_mbrl{name}")
        package.__path__ = [str(folder)]
        sys.modules[package.__name__] = package
    sys.modules["prob_mbrl.envs"] = types.ModuleType("prob_mbrl.envs")
    for name in ("envs", "utils", "models"):
        setattr(sys.modules["prob_mbrl"], name, import_module(f"prob_mbrl.{name}"))
    return types.SimpleNamespace(
        models=import_module("prob_mbrl.models"),
        utils=import_module("prob_mbrl.utils"),
        search=import_module("prob_mbrl.algorithms.mc_pilco").mc_pilco,
    )


def of_goal(work: Workload, tensor: Tensors) -> Callable[[Tensor, Any], Tensor]:
    """The workload's cost of states [K, D]; the controls cost nothing."""
    task, target = work.task, tensor(goal(work.task))
    plain, angles = [i for i in range(len(task.state_names)) if i not in task.angles], list(task.angles)

    def costs(x: Tensor, u: Any) -> Tensor:
        del u
        error = torch.cat([x[:, plain], x[:, angles].sin(), x[:, angles].cos()], 1) - target
        return 1 - torch.exp(-0.5 * (error * error).mean(1, keepdim=True))

    return costs


def filled(net: Any, layers: Layers, masks: list[Tensor]) -> Any:
    """A network of the package with our weights and masks in it; no mask is divided by its mean."""
    linear = [module for module in net if isinstance(module, torch.nn.Linear)]
    for module, (kernel, bias) in zip(linear, layers, strict=True):
        module.weight.data, module.bias.data = kernel.T.contiguous(), bias.clone()
    noisy = [module for module in net if hasattr(module, "noise")]
    for module, mask in zip(noisy, masks, strict=True):
        module.noise.data, module.p.data = mask, torch.ones(())
    return net


def seeing(module: Any, angles: list[int]) -> Any:
    """The package's model or policy, which encodes these angles; as a tensor, its newest version cannot take them."""
    del module.angle_dims
    module.angle_dims = angles
    return module


def agents(package: Any, work: Workload, layers_of: Callable[[Any], Layers], tensor: Tensors) -> tuple[Any, Any]:
    """(dynamics, policy) of the package that compute what ours do."""
    task, given, keep = work.task, work.scenarios, 1.0 - work.config.policy.dropout
    states, controls, angles = len(task.state_names), len(task.control_names), list(task.angles)
    # Its encoded input is (plain states, controls, sines, cosines), ours (plain states, sines, cosines, controls).
    plain = states - len(angles)
    order = [*range(plain), *range(work.features, work.features + controls), *range(plain, work.features)]
    layers = layers_of(work.posterior.network)
    layers[0] = (layers[0][0][order], layers[0][1])
    nonlinear = {"silu": package.models.Swish, "relu": torch.nn.ReLU, "tanh": torch.nn.Tanh}

    def net(inputs: int, outputs: int, hidden: tuple[int, ...], nonlin: Any, rate: float) -> Any:
        drops = [package.models.BDropout(rate) for _ in hidden]
        return package.models.mlp(inputs, outputs, list(hidden), nonlin, dropout_layers=drops)

    model = net(
        work.features + controls, 2 * states, work.config.model.hidden, nonlinear[work.config.model.activation], 0.1
    )
    dynamics = package.models.DynamicsModel(
        filled(model, layers, [tensor(mask) for mask in given.dynamics[1:]]),
        reward_func=of_goal(work, tensor),
        output_density=package.models.DiagGaussianDensity(states),
    ).float()
    dynamics.mx.data = tensor(work.posterior.scaling.inputs.mean)[order][None]
    for name in ("iSx", "Sy"):
        getattr(dynamics, name).data = torch.ones(1, 1)
    dynamics.output_density.z.data = torch.zeros(work.config.search.particles, states)
    policy = package.models.Policy(
        filled(
            net(work.features, controls, work.config.policy.hidden, torch.nn.ReLU, 1 - keep),
            layers_of(work.state.policy.params["network"]),
            [tensor(z < keep) for z in given.policy],
        ),
        np.asarray(task.control_high, np.float32),
        np.asarray(task.control_low, np.float32),
    ).float()
    return seeing(dynamics, angles), seeing(policy, angles)


def disagreement(package: Any, work: Workload, layers_of: Callable[[Any], Layers], tensor: Tensors) -> dict[str, float]:
    """How far its states, the objective of them and its gradient are from ours."""
    task, config = work.task, work.config
    z = np.asarray(work.scenarios.match[0])
    z = (z - z.mean(0)) / z.std(0, ddof=1)
    rolled = np.stack([np.roll(z, -t, axis=0) for t in range(task.horizon)])
    given = work.scenarios._replace(match=jnp.asarray(rolled))
    match = matching.keep if config.search.matching == "never" else matching.match
    value = partial(
        objective,
        dynamics=work.experiment.dynamics,
        policy=work.experiment.policy,
        match=match,
        cost=cost.of_particles(task.cost),
        noise=NoiseUse(policy=0.0),
    )
    ours, gradient = jax.jit(jax.value_and_grad(value))(work.state.policy.params, work.posterior, given)
    dynamics, policy = agents(package, work, layers_of, tensor)
    dynamics.eval()
    states, _, _ = package.utils.rollout(
        tensor(given.start),
        dynamics,
        policy,
        task.horizon,
        resample_state_noise=False,
        resample_action_noise=False,
        mm_states=config.search.matching != "never",
        z_mm=tensor(z),
    )
    theirs = torch.stack([of_goal(work, tensor)(x, None) for x in states[1:]]).mean()
    theirs.backward()
    linear = [module for module in policy.model if isinstance(module, torch.nn.Linear)]
    pairs = [
        (ours_leaf.numpy(), leaf.grad.numpy())
        for (kernel, bias), module in zip(layers_of(gradient["network"]), linear, strict=True)
        for ours_leaf, leaf in ((kernel.T, module.weight), (bias, module.bias))
    ]
    difference, size = (np.sqrt(sum(np.sum(f(a, b) ** 2) for a, b in pairs)) for f in (np.subtract, lambda a, _: a))
    return {"objective": abs(float(ours) - theirs.item()), "gradient": float(difference / size)}


def programs(
    package: Any, work: Workload, layers_of: Callable[[Any], Layers], tensor: Tensors, steps: int, fit_steps: int
) -> dict[str, Callable[[], None]]:
    """Its `mc_pilco` and `train_regressor`, each of so many steps, silent."""
    dynamics, policy = agents(package, work, layers_of, tensor)
    config, data, rows = work.config, work.state.data, int(work.state.data.size)
    searching = torch.optim.Adam(policy.parameters(), lr=config.search.learning_rate)
    start = tensor(work.scenarios.start)

    def search() -> None:
        # as in its example, deep_pilco_mm.py, but for the moment matching of the costs, which ours has not
        with contextlib.redirect_stderr(io.StringIO()):
            options: dict[str, Any] = dict(
                mm_states=config.search.matching != "never", maximize=False, clip_grad=config.search.grad_clip
            )
            package.search(start, dynamics, policy, work.task.horizon, searching, None, steps, **options)

    states, models = len(work.task.state_names), package.models
    drops = [models.CDropout(0.1 * np.ones(width)) for width in config.model.hidden]
    net = models.mlp(
        work.features + len(work.task.control_names), 2 * states, list(config.model.hidden), dropout_layers=drops
    )
    density = models.DiagGaussianDensity(states)
    fitted = models.DynamicsModel(net, output_density=density).float()
    inputs = jnp.concatenate([encode(data.x, work.task.angles), data.u], 1)  # its fit would encode them twice
    fitted.set_dataset(tensor(inputs[:rows]), tensor(data.y[:rows]))
    fitting = torch.optim.Adam(fitted.parameters(), 1e-4)

    def fit() -> None:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            options: dict[str, Any] = dict(optimizer=fitting, log_likelihood=density.log_prob)
            package.utils.train_regressor(fitted, fit_steps - 1, config.fit.batch_size, **options)

    return {"search": search, "fit": fit}
