"""The pictures of the documentation: every plant, and an episode of a run.

    python -m benchmarks.pictures [run=runs/cartpole-seed0]
    python -m benchmarks.pictures plants

Writes docs/pictures/cartpoles.png and swimmer.png: every plant, at its start and at its goal. With a run also
swingup.png: a learned episode, frame by frame. The curves of benchmarks/results are drawn by benchmarks.results_page.
"""

import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from pegasus_envs.cartpole import cartpole
from pegasus_envs.double_cartpole import double_cartpole
from pegasus_envs.plant import Plant
from pegasus_envs.render import frames
from pegasus_envs.swimmer.goals import Task
from pegasus_envs.swimmer.plant import swimmer
from pegasus_jax.runs import config_io
from pegasus_jax.runs.restore import ready

PICTURES = Path(__file__).parents[1] / "docs" / "pictures"


def poses() -> dict[str, list[tuple[str, Plant, Any]]]:
    """File -> title, plant and x of each of its pictures."""
    upright, hanging = np.pi, np.zeros(4)
    cart, double = cartpole(), double_cartpole()
    hips = 0.5 * np.sin(np.arange(6) * 2.0)

    def swims(task: Task, roll: float, pitch: float = 0.0, depth: float = 1.0) -> tuple[str, Plant, Any]:
        x = np.concatenate([[roll, pitch, 0.0, depth, 0.0, 0.0, 0.0], hips])
        return task.replace("_", " "), swimmer(task, 6), x

    return {
        "cartpoles.png": [
            ("cart-pole: start", cart, hanging),
            ("goal", cart, np.array([0.0, 0.0, 0.0, upright])),
            ("double cart-pole: start", double, double.start_mean),
            ("on the way", double, np.array([0.3, 0.0, 0.0, 0.0, 0.6, -1.0])),
            ("goal", double, np.zeros(6)),
        ],
        "swimmer.png": [
            swims("knife_edge", np.pi / 2),
            swims("belly_up", np.pi),
            swims("corkscrew", -0.8),
            swims("depth_change", 0.0, 0.5, 1.6),
        ],
    }


def plants() -> None:
    """Draw every plant of pegasus_envs."""
    for name, row in poses().items():
        figure, axes = plt.subplots(1, len(row), figsize=(2.4 * len(row), 2.1), dpi=80)
        for axis, (title, plant, x) in zip(axes, row, strict=True):
            (picture,) = frames(plant, [plant.state_from_observation(jnp.asarray(x, jnp.float32))], 280, 220)
            axis.imshow(picture)
            axis.set_title(title, fontsize=9)
            axis.axis("off")
        figure.tight_layout(pad=0.2)
        figure.savefig(PICTURES / name, bbox_inches="tight")
        plt.close(figure)


def swing_up(run: Path, path: Path, shown: int = 9) -> None:
    """Frames of one evaluation episode of a run's newest policy, side by side."""
    _, experiment, state = ready(run)
    episode = jax.jit(experiment.episode)(jax.random.key(1), state.policy.params, jnp.asarray(False))
    plant = experiment.task.plant
    times = np.linspace(0, experiment.task.horizon, shown).round().astype(int)
    pictures = frames(plant, [plant.state_from_observation(episode.x[t]) for t in times], 320, 320)
    figure, axes = plt.subplots(1, shown, figsize=(1.5 * shown, 1.8))
    for axis, t, picture in zip(axes, times, pictures, strict=True):
        axis.imshow(picture)
        axis.set_title(f"{t * experiment.task.dt:.1f} s", fontsize=9)
        axis.axis("off")
    figure.tight_layout(pad=0.3)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def main(words: list[str]) -> None:
    """The command line of this module."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    plants()
    if words == ["plants"]:
        return
    options, _ = config_io.split(words, ("run",))
    swing_up(Path(options.get("run", "runs/cartpole-seed0")), PICTURES / "swingup.png")


if __name__ == "__main__":
    main(sys.argv[1:])
