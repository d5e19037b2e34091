"""Can the swimmer's eight maneuvers be done at all? A feedback on the observation, at the control rate and limits.

    python -m benchmarks.plants.solvability [starts=16]

Writes benchmarks/results/solvability.json and prints it beside the numbers of the measured design study that chose the
swimmer's design (C MuJoCo, another hand-written law, its gains by CMA-ES, 16 starts).
"""

import shlex
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import RESULTS, command, number, only
from benchmarks.plants.feedback import GAINS, ROLL, episodes
from pegasus_envs.swimmer.plant import swimmer
from pegasus_jax.runs.files import write_json
from pegasus_jax.runs.machine import about

COLUMNS = ("mean_square", "roll", "pitch", "yaw", "depth", "rate")
"""mean |e|^2 of 20 s, all terms unweighted; over the last 10 s: RMSE of roll (of roll rate for the corkscrew), pitch,
yaw [degrees], depth [m], and the mean roll rate [degrees/s]"""

STUDY: dict[tuple[int, str], tuple[float, ...]] = {
    (2, "knife_edge"): (0.022, 0.1, 2.3, 2.1, 0.10),
    (2, "belly_up"): (0.052, 0.2, 2.6, 5.5, 0.04),
    (2, "corkscrew"): (0.019, 2.1, 1.9, 1.4, 0.03, -122.0),
    (2, "depth_change"): (0.174, 0.3, 2.9, 3.8, 0.15),
    (6, "knife_edge"): (0.018, 0.2, 3.9, 2.3, 0.08),
    (6, "belly_up"): (0.043, 0.1, 2.5, 6.0, 0.06),
    (6, "corkscrew"): (0.015, 2.9, 0.8, 0.9, 0.02, -122.9),
    (6, "depth_change"): (0.042, 0.0, 1.8, 0.0, 0.01),
}
"""measured design study, same columns; its RMSE include the ripple of the strokes, ours are seen at the control rate"""


def tracking(task: str, legs: int, x: np.ndarray) -> dict[str, float]:
    """The columns for observations [N, H, D] of one maneuver."""
    error = swimmer(task, legs, cost="authors").error  # pyright: ignore[reportArgumentType]
    squares = np.sum(np.asarray(jax.vmap(jax.vmap(error))(jnp.asarray(x))) ** 2, axis=-1)
    late = x[:, x.shape[1] // 2 :]
    aim = ROLL[task]
    roll = late[..., 4] + 2 * np.pi / 3 if aim is None else (late[..., 0] - aim + np.pi) % (2 * np.pi) - np.pi
    depth = late[..., 3] - (2.0 if task == "depth_change" else 1.0)
    rms = lambda values: float(np.sqrt(np.mean(values**2)))  # noqa: E731
    angles = [float(np.degrees(rms(values))) for values in (roll, late[..., 1], late[..., 2])]
    values = (float(squares.mean()), *angles, rms(depth), float(np.degrees(late[..., 4].mean())))
    return {name: round(value, 4) for name, value in zip(COLUMNS, values, strict=True)}


def solvability(legs: int, starts: int) -> dict[str, dict[str, float]]:
    """Task -> columns, for the four maneuvers at once."""
    tasks = [task for some, task in GAINS if some == legs]
    plant = swimmer("knife_edge", legs)  # pyright: ignore[reportArgumentType]
    states = jax.vmap(plant.reset)(jax.random.split(jax.random.key(77), starts))
    states = jax.tree.map(lambda leaf: jnp.tile(leaf, (len(tasks),) + (1,) * (leaf.ndim - 1)), states)
    gains = jnp.repeat(jnp.asarray([GAINS[legs, task] for task in tasks]), starts, axis=0)
    which = jnp.repeat(jnp.arange(len(tasks)), starts)
    xs = np.asarray(jax.jit(lambda *arguments: episodes(plant, tasks, *arguments))(which, gains, states), float)
    return {
        task: tracking(task, legs, x)
        for task, x in zip(tasks, xs.reshape(len(tasks), starts, *xs.shape[1:]), strict=True)
    }


def line(name: str, values: Any) -> str:
    """A row of the table; the rate is the corkscrew's only."""
    return f"{name:28s}" + "".join(f"{value:13.3f}" for value in values)


def main(words: list[str]) -> None:
    """The command line of this module."""
    starts = number(only(words, ("starts",)), "starts", 16)
    rows = {legs: solvability(legs, starts) for legs in (2, 6)}
    print(" " * 28 + "".join(f"{name:>13s}" for name in COLUMNS))
    for (legs, task), reported in STUDY.items():
        measured = list(rows[legs][task].values())
        print(line(f"{task}, {legs} legs", measured if task == "corkscrew" else measured[:-1]))
        print(line("  design study", reported))
    command = shlex.join(["python", "-m", "benchmarks.plants.solvability", *words])
    result = {"starts": starts, "rows": {f"{task}, {legs} legs": rows[legs][task] for legs, task in STUDY}}
    study = {f"{task}, {legs} legs": dict(zip(COLUMNS, values, strict=False)) for (legs, task), values in STUDY.items()}
    write_json(RESULTS / "solvability.json", {**result, "design study": study, "about": about(command)})


if __name__ == "__main__":
    command(main, __doc__)
