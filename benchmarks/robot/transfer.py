"""From a simulator that is 30 % off to the plant: how many seeds have learned the cart-pole by its second trial.

    python -m benchmarks.robot.transfer [ways=[init,policy_model,prior,both,none]] [off=[low,high,mixed]]
        [seeds=100-109] [out=FILE] [trials=3] [simulated=10] [prior.model=ensemble] [setting=value ...]

The simulator's masses, length and friction are those of task=cartpole times .7 (low), 1.3 (high) or some of each.
`init` learns `simulated` trials in it, all seeds as one program, and begins with each one's best policy; `policy_model`
takes its model over too; `prior` has its equations as prior=; `both` is init with prior; `none` knows nothing. After
each trial 20 evaluation episodes on task=cartpole say whether a seed has solved it (90 %); trial 0 is before the first
episode. Writes one JSON, again after each trial, and prints one table. The same command goes on after the combinations
that are whole in the file. WAY.setting=value is of one way only.
"""

import json
import shlex
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import command, number
from benchmarks.robot import cartpole_by_hand
from pegasus_jax import sharding
from pegasus_jax.checks import ConfigError
from pegasus_jax.config import Config
from pegasus_jax.experiment import EVALUATE, trial_key
from pegasus_jax.runs import begin, config_io, train
from pegasus_jax.runs.evaluation import evaluate
from pegasus_jax.runs.files import strict, write_json
from pegasus_jax.runs.job import Job, first_states, opened
from pegasus_jax.runs.machine import about
from pegasus_jax.runs.programs import share_cpus
from pegasus_jax.runs.study import SOLVED, seed_list
from pegasus_jax.types import RunState

NAMES = {"length": "pole_length", "pole": "pole_mass", "cart": "cart_mass", "friction": "friction"}
KEPT = ("mean_cost", "success_rate", "episode_cost", "calibration", "objective_fresh")
BEGUN = ("init", "policy_model", "both")
WAYS = (*BEGUN, "prior", "none")


def simulated(words: dict[str, str], off: str, seeds: Sequence[int], trials: int) -> tuple[RunState, list[float]]:
    """The states [S, ...] of runs in the simulator, with each seed's best policy, and their success there."""
    constants = {f"env_args.{NAMES[name]}": str(value) for name, value in cartpole_by_hand.constants(off).items()}
    config = config_io.parse({"task": "cartpole", **words, **constants, "trials": str(trials)})
    best: list[Any] = [None] * len(seeds)

    def keep(_: int, states: RunState, rows: list[dict[str, Any]]) -> None:
        for index, row in enumerate(rows):
            key = (row["success_rate"], -row["mean_cost"])
            if best[index] is None or key >= best[index][0]:
                best[index] = key, jax.tree.map(lambda leaf: np.asarray(leaf[index]), states.policy.params)  # noqa: B023

    with opened(config, seeds, sharding.evenly(len(seeds))) as job:
        job = job._replace(writer=job.writer._replace(trial=keep))
        states = train.learn(job, first_states(job))
    params = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(params for _, params in best))
    return states._replace(policy=states.policy._replace(params=params)), [key[0] for key, _ in best]


def transferred(config: Config, seeds: Sequence[int], old: RunState | None, keep: Any) -> None:
    """The seeds' runs on the plant; `keep` hears after each trial, and before the first episode, of a row a seed."""
    with opened(config, seeds, sharding.evenly(len(seeds))) as job:

        def before(states: RunState) -> None:
            keep([{**dict.fromkeys(KEPT), **row} for row in judged(job, states)])

        writer = job.writer._replace(ready=before, trial=lambda number, states, rows: keep(rows))
        states = first_states(job)
        states = states if old is None else begin.taken_over(states, old, config.init_parts)
        train.learn(job._replace(writer=writer), states)


def judged(job: Job, states: RunState) -> list[dict[str, Any]]:
    """The policies before the first episode."""
    keys = jax.vmap(lambda key: trial_key(key, 0, EVALUATE))(states.key)
    return evaluate(keys, states.policy.params, job.experiment.task, job.program, job.config.eval_episodes)


def settings(way: str, off: str, words: dict[str, str]) -> Config:
    """The config of a way on the plant."""
    own = {key.removeprefix(f"{way}."): value for key, value in words.items() if key.startswith(f"{way}.")}
    shared = {key: value for key, value in words.items() if key.partition(".")[0] not in WAYS}
    if way in ("prior", "both"):
        shared = {"model": "log_normal", **shared, "prior": f"benchmarks.robot.cartpole_by_hand:{off}"}
    if way in BEGUN:
        parts = "[policy,model]" if way == "policy_model" else "[policy]"
        shared |= {"init": "the simulator's run", "init_parts": parts, "explore.trials": "0"}
    return config_io.parse({"task": "cartpole", **shared, **own})


