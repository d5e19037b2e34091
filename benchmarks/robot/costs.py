"""Costs of controls, references and goals: all seeds of a task as one program, on one GPU for preference.

    python -m benchmarks.robot.costs TASK out=FILE.json seeds=100-109 [trials=10] [setting=value ...]

A TASK is one of those below. FILE.json is written after every trial, with the raw curves of each seed: success and cost
of 20 evaluation episodes, the total variation of their controls, and how far from the reference or the goal they were.
Tuning seeds are 100 to 119; 200 and above are for a final judgment only.
"""

import shlex
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import command, named, unfinished, written
from benchmarks.robot import asked
from pegasus_jax import sharding
from pegasus_jax.checks import ConfigError, did_you_mean
from pegasus_jax.config import Config
from pegasus_jax.runs import config_io
from pegasus_jax.runs.files import write_json
from pegasus_jax.runs.job import first_states, opened
from pegasus_jax.runs.machine import about
from pegasus_jax.runs.programs import share_cpus
from pegasus_jax.runs.study import SOLVED, first_solved, one_json, seed_list
from pegasus_jax.runs.train import learn

HERE = "benchmarks.robot.asked"
EPISODES = 20
CART = ("task=cartpole", "trials=10")
ARM = Path(__file__).parents[2] / "examples/own_mjcf.xml"
REACHER = Path(gymnasium.__file__).parent / "envs/mujoco/assets/reacher.xml"
ON_FILE = ("task=mjcf", "angles=[0,1]", "trials=8")
TASKS: dict[str, tuple[str, ...]] = {
    "plain": (*CART, f"cost={HERE}:swing_up"),
    "smooth": (*CART, f"cost={HERE}:swing_up_smoothly"),
    "smoother": (*CART, f"cost={HERE}:swing_up_more_smoothly"),
    "cart_follows": (*CART, f"cost={HERE}:follow", f"reference={HERE}:sine"),
    "cart_follows_upright": (
        *CART,
        f"cost={HERE}:follow_upright",
        f"reference={HERE}:sine",
        "starts=[[0,0,0,3.14159]]",
    ),
    "arm_follows": (
        *ON_FILE,
        f"mjcf={ARM}",
        f"cost={HERE}:draw_path",
        f"reference={HERE}:path",
        "dt=0.1",
        "horizon=30",
        "start_mean=[-0.6,1.2,0,0]",
    ),
    "reacher": (
        *ON_FILE,
        f"mjcf={REACHER}",
        "observe=[qpos.0,qpos.1,qvel.0,qvel.1]",
        f"cost={HERE}:reach",
        "goal_low=[-0.14,-0.14]",
        "goal_high=[0.14,0.14]",
        "control_low=[-0.1,-0.1]",  # its motors turn it by 200 rad/s^2 at 1
        "control_high=[0.1,0.1]",
        "dt=0.04",
        "horizon=50",
    ),
}
# How far [m] what a task moves is from where it should be; of x [D] and what is asked, a reference or a goal.
Error = Callable[[Any, Any], Any]
ERRORS: dict[str, Error] = {
    "cart_follows": lambda x, asked_for: jnp.abs(x[0] - asked_for[0]),
    "cart_follows_upright": lambda x, asked_for: jnp.abs(x[0] - asked_for[0]),
    "arm_follows": lambda x, asked_for: jnp.linalg.norm(asked.hand(x) - asked_for),
    "reacher": lambda x, asked_for: jnp.linalg.norm(asked.fingertip(x) - asked_for),
}


