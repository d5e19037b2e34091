"""Learning studies: every seed of a configuration in one vmapped program, every curve kept raw."""

import json
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax import sharding
from pegasus_jax.builder import build, set_precision
from pegasus_jax.checks import SIZES, SettingError
from pegasus_jax.config import GYM, Config
from pegasus_jax.episode import succeeded
from pegasus_jax.experiment import TrialInfo, trial
from pegasus_jax.runs import config_io
from pegasus_jax.runs.files import write_whole
from pegasus_jax.runs.programs import LASTING, compiler_options, described
from pegasus_jax.runs.train import saturated
from pegasus_jax.types import Array, Experiment, RunState, Task

SOLVED = 0.9  # of a trial's evaluation episodes succeed

# What is a seed's own; the trial is one number for all, so that the random trials are without a search in fact.
SEEDS = RunState(0, 0, 0, 0, None, 0)  # type: ignore[arg-type]


def study(config: Config, seeds: list[int], path: Path | None = None) -> dict[str, Any]:
    """Curves [S, T] of a configuration over seeds; written to `path` after every trial, so that nothing is lost.

    `curves` says what is in them. Raises SettingError for a plant that cannot be vmapped.
    """
    if config.task == GYM:
        raise SettingError(
            "task=gym cannot be studied as one program: its environment is one object; use pegasus-train"
        )
    if not config.evaluation:
        raise SettingError("evaluation=0 leaves a study nothing to compare; the nearest is 1")
    set_precision(config)
    experiment = build(config)
    over = sharding.evenly(len(seeds))

    def each(function: Callable[..., Any], given: Any, returned: Any = 0) -> Callable[..., Any]:
        vmapped = jax.vmap(function, given, returned)
        return vmapped if over is None else sharding.each_its_own(vmapped, over, given, returned)

    # What lies where: a seed's own on the devices for seeds, the number of the trial on all.
    own, all_the_same = (None, None) if over is None else (sharding.over_seeds(over), sharding.shared(over))
    laid_out = RunState(own, own, own, own, all_the_same, own)  # type: ignore[arg-type]
    keys = jax.vmap(jax.random.key)(jnp.asarray(seeds, jnp.uint32))
    states = jax.jit(each(experiment.init, (0,), SEEDS), out_shardings=laid_out)(keys)
    began = time.monotonic()
    one = each(lambda state: trial(state, experiment, config.evaluation), (SEEDS,), (SEEDS, 0))
    lowered = jax.jit(one, out_shardings=(laid_out, own)).lower(states)
    how = compiler_options(LASTING)
    program = lowered.compile(compiler_options=how)
    # A program of its own, so that looking changes no number.
    infos = lowered.out_info[1] if own is None else described(lowered.out_info[1], own)
    look = jax.jit(each(partial(diagnosed, experiment), (SEEDS, SEEDS, 0)), out_shardings=own)
    look = look.lower(states, states, infos).compile(compiler_options=how)
    compiled = time.monotonic()
    infos, looks, result = [], [], {}
    for count in range(1, config.trials + 1):
        before = states
        states, info = jax.block_until_ready(program(states))
        infos.append(jax.tree.map(np.asarray, info))
        looks.append(jax.tree.map(np.asarray, look(before, states, info)))
        result = curves(config, seeds, stacked(infos), experiment.task) | diagnostics(*stacked(looks))
        result |= {"compile_seconds": round(compiled - began, 1), "run_seconds": round(time.monotonic() - compiled, 1)}
        if path is not None:
            write(path, result)
        cost, success = (np.asarray(result[name], float)[:, -1] for name in ("mean_cost", "success_rate"))
        solved = np.mean(success >= SOLVED)
        print(f"trial {count}  cost {cost.mean():.3f}  solved {solved:.0%}", file=sys.stderr, flush=True)
    return result