def name_of(way: str, off: str) -> str:
    """A combination in a file of results."""
    return f"{way} off={off}"


def there(out: Path, asked: dict[str, Any]) -> dict[str, Any]:
    """The combinations that a file has, if it is there. ConfigError for another file, and for one of other settings."""
    if not out.exists():
        return {}
    try:
        results = dict(json.loads(out.read_text())["results"])
    except (ValueError, KeyError, TypeError):
        what = f"out={out} is not a file of this command"
        raise ConfigError(f"{what}; expected a new one, or one that it wrote") from None
    for name in asked:
        whole = results[name] if results.get(name, {}).get("whole") else {}
        for key, value in strict(asked[name]).items():
            if whole.get(key, value) != value:
                raise ConfigError(f"out={out} has {name} with another {key}; expected the same, or another out=")
    return results


def table(results: dict[str, Any]) -> str:
    """A line for each seed, and one for each combination."""
    lines = []
    for name, one in results.items():
        rates = np.array([[row["success_rate"] for row in rows] for rows in one["trials"]], float).T  # [S, T]
        for index, seed in enumerate(one["seeds"]):
            shown = " ".join(f"{rate:4.0%}" for rate in rates[index])
            costs = " ".join(f"{rows[index]['mean_cost']:.2f}" for rows in one["trials"])
            lines.append(f"{name:24} seed {seed:>3}  {shown}  | {costs}")
        solved = " ".join(f"{np.sum(rates[:, t] >= SOLVED):4d}" for t in range(rates.shape[1]))
        lines.append(f"{name:24} solved    {solved}  of {len(one['seeds'])}, after trial {one['first']}, ...")
    return "\n".join(lines)


def main(given: list[str]) -> None:
    """The command line of this module."""
    options, words = config_io.split(given, ("ways", "off", "seeds", "out", "trials", "simulated"))
    ways, offs = (
        options.get(name, text).strip("[]").split(",")
        for name, text in (("ways", "[init,prior,both]"), ("off", "[low]"))
    )
    if wrong := [way for way in ways if way not in WAYS] + [off for off in offs if off not in cartpole_by_hand.OFF]:
        raise ConfigError(f"{wrong[0]} is unknown; ways={[*WAYS]}, off={[*cartpole_by_hand.OFF]}")
    seeds, out = seed_list(options.get("seeds", "100-109")), Path(options.get("out", "runs/transfer.json"))
    trials, simulated_trials = number(options, "trials", 3), number(options, "simulated", 10)
    plain = {key: value for key, value in words.items() if key.partition(".")[0] not in WAYS}
    asked = {
        name_of(way, off): {
            "seeds": seeds,
            "simulated": simulated_trials if way in BEGUN else None,
            "config": config_io.plain(settings(way, off, words | {"trials": str(trials)})),
        }
        for off in offs
        for way in ways
    }
    results = there(out, asked)
    share_cpus(len(seeds))
    told = about(shlex.join(["python", "-m", "benchmarks.robot.transfer", *given]))
    for off in offs:
        old: tuple[RunState, list[float]] | None = None
        for way in ways:
            name, began = name_of(way, off), time.monotonic()
            if results.get(name, {}).get("whole"):
                continue
            if way in BEGUN and old is None:
                old = simulated(plain, off, seeds, simulated_trials)
                print(f"off={off}: success in the simulator {old[1]}", flush=True)
            config = settings(way, off, words | {"trials": str(trials)})
            first = 0 if way != "none" else 1
            results[name] = one = {**asked[name], "first": first, "trials": []}
            one["simulator"] = old[1] if old is not None and way in BEGUN else None

            def keep(rows: list[dict[str, Any]], one: dict[str, Any] = one, began: float = began) -> None:
                one["trials"].append([{key: row[key] for key in KEPT} for row in rows])
                one["seconds"] = round(time.monotonic() - began, 1)
                write_json(out, {"results": results, "about": told})

            transferred(config, seeds, old[0] if old is not None and way in BEGUN else None, keep)
            one["whole"] = True
            write_json(out, {"results": results, "about": told})
            print(table({name: one}), flush=True)
    print(table(results))


if __name__ == "__main__":
    command(main, __doc__)