def measured(key: Any, params: Any, experiment: Any, error: Error | None) -> dict[str, Any]:
    """What one evaluation episode says: total variation of the controls, root mean square and last error [m]."""
    ran, task = experiment.episode(key, params, False), experiment.task
    found = {"total_variation": jnp.sum(jnp.abs(jnp.diff(ran.u, axis=0)))}
    if error is not None:
        if task.goal is None:
            wanted = jax.vmap(task.reference.value)(task.dt * jnp.arange(task.horizon + 1))
        else:
            wanted = jnp.broadcast_to(ran.memory[-len(task.goal.units) :], (task.horizon + 1, len(task.goal.units)))
        errors = jax.vmap(error)(ran.x, wanted)
        # The first third is for getting there.
        late = errors[task.horizon // 3 :]
        found |= {"rms_error": jnp.sqrt(jnp.mean(late**2)), "last_error": errors[-1]}
    return found


def run(name: str, config: Config, seeds: list[int], out: Path, told: dict[str, Any]) -> dict[str, Any]:
    """The curves of all seeds, written after every trial."""
    curves: dict[str, list[Any]] = {}
    result: dict[str, Any] = {}
    with opened(config, seeds, sharding.evenly(len(seeds))) as job:
        one = partial(measured, experiment=job.experiment, error=ERRORS.get(name))
        several = jax.jit(jax.vmap(jax.vmap(one, (0, None)), (None, 0)))
        keys, began = jax.random.split(jax.random.key(1), EPISODES), time.monotonic()

        def keep(latest: dict[str, Any]) -> None:
            swapped = {what: np.round(np.array(rows), 4).T.tolist() for what, rows in curves.items()}
            result.update(latest | swapped | {"task": name, "seconds": round(time.monotonic() - began), "about": told})
            write_json(out, result)

        writer = one_json(config, seeds, job.experiment.task, keep)

        def trial(number: int, states: Any, rows: list[Any]) -> None:
            for what, values in several(keys, states.policy.params).items():
                curves.setdefault(what, []).append(np.mean(np.asarray(values), 1))
            writer.trial(number, states, rows)

        job = job._replace(writer=writer._replace(trial=trial))
        learn(job, first_states(job))
    return result


def stored(file: str) -> dict[str, Any]:
    """A result of this command. Raises ConfigError for another file."""
    needed = lambda result: {**result, "seconds": result["seconds"], "task": result["task"]}  # noqa: E731
    return written(file, "robot.costs", needed)


def table(result: dict[str, Any]) -> str:
    """One line a seed: the first trial at 90 %, then trial by trial success, and the last measures."""
    measures = [what for what in ("total_variation", "rms_error", "last_error") if what in result]
    lines = [f"{result['task']}: after {result['seconds']} s"]
    for i, (seed, success) in enumerate(zip(result["seeds"], result["success_rate"], strict=True)):
        rates = " ".join(f"{rate:4.0%}" for rate in success)
        last = "  ".join(f"{what} {result[what][i][-1]:.3g}" for what in measures)
        lines.append(f"seed {seed}  first at 90 %: {first_solved(success) or '-':>2}  {rates}  {last}")
    success = np.array(result["success_rate"], float)
    solved = " ".join(f"{np.sum(at >= SOLVED)}" for at in success.T)
    ends = "  ".join(f"{what} {np.mean(np.array(result[what], float)[:, -1]):.3g}" for what in measures)
    lines.append(
        f"seeds at 90 % by trial: {solved} of {len(success)}; mean success {success[:, -1].mean():.0%}; {ends}"
    )
    return "\n".join(lines)


def main(words: list[str]) -> None:
    """The command line of this module; `show FILE.json ...` prints the tables again."""
    name, rest = named(words, f"one of {', '.join(TASKS)}")
    if name == "show":
        print("\n".join(table(stored(file)) for file in rest))
        return
    if name not in TASKS:
        raise ConfigError(f"{name} is unknown; {did_you_mean(name, TASKS)}")
    options, settings = config_io.split(rest, ("seeds", "out"))
    _, own = config_io.split(TASKS[name])
    seeds = seed_list(options.get("seeds", "100-109"))
    out = unfinished(Path(options.get("out", f"runs/costs-{name}.json")))
    share_cpus(len(seeds))
    config = config_io.parse(own | {"eval_episodes": str(EPISODES)} | settings)
    told = about(shlex.join(["python", "-m", "benchmarks.robot.costs", *words]))
    print(table(run(name, config, seeds, out, told)), flush=True)


if __name__ == "__main__":
    command(main, __doc__)
