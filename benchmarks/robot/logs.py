"""A Furuta pendulum learned from ten logs of a hand-written controller, without a random episode.

    python -m benchmarks.robot.logs furuta=FOLDER [seeds=100-109] [jobs=2] [out=FILE] [minutes=9] [trials=10]
        [random=true] [setting=value ...]

FOLDER holds `robot.py`, which registers FurutaSafe-v0 and has its `cost`, and `logs/*.csv`, ten episodes of 2 s. Trial
1 is the logs; its policy is evaluated before the robot has run one episode of its own. `random=true` learns the same
without logs, from one random episode. `jobs` runs at a time have a core each. One JSON is written after each run, and
the same command goes on with runs that were stopped after `minutes`. Tuning seeds are 100 to 119.
"""

import shlex
import sys
from collections.abc import Sequence
from typing import Any

from benchmarks.robot import seeds
from pegasus_jax.checks import ConfigError
from pegasus_jax.runs import config_io
from pegasus_jax.runs.study import SOLVED, first_solved

TASK = (
    *("task=gym", "env=robot:FurutaSafe-v0", "cost=robot:cost", "angles=[1]", "horizon=100", "eval_episodes=10"),
    *("start_mean=[0,0,0,0,0]", "start_std=[0.02,0.02,0.01,0.01,0.01]"),
)


def table(runs: Sequence[dict[str, Any]]) -> str:
    """A line a seed: the first trial of 90 %, and success trial by trial; trial 1 has no own episode before it."""
    lines = []
    for run in sorted(runs, key=lambda run: run["seed"]):
        success = [row["success_rate"] for row in run["trials"]]
        first = first_solved(success)
        seconds = f"{run['trials'][first - 1]['plant_seconds']:g} s" if first else "-"
        rates = " ".join(f"{rate:4.0%}" for rate in success)
        lines.append(
            f"seed {run['seed']}  first >= {SOLVED:.0%}: trial {first or '-'}, after {seconds} of robot   {rates}"
        )
    last = [run["trials"][-1]["success_rate"] >= SOLVED for run in runs if run["trials"]]
    ever = [any(row["success_rate"] >= SOLVED for row in run["trials"]) for run in runs]
    lines.append(f"{sum(ever)} of {len(runs)} seeds reached {SOLVED:.0%}, {sum(last)} are there after their last trial")
    return "\n".join(lines)


def main(given: list[str]) -> None:
    """The command line of this module. Raises ConfigError for what it cannot use."""
    options, rest = config_io.split(given, ("random", *seeds.OPTIONS))
    folder, random = seeds.robot(options), options.get("random") == "true"
    logs = ["explore.trials=1"] if random else [f"data={folder}/logs/*.csv", "explore.trials=0"]
    words = [*TASK, *logs, *(f"{key}={value}" for key, value in rest.items())]
    options = {"out": "runs/logs.json", "trials": "10"} | options
    print(table(seeds.learned(options, words, shlex.join(["python", "-m", "benchmarks.robot.logs", *given]))))


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except ConfigError as error:
        sys.exit(f"logs: {error}")
