"""How a rotary pendulum is learned whose arm may not turn far: when, and how often the arm hits its stop.

    python -m benchmarks.robot.limits furuta=FOLDER [seeds=100-109] [jobs=2] [out=FILE] [minutes=9] [setting=value ...]

FOLDER has the module `robot`, whose FurutaPrev-v0 ends an episode where the arm passes 120 degrees; the constraint is
90 degrees. One `pegasus-train` a seed, `jobs` at a time with one core each, then ten episodes of the policy after each
trial, which nothing is learned from. Writes one JSON, again after each run, and prints one table. The runs are in OUT
without .json: the same command goes on with those that were stopped, by hand or after `minutes`.
Tuning seeds are 100 to 119; 200 and above are for a final judgment only.
"""

import json
import shlex
import sys
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from benchmarks import beside_runs, command, each, minutes, number, once
from benchmarks.plants_suite.__main__ import core_queue, on_core
from benchmarks.robot import seeds
from pegasus_jax.cli.sweep import PROGRAM
from pegasus_jax.runs import checkpoint, config_io, store
from pegasus_jax.runs.files import write_json
from pegasus_jax.runs.machine import about
from pegasus_jax.runs.study import seed_list

ENV, EPISODES, FIRST_RESET = "robot:FurutaPrev-v0", 10, 10_000
HELD, UPRIGHT = 25, 0.4  # the last so many periods are to be within so many radians of upright
LEARNED, MOST_HITS, BY = 0.9, 2, 30.0  # of the ten episodes; episodes that hit the stop; seconds of robot time
WORDS = (
    "angles=[1] start_mean=[0,0,0,0,0] start_std=[0.02,0.02,0.01,0.01,0.01] horizon=100 trials=14 eval_episodes=0"
    " explore.kind=walk policy.input_units=null"
)


def cost(x: Any) -> Any:
    """0 upright at rest with the arm in the middle, 1 hanging. It falls towards the goal from anywhere."""
    height = (1 + jnp.cos(x[1])) / 2
    far = 4 * height + (0.5 * x[0]) ** 2 + (0.05 * x[3]) ** 2  # the rate: turning over and over is no way to stay up
    return 0.85 * (1 - jnp.exp(-far / (2 * 0.7**2))) + 0.15 * height


def arm(x: Any) -> Any:
    """How far the arm is beyond 90 degrees [rad]."""
    return jnp.abs(x[0]) - jnp.pi / 2


def stop(x: Any) -> Any:
    """Where the environment ends an episode."""
    return jnp.abs(x[0]) > np.deg2rad(120)


def judged(run: Path) -> list[dict[str, Any]]:
    """A row for each trial: what was expected and what happened, and how ten episodes of its policy went."""
    import gymnasium

    from pegasus_jax import controller

    env, rows, horizon = gymnasium.make(ENV, disable_env_checker=True), [], store.task_of(run).horizon
    measured = list(config_io.load(run / "config.yaml").sensors.measured) or slice(None)
    told = ("trial", "plant_seconds", "policy", "ended", "episode_cost", "objective_fresh")
    told += ("constraint_expected", "constraint_broken", "constraint_rows", "calibration")
    for row in store.trials(run):
        rows.append({name: row[name] for name in told} | {"success": None, "hits": None})
        if row["trial"] in checkpoint.available(run) and row["constraint_expected"] is not None:
            control = controller(run, trial=row["trial"])
            went = [flown(control, env, FIRST_RESET + number, horizon, measured) for number in range(EPISODES)]
            success, hits = np.mean(went, 0)
            rows[-1] |= {"success": float(success), "hits": float(hits)}
    return rows


def flown(control: Any, env: Any, seed: int, horizon: int, measured: list[int] | slice) -> tuple[bool, bool]:
    """Whether an episode of so many periods ends upright and stays there, and whether it hits the stop.

    `measured` are the entries of an observation that the controller is given.
    """
    x, _ = env.reset(seed=seed)
    control.reset()
    off, hit = [], False
    while len(off) < horizon and not hit:
        x, _, hit, _, _ = env.step(np.asarray(control(x[measured]), np.float32))
        off.append(abs((x[1] % (2 * np.pi)) - np.pi))
    return not hit and max(off[-HELD:]) < UPRIGHT, bool(hit)


def one(seed: int, home: Path, words: list[str], minutes: float, cores: Any) -> dict[str, Any]:
    """One run, learned or gone on with, and its rows; `error` is the last line of a failure."""
    run, core = (home / f"{seed}").absolute(), cores.get()
    module = "benchmarks.robot.limits"
    own = [
        f"{name}={module}:{function}" for name, function in (("cost", "cost"), ("constraint", "arm"), ("stop", "stop"))
    ]
    new = once("task=gym", f"env={ENV}", *own, *WORDS.split(), *words, f"seed={seed}", f"out={run}")
    task = [f"resume={run}"] if (run / "config.yaml").exists() else new
    try:
        learned = on_core([*PROGRAM, *task], core, 60 * minutes)
        told = on_core([sys.executable, "-m", module, f"judge={run}"], core, None)
    finally:
        cores.put(core)
    rows = json.loads(told[0].splitlines()[-1]) if told[1] is None else []
    print(line(found := {"seed": seed, "error": learned[1] or told[1], "trials": rows}), flush=True)
    return found


def verdict(run: dict[str, Any]) -> tuple[float | None, int, bool]:
    """(seconds of robot time until it is learned or None, episodes that hit the stop, whether that is at the bar)."""
    rows = run["trials"]
    by = next((row["plant_seconds"] for row in rows if (row["success"] or 0) >= LEARNED), None)
    hits = sum(row["ended"] == "terminated" for row in rows)
    return by, hits, by is not None and by <= BY and hits <= MOST_HITS


def line(run: dict[str, Any]) -> str:
    """A seed in one line: its verdict, then the success of each trial's policy and `!` for an episode that hit."""
    by, hits, good = verdict(run)
    marks = " ".join(
        ("!" if row["ended"] == "terminated" else "") + ("-" if row["success"] is None else f"{row['success']:.0%}")
        for row in run["trials"]
    )
    at = "never" if by is None else f"{by:.0f} s"
    return (
        f"seed {run['seed']}: {'yes' if good else 'no '}  learned {at:>6}  hits {hits}  {marks}  {run['error'] or ''}"
    )


def main(given: list[str]) -> None:
    """The command line of this module. Raises ConfigError for seeds that are not for this."""
    options, rest = config_io.split(given, ("furuta", "seeds", "jobs", "out", "minutes", "judge"))
    if "judge" in options:
        print(json.dumps(judged(Path(options["judge"]))))
        return
    seeds.robot(options)
    chosen, jobs, limit = seed_list(options.get("seeds", "100-109")), number(options, "jobs", 2), minutes(options, 9)
    words = [f"{key}={value}" for key, value in rest.items()]
    out, home, runs = beside_runs(options.get("out", "runs/limits.json"), words)
    told, same = about(shlex.join(["python", "-m", "benchmarks.robot.limits", *given])), (home, words, limit)
    cores = core_queue(jobs)
    for run in each(jobs, [partial(one, seed, *same, cores) for seed in chosen]):
        runs = seeds.with_run(runs, run)
        write_json(out, {"runs": runs, "about": told})
    print("\n".join([*map(line, runs), f"{sum(verdict(run)[2] for run in runs)} of {len(runs)} at the bar"]))


if __name__ == "__main__":
    command(main, __doc__)
