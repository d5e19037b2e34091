"""The pictures of the documentation, drawn from a run and from the stored results.

    python -m benchmarks.pictures [run=runs/cartpole-seed0]

Writes docs/pictures/swingup.png (a learned episode, frame by frame) and copies the learning curve of
benchmarks/results/cartpole.png beside it.
"""

import shutil
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.study import RESULTS
from pegasus_envs.render import frames
from pegasus_jax import settings
from pegasus_jax.record import existing
from pegasus_jax.train import newest

PICTURES = Path(__file__).parents[1] / "docs" / "pictures"


def swing_up(run: Path, path: Path, shown: int = 9) -> None:
    """Frames of one evaluation episode of a run's newest policy, side by side."""
    _, experiment, state = newest(existing(run))
    episode = jax.jit(experiment.episode)(jax.random.key(1), state.policy.params, jnp.asarray(False))
    plant = experiment.task.plant
    times = np.linspace(0, experiment.task.horizon, shown).round().astype(int)
    pictures = frames(plant, [plant.place(episode.x[t]) for t in times], 320, 320)
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
    options, _ = settings.split(words, ("run",))
    PICTURES.mkdir(parents=True, exist_ok=True)
    swing_up(Path(options.get("run", "runs/cartpole-seed0")), PICTURES / "swingup.png")
    shutil.copy(RESULTS / "cartpole.png", PICTURES / "cartpole.png")


if __name__ == "__main__":
    main(sys.argv[1:])