def diagnosed(experiment: Experiment, before: RunState, after: RunState, info: TrialInfo) -> tuple[Array, Array]:
    """Of one trial: calibration of the model on the episode it had not seen, and the objective on fresh scenarios.

    NaN where there is none: before the first fit, and of a trial without a search.
    """
    fresh = jnp.mean(experiment.imagine(after)[1])
    return experiment.calibrate(before, info.trajectory), jnp.where(jnp.isnan(info.fit.loss), jnp.nan, fresh)


def stacked(trials: list[Any]) -> Any:
    """One tree [S, T, ...] of the trials' [S, ...]."""
    return jax.tree.map(lambda *leaves: np.stack(leaves, 1), *trials)


def curves(config: Config, seeds: list[int], info: TrialInfo, task: Task) -> dict[str, Any]:
    """What is kept of the trials so far [S, T, ...]."""
    costs = info.evaluation  # [S, T, E, H]
    return {
        "seeds": seeds,
        "plant_seconds": np.round(task.horizon * task.dt * np.arange(1, costs.shape[1] + 1), 6).tolist(),
        "mean_cost": short(costs.mean((2, 3))),
        "success_rate": succeeded(costs, task).mean(2).tolist(),
        "episode_cost": short(info.trajectory.cost.mean(2)),
        "objective_last": short(info.search.objective[..., -1]),
        "saturated": short(saturated(info.trajectory.u, task)),
        "skipped_updates": info.search.skipped.tolist(),
        "config": config_io.plain(config),
    }


def diagnostics(calibration: Any, fresh: Any) -> dict[str, Any]:
    """`diagnosed` of the trials so far [S, T]."""
    return {"calibration": short(calibration), "objective_fresh": short(fresh)}


def short(values: Any) -> list[list[float | None]]:
    """Numbers [S, T] to four decimals; None for one that is not known, because JSON has no NaN."""
    return [[None if np.isnan(v) else round(float(v), 4) for v in row] for row in np.asarray(values)]


def write(path: Path, result: dict[str, Any]) -> None:
    """Write a study's JSON; it appears whole or not at all."""
    write_whole(path, lambda file: file.write(json.dumps(result).encode() + b"\n"))


def first_solved(success_rate: list[float]) -> int | None:
    """The first trial (from 1) of a seed that is solved."""
    return next((t for t, rate in enumerate(success_rate, 1) if rate >= SOLVED), None)


def table(result: dict[str, Any]) -> str:
    """One line a seed: first trial solved, then success and cost trial by trial."""
    lines, every = [], np.asarray(result["mean_cost"], float)
    for seed, success, cost in zip(result["seeds"], result["success_rate"], every, strict=True):
        rates, costs = " ".join(f"{s:4.0%}" for s in success), " ".join(f"{c:.2f}" for c in cost)
        lines.append(f"seed {seed:>3}  first >= {SOLVED:.0%}: {first_solved(success) or '-':>2}  {rates}  | {costs}")
    mean = np.mean(every, 0)
    solved = np.mean(np.asarray(result["success_rate"]) >= SOLVED, 0)
    lines.append(
        "mean cost  " + " ".join(f"{c:.2f}" for c in mean) + "  | solved " + " ".join(f"{s:.2f}" for s in solved)
    )
    return "\n".join(lines)


def seed_list(text: str) -> list[int]:
    """Seeds of '0-9' or '0,3,7'. Raises SettingError for anything else."""
    first, dash, last = text.partition("-")
    try:
        seeds = (
            list(range(int(first), min(int(last), int(first) + SIZES["trials"]) + 1))
            if dash
            else [int(part) for part in text.split(",")]
        )
    except ValueError:
        seeds = []
    if not seeds or min(seeds) < 0 or len(seeds) > SIZES["trials"]:
        raise SettingError(
            f"seeds={text} names no seeds, or more than {SIZES['trials']:,}; for example seeds=0-9 or seeds=0,3,7"
        )
    return seeds
