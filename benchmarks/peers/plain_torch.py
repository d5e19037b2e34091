"""The search step as one would write it in PyTorch with some care: no loop over particles, no copies, the scaling
folded into the outer layers. It knows one model (a BNN whose masks are given) and one policy (a ReLU network with
binary dropout).
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import relu, silu

Layers = list[tuple[Tensor, Tensor]]  # (kernel [inputs, outputs], bias [outputs]) of each layer


class Problem(NamedTuple):
    """Everything about a search step but the policy and the noise."""

    model: Layers  # centered inputs -> change of state, raw noise std
    masks: list[Tensor]  # [K, width] of each hidden layer: one draw of the model a particle
    centre: Tensor  # [F + U] mean of the model's inputs
    target_scale: Tensor  # [D]
    activation: str  # of the model: silu or relu
    plain: list[int]  # dimensions of the state that are no angles
    angles: list[int]
    start_mean: Tensor  # [D]
    start_std: Tensor  # [D]
    low: Tensor  # [U]
    high: Tensor  # [U]
    goal: Tensor  # [F]
    keep: float  # probability that a unit of the policy stays
    horizon: int
    match: bool


class Draws(NamedTuple):
    """The noise of one iteration."""

    start: Tensor  # [K, D]
    policy: list[Tensor]  # [K, width] masks of each hidden layer
    sensor: Tensor  # [H, K, D]
    match: Tensor  # [H, K, D]


def encode(problem: Problem, x: Tensor) -> Tensor:
    """Features [K, F] of states [K, D]."""
    angle = x[:, problem.angles]
    return torch.cat([x[:, problem.plain], torch.sin(angle), torch.cos(angle)], 1)


def network(layers: Layers, masks: list[Tensor], activation: Callable[[Tensor], Tensor], h: Tensor) -> Tensor:
    """The last hidden layer, masked."""
    for (kernel, bias), mask in zip(layers[:-1], masks, strict=True):
        h = activation(torch.addmm(bias, h, kernel)) * mask
    return h


def tuned_relu(x: Tensor) -> Tensor:
    """max(x, 0) without the boolean mask that slows the compiled gradient down."""
    return 0.5 * (x + x.abs())


def step(
    problem: Problem,
    policy: Layers,
    masks: list[Tensor],
    x: Tensor,
    blur: Tensor,
    sensor: Tensor,
    redraw: Tensor,
    activate: Callable[[Tensor], Tensor] = relu,
) -> tuple[Tensor, Tensor, Tensor]:
    """One step of all particles: state, noise on it, and their mean cost."""
    kernel, bias = policy[-1]
    h = network(policy, masks, activate, encode(problem, x + blur))
    middle, half = (problem.high + problem.low) / 2, (problem.high - problem.low) / 2
    u = middle + half * torch.tanh(torch.addmm(bias, h, kernel))
    inputs = torch.cat([encode(problem, x), u], 1) - problem.centre
    h = network(problem.model, problem.masks, silu if problem.activation == "silu" else activate, inputs)
    kernel, bias = problem.model[-1]
    states = x.shape[1]
    x = x + torch.addmm(bias[:states], h, kernel[:, :states])
    with torch.no_grad():
        raw = torch.addmm(bias[states:], h, kernel[:, states:])
        blur = (0.1 * torch.sigmoid(raw) + 1e-6) * problem.target_scale * sensor
    if problem.match:
        mean = x.mean(0)
        centered = x - mean
        x = mean + redraw @ torch.linalg.cholesky_ex(centered.T @ centered / (len(x) - 1))[0].T
    error = encode(problem, x) - problem.goal
    return x, blur, 1 - torch.exp(-0.5 * (error * error).mean(1)).mean()


def objective(problem: Problem, policy: Layers, draws: Draws, one: Callable = step) -> Tensor:
    """Mean cost of K rollouts of H steps."""
    x, blur, total = draws.start, torch.zeros_like(draws.start), torch.zeros(())
    for t in range(problem.horizon):
        x, blur, cost = one(problem, policy, draws.policy, x, blur, draws.sensor[t], draws.match[t])
        total = total + cost
    return total / problem.horizon


def draw(problem: Problem, policy: Layers, particles: int) -> Draws:
    """Fresh noise for one iteration."""
    shape = (problem.horizon, particles, len(problem.start_mean))
    return Draws(
        problem.start_mean + problem.start_std * torch.randn(shape[1:]),
        [(torch.rand(particles, kernel.shape[1]) < problem.keep).float() for kernel, _ in policy[:-1]],
        torch.randn(shape),
        torch.randn(shape),
    )


def searcher(problem: Problem, policy: Layers, particles: int, rate: float, one: Callable = step) -> Callable[[], None]:
    """A function that does one search step: draw, roll out, differentiate, clip, Adam."""
    parameters = [leaf.clone().requires_grad_() for layer in policy for leaf in layer]
    layers = list(zip(parameters[::2], parameters[1::2], strict=True))
    optimizer = torch.optim.Adam(parameters, lr=rate)

    def search() -> None:
        optimizer.zero_grad(set_to_none=True)
        objective(problem, layers, draw(problem, layers, particles), one).backward()
        torch.nn.utils.clip_grad_norm_(parameters, 1.0)
        optimizer.step()

    return search
