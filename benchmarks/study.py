"""Learning studies: every seed of a configuration in one vmapped program, every curve kept raw.

    python -m benchmarks.study NAME seeds=0-9 task=cartpole trials=15 [setting=value ...]

Writes benchmarks/results/NAME.json: per seed and trial the mean cost of 20 evaluation episodes and their success rate.
"""

import json
import shlex
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax import settings
from pegasus_jax.build import build, set_precision
from pegasus_jax.config import Config
from pegasus_jax.record import about
from pegasus_jax.trial import TrialInfo, trial

RESULTS = Path(__file__).parent / "results"


def study(config: Config, seeds: list[int], path: Path | None = None) -> dict[str, Any]:
    """Curves [S, T] of a configuration over seeds; written to `path` after every trial, so that nothing is lost."""
    set_precision(config)
    experiment = build(config)
    keys = jax.vmap(jax.random.key)(jnp.asarray(seeds, jnp.uint32))
    states = jax.jit(jax.vmap(experiment.init))(keys)
    began = time.monotonic()
    program = jax.jit(jax.vmap(lambda state: trial(state, experiment))).lower(states).compile()
    compiled = time.monotonic()
    infos, result = [], {}
    for count in range(1, config.trials + 1):
        states, info = jax.block_until_ready(program(states))
        infos.append(jax.tree.map(np.asarray, info))
        result = curves(config, seeds, jax.tree.map(lambda *leaves: np.stack(leaves, 1), *infos))
        result |= {"compile_seconds": round(compiled - began, 1), "run_seconds": round(time.monotonic() - compiled, 1)}
        if path is not None:
            path.write_text(json.dumps(result) + "\n")
        cost, success = (np.asarray(result[name])[:, -1] for name in ("mean_cost", "success_rate"))
        print(
            f"trial {count}  cost {cost.mean():.3f}  solved {np.mean(success >= 0.9):.0%}", file=sys.stderr, flush=True
        )
    return result


def curves(config: Config, seeds: list[int], info: TrialInfo) -> dict[str, Any]:
    """What is kept of the trials so far [S, T, ...]."""
    task, costs = build(config).task, info.evaluation  # [S, T, E, H]
    success = np.mean(costs[..., -5:], -1) < task.success
    return {
        "seeds": seeds,
        "plant_seconds": np.round(task.horizon * task.dt * np.arange(1, costs.shape[1] + 1), 6).tolist(),
        "mean_cost": np.round(costs.mean((2, 3)), 4).tolist(),
        "success_rate": success.mean(2).tolist(),
        "episode_cost": np.round(info.trajectory.cost.mean(2), 4).tolist(),
        "objective_last": np.round(info.search.objective[..., -1], 4).tolist(),
        "skipped_updates": info.search.skipped.tolist(),
        "config": {k: list(v) if isinstance(v, tuple) else v for k, v in settings.leaves(config).items()},
    }


def first_solved(success_rate: list[float], at_least: float = 0.9) -> int | None:
    """The first trial (from 1) whose success rate reached `at_least`."""
    return next((t for t, rate in enumerate(success_rate, 1) if rate >= at_least), None)


def table(result: dict[str, Any]) -> str:
    """One line a seed: first trial solved, then success and cost trial by trial."""
    lines = []
    for seed, success, cost in zip(result["seeds"], result["success_rate"], result["mean_cost"], strict=True):
        rates, costs = " ".join(f"{s:4.0%}" for s in success), " ".join(f"{c:.2f}" for c in cost)
        lines.append(f"seed {seed:>3}  first >= 90 %: {first_solved(success) or '-':>2}  {rates}  | {costs}")
    mean = np.mean(result["mean_cost"], 0)
    solved = np.mean(np.asarray(result["success_rate"]) >= 0.9, 0)
    lines.append(
        "mean cost  " + " ".join(f"{c:.2f}" for c in mean) + "  | solved " + " ".join(f"{s:.2f}" for s in solved)
    )
    return "\n".join(lines)


def seed_list(text: str) -> list[int]:
    """Seeds of '0-9' or '0,3,7'."""
    first, dash, last = text.partition("-")
    return list(range(int(first), int(last) + 1)) if dash else [int(part) for part in text.split(",")]


def main(words: list[str]) -> None:
    """The command line of this module."""
    name, *rest = words
    options, dotted = settings.split(rest, ("seeds",))
    config = settings.parse(dotted)
    path = RESULTS / f"{name}.json"
    RESULTS.mkdir(exist_ok=True)
    result = study(config, seed_list(options.get("seeds", "0-9")), path)
    result["about"] = about(shlex.join(["python", "-m", "benchmarks.study", *words]))
    path.write_text(json.dumps(result) + "\n")
    print(f"## {name}: compiled in {result['compile_seconds']} s, ran {result['run_seconds']} s")
    print(table(result), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
