"""What every program does alike: the plants, the rule of `solved`, and the clock. Nothing here knows a program.

    python -m benchmarks.peers.solve.attempt PROGRAM PLANT SEED LIMIT FILE CHECKOUT

is one run: the program learns the plant, and FILE gets a JSON line for every policy that was judged. `__main__` starts
it, with the python that has the program's packages. A peer's clocks begin when its packages are imported and the plant
is compiled; ours begin with the command.
"""

import json
import signal
import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np

FIRST_RESET = 10_000  # the seeds of the judged episodes' starts, as in plants_suite.native
SUCCESS, LAST = 0.2, 5  # our task's rule: the last five steps of an episode cost less than this on average

Control = Callable[[np.ndarray], Any]  # observation -> control


class Plant(NamedTuple):
    """A Gymnasium environment, and when it is solved."""

    env: str
    dt: float  # [s]
    horizon: int  # periods of an episode of the programs that choose it; the environment ends its own
    task: tuple[str, ...]  # words of pegasus-train
    bar: float  # of the value of a policy
    episodes: int  # from which that value is found
    value: Callable[[list[dict[str, float]]], float]  # of one episode's steps, a mean over episodes
    angles: tuple[
        int, ...
    ] = ()  # entries of the observation that are angles, which some programs take as sine and cosine


def success(steps: list[dict[str, float]]) -> float:
    """1 for an episode that succeeds by our task's rule."""
    return float(np.mean([step["cost"] for step in steps[-LAST:]]) < SUCCESS)


def native(steps: list[dict[str, float]]) -> float:
    """The return of an episode."""
    return sum(step["reward"] for step in steps)


PLANTS = {
    "cartpole": Plant(
        "pegasus_envs:pegasus/CartPoleSwingUp-v0",
        0.1,
        25,
        ("task=cartpole",),
        bar=0.9,
        episodes=20,
        value=success,
        angles=(3,),
    ),
    "pendulum": Plant(
        "Pendulum-v1",
        0.05,
        40,
        ("task=gym", "env=Pendulum-v1", "cost=benchmarks.plants_suite.costs:pendulum", "horizon=40"),
        bar=-200.0,
        episodes=10,
        value=native,
    ),
}
PROGRAMS = {  # name -> the module here whose `learn` runs it, and the plants that it can learn
    "pegasus_jax": ("of_ours", ("cartpole", "pendulum")),
    "mc_pilco": ("of_mc_pilco", ("cartpole",)),  # it has no example of Pendulum-v1
    "prob_mbrl": ("of_prob_mbrl", ("cartpole", "pendulum")),
    "sac": ("of_sbx", ("cartpole", "pendulum")),
    "crossq": ("of_sbx", ("cartpole", "pendulum")),
}


def judge(control: Control, env: Any, plant: Plant) -> float:
    """The mean value of a policy's episodes, from fixed starts; it ends early where the bar is out of reach."""
    values: list[float] = []
    best = float(plant.bar > 0)  # of one episode: a success, or a return of 0
    for episode in range(plant.episodes):
        x, _ = env.reset(seed=FIRST_RESET + episode)
        steps, over = list[dict[str, float]](), False
        while not over:
            u = np.asarray(control(x), env.action_space.dtype).reshape(env.action_space.shape)
            x, reward, terminated, truncated, info = env.step(u)
            steps.append({"reward": float(reward), "cost": float(info.get("cost", 0.0))})
            over = terminated or truncated
        values.append(plant.value(steps))
        if (sum(values) + best * (plant.episodes - len(values))) / plant.episodes < plant.bar:
            break
    return float(np.mean(values))


class Counted(gymnasium.Wrapper):
    """The plant as a program sees it, whose periods are counted."""

    periods = 0

    def step(self, action: Any) -> Any:
        self.periods += 1
        return self.env.step(action)


class Attempt:
    """One run. `env` is the plant; `judged` is called with every new policy, and ends the run when it solves.

    The limit is one of CPU time, so that other load on the machine takes nothing from a program. `at_end`, where a
    program sets it, is the policy that is judged when the time is over.
    """

    def __init__(self, plant: Plant, seed: int, limit: float, file: Path, checkout: Path | None = None) -> None:
        self.plant, self.seed, self.limit, self.file, self.checkout = plant, seed, limit, file, checkout
        self.env, self.other = Counted(gymnasium.make(plant.env)), gymnasium.make(plant.env)
        self.at_end: Control | None = None
        for env in (self.env, self.other):  # what compiles is not a program's time
            env.reset(seed=seed)
            env.action_space.seed(seed)
            env.step(env.action_space.sample())
        self.env.periods, self.began, self.used = 0, time.monotonic(), time.process_time()

    def begin(self) -> None:
        """End the program, wherever it is, when its time is over."""

        def over(*_: Any) -> None:
            if self.at_end is not None:
                self.judged(self.at_end)
            raise SystemExit(0)

        signal.signal(signal.SIGPROF, over)
        signal.setitimer(signal.ITIMER_PROF, self.limit)

    def judged(self, control: Control) -> None:
        """Note the value of a policy, on no clock; SystemExit when it reaches the bar."""
        left, _ = signal.setitimer(signal.ITIMER_PROF, 0)
        now, used = time.monotonic(), time.process_time()
        value = judge(control, self.other, self.plant)
        self.note(self.env.periods * self.plant.dt, now - self.began, used - self.used, value)
        if value >= self.plant.bar:
            raise SystemExit(0)
        self.began += time.monotonic() - now
        self.used += time.process_time() - used
        signal.setitimer(signal.ITIMER_PROF, left)  # 0, where it has run out: none

    def note(self, plant: float, wall: float, cpu: float, value: float) -> None:
        """One line of the file."""
        row = {"plant_seconds": plant, "wall_seconds": wall, "cpu_seconds": cpu, "value": value}
        with self.file.open("a") as file:
            file.write(json.dumps({name: round(number, 3) for name, number in row.items()}) + "\n")


def main(words: list[str]) -> None:
    """The command line of this module."""
    program, plant, seed, limit, file, checkout = words
    learn = import_module(f"benchmarks.peers.solve.{PROGRAMS[program][0]}").learn
    attempt = Attempt(PLANTS[plant], int(seed), float(limit), Path(file), Path(checkout))
    learn(attempt, program)


if __name__ == "__main__":
    main(sys.argv[1:])
