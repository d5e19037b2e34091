"""Our search step and plain PyTorch's, in turn in one process, once they agree on the objective and its gradient.

    taskset -c 0 python -m benchmarks.peers.compare [sizes=cart-pole,...] [repeats=5] [compile=true] [setting=value ...]
        [prob_mbrl=CHECKOUT] [mc_pilco=CHECKOUT] [out=benchmarks/results/peers.json]

Needs the extra `peers`. Pin it to as many CPUs as you ask `threads=` for: nothing else holds XLA to one. `compile=true`
adds torch.compile of a time step, tuned by hand (a C++ compiler and a minute are needed). Sizes are in `workloads`.
`prob_mbrl=` adds the authors' PyTorch code, its search step and its fit step, where you have a clone of
github.com/mcgillmrl/prob_mbrl and `pip install tqdm joblib`: see `of_prob_mbrl`, also for what agrees and what differs.
`mc_pilco=` adds MC-PILCO's search step, beside ours of `model=gp policy=rbf` in float32 and in float64, where you have
a clone of github.com/merlresearch/MC-PILCO: see `of_mc_pilco`. The sizes must have one control.
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

try:
    import torch
    from torch import Tensor
except ModuleNotFoundError:
    if __name__ == "__main__":
        sys.exit("compare: PyTorch is missing; pip install torch")
    raise

from benchmarks import RESULTS, command, number, writable
from benchmarks.peers import of_mc_pilco, of_prob_mbrl, plain_torch
from benchmarks.speed.timing import compiled, in_turn, own_products, summary
from benchmarks.speed.workloads import SIZES, Workload, goal, workload
from pegasus_jax.checks import choice
from pegasus_jax.runs import config_io
from pegasus_jax.runs.files import write_json
from pegasus_jax.runs.machine import about

STEPS, FIT_STEPS = 10, 100  # in one timed run
LIMITS = {"objective": 1e-5, "gradient": 1e-3, "std": 1e-3}  # of what programs that do the same disagree by


def tensor(array: Any) -> Tensor:
    """A copy of an array, in PyTorch."""
    return torch.tensor(np.asarray(array, np.float32))


def layers_of(network: Any) -> plain_torch.Layers:
    """The layers of a flax network of ours."""
    layers = [network["params"][f"layer_{i}"] for i in range(len(network["params"]))]
    return [(tensor(layer["kernel"]), tensor(layer["bias"])) for layer in layers]


def problem_of(work: Workload) -> plain_torch.Problem:
    """The same search step for PyTorch."""
    task, scaling = work.task, work.posterior.scaling
    return plain_torch.Problem(
        model=layers_of(work.posterior.network),
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
        match=work.config.search.matching != "never",
    )


def disagreement(work: Workload, problem: plain_torch.Problem, one: Callable) -> dict[str, float]:
    """Difference of the two objectives, and of their gradients relative to the gradient's norm."""
    given = work.scenarios
    draws = plain_torch.Draws(
        tensor(given.start), [tensor(z < problem.keep) for z in given.policy], tensor(given.sensor), tensor(given.match)
    )
    network = work.state.policy.params["network"]
    policy = [(kernel.requires_grad_(), bias.requires_grad_()) for kernel, bias in layers_of(network)]
    theirs = plain_torch.objective(problem, policy, draws, one)
    theirs.backward()
    ours, gradient = jax.jit(jax.value_and_grad(work.objective))(work.state.policy.params, work.posterior, given)
    pairs = zip(layers_of(gradient["network"]), policy, strict=True)
    flat = [(a.numpy(), b.grad.numpy()) for pair in pairs for a, b in zip(*pair, strict=True)]
    difference, size = (np.sqrt(sum(np.sum(f(a, b) ** 2) for a, b in flat)) for f in (np.subtract, lambda a, _: a))
    return {"objective": abs(float(ours) - theirs.item()), "gradient": float(difference / size)}


def agreed(name: str, found: dict[str, float]) -> dict[str, float]:
    """The differences as a row has them. RuntimeError if one is too much."""
    for key, value in found.items():
        if not value <= LIMITS[key]:  # nor may it be NaN
            raise RuntimeError(f"{name}: the {key} differs by {value:.1e}; at most {LIMITS[key]:.0e} is rounding")
    return {f"{name}_{key}_difference": value for key, value in found.items()}


