"""What is learned from positions alone, late: the cart-pole as one batched program, a Furuta pendulum seed by seed.

    python -m benchmarks.robot.sensors cartpole [delay=0] [seeds=100-109] [trials=10] [out=FILE] [setting=value ...]
    python -m benchmarks.robot.sensors furuta furuta=FOLDER [delay=1] [seeds=100-109] [trials=13] [jobs=2] [minutes=9]
        [out=FILE] [setting=value ...]
    python -m benchmarks.robot.sensors defaults furuta=FOLDER [the same, without delay=]

The cart-pole's state has neither rate measured, and its force acts `delay` periods late. FOLDER holds `robot.py`, which
registers FurutaSafe-v0 and has its `cost`; two encoders of it are all that is observed (encoders.py), for 2 s. With
`defaults` it observes what FurutaSafe-v0 does, differences of the encoders and the voltage before, and nothing of a
model or a search is said.
Every trial is written when it is there. Furuta runs that were stopped after `minutes` go on with the same command.
Tuning seeds are 100 to 119.
"""

import shlex
from collections.abc import Sequence
from pathlib import Path

from benchmarks import command, unfinished
from benchmarks.robot import seeds
from pegasus_jax.checks import ConfigError, choice
from pegasus_jax.runs import config_io
from pegasus_jax.runs.machine import about
from pegasus_jax.runs.programs import share_cpus
from pegasus_jax.runs.study import seed_list, study, table, write

PENDULUM = ("task=gym", "cost=robot:cost", "angles=[1]", "horizon=100", "explore.kind=walk", "eval_episodes=10")
FURUTA = (
    *(*PENDULUM, "env=benchmarks.robot.encoders:TwoEncoders-v0", "start_mean=[0,0]", "start_std=[0.02,0.02]"),
    *("model=lagrangian", "sensors.velocity=difference"),
)
DEFAULTS = (*PENDULUM, "env=robot:FurutaSafe-v0", "start_mean=[0,0,0,0,0]", "start_std=[0.02,0.02,0.01,0.01,0.01]")
CARTPOLE = (
    *("task=cartpole", "sensors.measured=[0,3]", "sensors.velocity=difference", "explore.kind=walk"),
    "search.observation_noise=plant",  # what the model predicts is twice the sensors' noise
    *("model.ensemble_size=5", "fit.steps=1000"),  # what model=lagrangian is on any other plant
)


def cartpole(options: dict[str, str], words: Sequence[str], command: str) -> None:
    """Every seed in one program; its curves are written after each trial."""
    config = config_io.parse(dict(word.split("=", 1) for word in [*CARTPOLE, *words]))
    numbers, out = seed_list(options.get("seeds", "100-109")), unfinished(Path(options["out"]))
    share_cpus(len(numbers))
    result = study(config, numbers, out)
    write(out, result | {"about": about(command)})
    print(table(result), flush=True)


def furuta(options: dict[str, str], words: Sequence[str], command: str) -> None:
    """A process a seed, `jobs` at a time with a core each. Raises ConfigError where there is no robot."""
    seed_by_seed(options, [*FURUTA, *words, f"env_args.delay={options.get('delay', '1')}"], command)


def defaults(options: dict[str, str], words: Sequence[str], command: str) -> None:
    """As `furuta`, of what the environment observes itself. Raises ConfigError for a delay that is not its own."""
    if "delay" in options:
        raise ConfigError(f"delay={options['delay']} is for furuta; this environment is one period late")
    seed_by_seed(options, [*DEFAULTS, *words], command)


def seed_by_seed(options: dict[str, str], words: Sequence[str], command: str) -> None:
    """The runs of these words on the robot of the folder `furuta`, and their table."""
    seeds.robot(options)
    options.setdefault("trials", "13")
    print(seeds.table(seeds.learned(options, words, command)))


KINDS = {"cartpole": cartpole, "furuta": furuta, "defaults": defaults}


def main(given: list[str]) -> None:
    """The command line of this module. Raises ConfigError for what it cannot use."""
    kind, *rest = given or [""]
    choice("the first word", kind, KINDS)
    options, dotted = config_io.split(rest, ("delay", *seeds.OPTIONS))
    options.setdefault("out", f"runs/sensors-{kind}.json")
    words = [f"{key}={value}" for key, value in dotted.items()]
    if kind != "defaults":
        words = [f"sensors.delay={options.get('delay', {'cartpole': '0', 'furuta': '1'}[kind])}", *words]
    if kind == "cartpole":
        words.append(f"trials={options.get('trials', '10')}")
    KINDS[kind](options, words, shlex.join(["python", "-m", "benchmarks.robot.sensors", *given]))


if __name__ == "__main__":
    command(main, __doc__)
