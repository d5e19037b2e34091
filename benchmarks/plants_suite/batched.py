"""The suite's plants as MJCF tasks, so that all seeds of one are learned as one program: quick on a GPU.

    python -m benchmarks.plants_suite.batched PLANT NAME seeds=100-119 [trials=12] [setting=value ...]

Writes and prints what benchmarks.study does. States are the joints' positions and rates, so that this says how well
models and searches do, and nothing of what a state is; the suite itself (__main__.py) judges by native returns.
"""

from functools import partial
from pathlib import Path

import gymnasium

from benchmarks import command, named, study
from benchmarks.plants_suite.plants import task
from pegasus_jax.checks import ConfigError, did_you_mean

ASSETS = Path(gymnasium.__file__).parent / "envs/mujoco/assets"
of_joints = partial(task, module="costs_of_joints")
PLANTS: dict[str, tuple[str, ...]] = {
    "pendulum": (
        f"mjcf={Path(__file__).with_name('pendulum.xml')}",
        *of_joints(40, "pendulum", angles="[0]"),
        "dt=0.05",
        "start_mean=[3.14159,0]",
        "start_std=[1.8,0.6]",
    ),
    "inverted_pendulum": (
        f"mjcf={ASSETS}/inverted_pendulum.xml",
        *of_joints(50, "inverted_pendulum", "inverted_pendulum_falls", angles="[1]"),
        "dt=0.04",
        "start_std=[0.006]",
    ),
    "inverted_double_pendulum": (
        f"mjcf={ASSETS}/inverted_double_pendulum.xml",
        *of_joints(40, "double_pendulum", "double_pendulum_falls", angles="[1,2]"),
        "dt=0.05",
        "start_std=[0.06,0.06,0.06,0.1,0.1,0.1]",
    ),
    "reacher": (
        f"mjcf={ASSETS}/reacher.xml",
        *of_joints(50, "reacher", angles="[0,1]"),
        "dt=0.02",
        "observe=[qpos.0,qpos.1,qpos.2,qpos.3,qvel.0,qvel.1]",
        "start_mean=[0,0,0,0,0,0]",
        "start_std=[0.06,0.06,0.1,0.1,0.003,0.003]",
    ),
}


def main(words: list[str]) -> None:
    """The command line of this module."""
    plant, rest = named(words, f"one of {', '.join(PLANTS)}")
    if plant not in PLANTS:
        raise ConfigError(f"{plant} is unknown; {did_you_mean(plant, PLANTS)}")
    name, rest = named(rest, "the name of the file that this writes, without .json")
    study.main([name, "task=mjcf", *PLANTS[plant], *rest], f"benchmarks.plants_suite.batched {plant}")


if __name__ == "__main__":
    command(main, __doc__)
