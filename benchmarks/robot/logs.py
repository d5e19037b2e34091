"""A Furuta pendulum learned from ten logs of a hand-written controller, without a random episode.

    python -m benchmarks.robot.logs furuta=FOLDER [seeds=100-109] [jobs=2] [out=FILE] [minutes=9] [trials=10]
        [random=true] [setting=value ...]

FOLDER holds `robot.py`, which registers FurutaSafe-v0 and has its `cost`, and `logs/*.csv`, ten episodes of 2 s. Trial
1 is the logs; its policy is evaluated before the robot has run one episode of its own. `random=true` learns the same
without logs, from one random episode. `jobs` runs at a time have a core each. One JSON is written after each run, and
the same command goes on with runs that were stopped after `minutes`. Tuning seeds are 100 to 119.
"""

import shlex

from benchmarks import command
from benchmarks.robot import seeds
from pegasus_jax.runs import config_io

TASK = (
    *("task=gym", "env=robot:FurutaSafe-v0", "cost=robot:cost", "angles=[1]", "horizon=100", "eval_episodes=10"),
    *("start_mean=[0,0,0,0,0]", "start_std=[0.02,0.02,0.01,0.01,0.01]"),
)


def main(given: list[str]) -> None:
    """The command line of this module. Raises ConfigError for what it cannot use."""
    options, rest = config_io.split(given, ("random", *seeds.OPTIONS))
    folder, random = seeds.robot(options), options.get("random") == "true"
    logs = ["explore.trials=1"] if random else [f"data={folder}/logs/*.csv", "explore.trials=0"]
    words = [*TASK, *logs, *(f"{key}={value}" for key, value in rest.items())]
    options = {"out": "runs/logs.json", "trials": "10"} | options
    print(seeds.table(seeds.learned(options, words, shlex.join(["python", "-m", "benchmarks.robot.logs", *given]))))


if __name__ == "__main__":
    command(main, __doc__)
