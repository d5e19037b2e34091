"""Our search step and plain PyTorch's, in turn in one process, once they agree on the objective and its gradient.

    taskset -c 0 python -m benchmarks.peers.compare [sizes=cart-pole,...] [repeats=5] [compile=true] [setting=value ...]

Needs the extra `peers`. Pin it to as many CPUs as you ask `threads=` for: nothing else holds XLA to one. `compile=true`
adds torch.compile of a time step, tuned by hand (a C++ compiler and a minute are needed). Sizes are in `workloads`.
"""

import json
import shlex
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch
from torch import Tensor

from benchmarks.peers import plain_torch
from benchmarks.timing import compiled, in_turn, own_products, summary
from benchmarks.workloads import SIZES, Workload, goal, workload
from pegasus_jax import settings
from pegasus_jax.record import about

RESULTS = Path(__file__).parents[1] / "results"
STEPS = 10  # search steps in one timed run


def tensor(array: Any) -> Tensor:
    """A copy of an array, in PyTorch."""
    return torch.tensor(np.asarray(array, np.float32))


def layers_of(network: Any) -> plain_torch.Layers:
    """The layers of a flax network of ours."""
    layers = [network["params"][f"layer_{i}"] for i in range(len(network["params"]))]
    return [(tensor(layer["kernel"]), tensor(layer["bias"])) for layer in layers]


def problem_of(work: Workload) -> plain_torch.Problem:
    """The same search step for PyTorch."""
    task, scaling = work.task, work.belief.scaling
    return plain_torch.Problem(
        model=layers_of(work.belief.network),
        masks=[tensor(mask) for mask in work.scenarios.dynamics[1:]],
        centre=tensor(scaling.inputs.mean),
        target_scale=tensor(jnp.diagonal(scaling.targets.root)),
        activation=work.config.model.activation,
        plain=[i for i in range(len(task.state_names)) if i not in task.angles],
        angles=list(task.angles),
        start_mean=tensor(task.start_mean),
        start_std=tensor(task.start_std),
        low=tensor(task.control_low),
        high=tensor(task.control_high),
        goal=tensor(goal(task)),
        keep=1.0 - work.config.policy.dropout,
        horizon=task.horizon,
        match=work.config.search.match,
    )


def disagreement(work: Workload, problem: plain_torch.Problem, one: Callable) -> tuple[float, float]:
    """Difference of the two objectives, and of their gradients relative to the gradient's norm."""
    given = work.scenarios
    draws = plain_torch.Draws(
        tensor(given.start), [tensor(z < problem.keep) for z in given.policy], tensor(given.sensor), tensor(given.match)
    )
    network = work.state.policy.params["network"]
    policy = [(kernel.requires_grad_(), bias.requires_grad_()) for kernel, bias in layers_of(network)]
    theirs = plain_torch.objective(problem, policy, draws, one)
    theirs.backward()
    ours, gradient = jax.jit(jax.value_and_grad(work.objective))(work.state.policy.params, work.belief, given)
    pairs = zip(layers_of(gradient["network"]), policy, strict=True)
    flat = [(a.numpy(), b.grad.numpy()) for pair in pairs for a, b in zip(*pair, strict=True)]
    difference, size = (np.sqrt(sum(np.sum(f(a, b) ** 2) for a, b in flat)) for f in (np.subtract, lambda a, _: a))
    return abs(float(ours) - theirs.item()), float(difference / size)


def compare(work: Workload, repeats: int, tuned: bool) -> dict[str, Any]:
    """Milliseconds of a search step of each, and what the programs disagree by. RuntimeError if it is too much."""
    problem, particles = problem_of(work), work.config.search.particles
    versions: dict[str, Callable] = {"eager": plain_torch.step}
    if tuned:
        versions["compiled"] = torch.compile(partial(plain_torch.step, activate=plain_torch.tuned_relu))
    row: dict[str, Any] = {}
    for name, one in versions.items():
        row[f"{name}_objective_difference"], row[f"{name}_gradient_difference"] = disagreement(work, problem, one)
        if row[f"{name}_objective_difference"] > 1e-5:
            raise RuntimeError(f"{name}: the objectives differ by {row[f'{name}_objective_difference']:.1e}")
    ours, _ = compiled(partial(work.experiment.search, steps=STEPS), work.state, jnp.int32(1))
    programs = {"ours": ours}
    policy = layers_of(work.state.policy.params["network"])
    for name, one in versions.items():
        search = plain_torch.searcher(problem, policy, particles, work.config.search.learning_rate, one)
        programs[name] = lambda search=search: [search() for _ in range(STEPS)]
    times = in_turn(programs, repeats)
    row |= {f"{name}_ms": summary(runs, STEPS)["min_ms"] for name, runs in times.items()}
    row |= {f"ours_of_{name}": row["ours_ms"] / row[f"{name}_ms"] for name in versions}
    row["ours_of_own_products"] = row["ours_ms"] / own_products(work, repeats)
    return row


def main(words: list[str]) -> None:
    """The command line of this module."""
    options, dotted = settings.split(words, ("sizes", "repeats", "compile", "threads"))
    torch.set_num_threads(int(options.get("threads", "1")))
    names = options["sizes"].split(",") if "sizes" in options else list(SIZES)
    rows = {}
    for name in names:
        rows[name] = compare(
            workload({**SIZES[name], **dotted}), int(options.get("repeats", "5")), options.get("compile") == "true"
        )
        print(name, json.dumps({key: float(f"{value:.3g}") for key, value in rows[name].items()}), flush=True)
    command = shlex.join(["python", "-m", "benchmarks.peers.compare", *words])
    result = {"rows": rows, "torch": torch.__version__, "about": about(command)}
    (RESULTS / "peers.json").write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