def compare(work: Workload, repeats: int, tuned: bool, prob_mbrl: Any = None) -> dict[str, Any]:
    """Milliseconds of a search step of each, and what the programs disagree by. RuntimeError if it is too much."""
    problem, particles = problem_of(work), work.config.search.particles
    versions: dict[str, Callable] = {"eager": plain_torch.step}
    if tuned:
        versions["compiled"] = torch.compile(partial(plain_torch.step, activate=plain_torch.tuned_relu))
    row: dict[str, Any] = {}
    for name, one in versions.items():
        row |= agreed(name, disagreement(work, problem, one))
    ours, _ = compiled(partial(work.experiment.search, steps=STEPS), work.state, jnp.int32(1))
    programs = {"ours": ours}
    policy = layers_of(work.state.policy.params["network"])
    for name, one in versions.items():
        search = plain_torch.searcher(problem, policy, particles, work.config.search.learning_rate, one)
        programs[name] = lambda search=search: [search() for _ in range(STEPS)]
    if prob_mbrl is not None:
        row |= agreed("prob_mbrl", of_prob_mbrl.disagreement(prob_mbrl, work, layers_of, tensor))
        theirs = of_prob_mbrl.programs(prob_mbrl, work, layers_of, tensor, STEPS, FIT_STEPS)
        fit, _ = compiled(partial(work.experiment.fit, steps=FIT_STEPS), work.state)
        fits = in_turn({"ours": fit, "prob_mbrl": theirs["fit"]}, repeats)
        row |= {f"{name}_fit_ms": summary(runs, FIT_STEPS)["min_ms"] for name, runs in fits.items()}
        row["ours_of_prob_mbrl_fit"] = row["ours_fit_ms"] / row["prob_mbrl_fit_ms"]
        programs["prob_mbrl"] = theirs["search"]
    times = in_turn(programs, repeats)
    row |= {f"{name}_ms": summary(runs, STEPS)["min_ms"] for name, runs in times.items()}
    row |= {f"ours_of_{name}": row["ours_ms"] / row[f"{name}_ms"] for name in programs if name != "ours"}
    row["ours_of_own_products"] = row["ours_ms"] / own_products(work, repeats)
    return row


def beside_mc_pilco(package: Any, work: Workload, repeats: int) -> dict[str, Any]:
    """The same of MC-PILCO and of ours with a Gaussian process, in float32 and in float64."""
    search = partial(work.experiment.search, steps=STEPS)
    programs = {"ours_gp": compiled(search, work.state, jnp.int32(1))[0]}
    with jax.enable_x64(True):
        double = of_mc_pilco.in_double(work)
        row: dict[str, Any] = agreed("mc_pilco", of_mc_pilco.disagreement(package, double))
        programs["ours_gp_double"], _ = compiled(search, double.state, jnp.int32(1))
        programs["mc_pilco"] = of_mc_pilco.search(package, double, STEPS)
    row |= {f"{name}_ms": summary(runs, STEPS)["min_ms"] for name, runs in in_turn(programs, repeats).items()}
    row["ours_of_mc_pilco"] = row["ours_gp_ms"] / row["mc_pilco_ms"]
    row["ours_double_of_mc_pilco"] = row["ours_gp_double_ms"] / row["mc_pilco_ms"]
    return row


def main(words: list[str]) -> None:
    """The command line of this module."""
    options, dotted = config_io.split(words, ("sizes", "repeats", "compile", "threads", "prob_mbrl", "mc_pilco", "out"))
    prob_mbrl = of_prob_mbrl.load(Path(options["prob_mbrl"])) if "prob_mbrl" in options else None
    mc_pilco = of_mc_pilco.load(Path(options["mc_pilco"])) if "mc_pilco" in options else None
    torch.set_num_threads(number(options, "threads", 1))
    names = options["sizes"].split(",") if "sizes" in options else list(SIZES)
    for name in names:
        choice("sizes", name, SIZES)
    repeats, out = number(options, "repeats", 5), writable(options.get("out", RESULTS / "peers.json"))
    rows = {}
    for name in names:
        work = workload({**SIZES[name], **dotted})
        rows[name] = compare(work, repeats, options.get("compile") == "true", prob_mbrl)
        if mc_pilco is not None:
            work = of_mc_pilco.comparable({**SIZES[name], **of_mc_pilco.SETTINGS, **dotted})
            rows[name] |= beside_mc_pilco(mc_pilco, work, repeats)
        print(name, json.dumps({key: float(f"{value:.3g}") for key, value in rows[name].items()}), flush=True)
    command = shlex.join(["python", "-m", "benchmarks.peers.compare", *words])
    write_json(out, {"rows": rows, "torch": torch.__version__, "about": about(command)})


if __name__ == "__main__":
    command(main, __doc__)
