"""The pictures and films of the documentation: every plant, and episodes of learned policies.

    python -m benchmarks.pictures [cartpole=RUN] [double_cartpole=RUN] [swimmer=RUN]
    python -m benchmarks.pictures plants

Writes docs/pictures/cartpoles.png and swimmer.png: every plant, at its start and at its goal. Of a plant whose run is
there it writes also a film, cartpole.mp4 and so on, of one episode by the run's best policy; of the cart-pole
swingup.png too, the episode frame by frame. What makes these runs is in RUNS; where there is none, the film stays, and
the command is said. The curves of benchmarks/results are drawn by benchmarks.results_page.
"""

from functools import partial
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

from benchmarks import command, only
from pegasus_envs.cartpole import cartpole
from pegasus_envs.double_cartpole import double_cartpole
from pegasus_envs.plant import Plant
from pegasus_envs.render import frames
from pegasus_envs.swimmer.goals import Task
from pegasus_envs.swimmer.plant import swimmer
from pegasus_jax.checks import ConfigError
from pegasus_jax.runs import store
from pegasus_jax.runs.restore import BEST, best, ready
from pegasus_jax.viz import video

PICTURES = Path(__file__).parents[1] / "docs" / "pictures"
# The words of pegasus-train after which a run's best policy is filmed, and the key of the episode.
RUNS = {
    "cartpole": ("task=cartpole trials=5", 1),
    "double_cartpole": (
        "task=double_cartpole search.steps=604 search.warm_restart=0 search.warm_limit_factor=1 seed=4 trials=21",
        4,  # one that succeeds: not half of them do
    ),
    "swimmer": (
        "preset=swimmer_knife_edge_network task=swimmer_knife_edge model.ensemble_size=5 model.kl_weight=1"
        " seed=27 trials=8",
        1,
    ),
}
SMALLER = 2  # times, than the films of pegasus-play
SMALL = ["-crf", "33", "-preset", "veryslow", "-movflags", "+faststart"]  # of ffmpeg: a page waits for no film


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
    """Frames of one evaluation episode of a run's best policy, side by side."""
    _, experiment, state = ready(run, BEST)
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


def film(run: Path, path: Path, key: int) -> None:
    """A film of one episode of a run's best policy, in real time, with cost and command below."""
    _, experiment, state = ready(run, BEST)
    task = experiment.task
    perform = jax.jit(partial(video.performance, task=task, policy=experiment.policy))
    ran, states = perform(jax.random.key(key), state.policy.params)
    whole = video.composed(video.pictures(task, states), video.strip(ran, task, f"{task.name}, trial {state.trial}"))
    rate = round(len(whole) / (task.horizon * task.dt))
    with imageio.get_writer(path, fps=rate, macro_block_size=16, output_params=SMALL) as writer:
        for picture in whole:
            writer.append_data(np.asarray(Image.fromarray(picture).reduce(SMALLER)))


def of_run(name: str, run: Path) -> None:
    """Film a run, and draw its swing-up; say how good what is filmed is."""
    words, key = RUNS[name]
    if not store.holds(run):
        print(f"{name}.mp4 stays as it is: there is no {run}; pegasus-train {words} out={run} makes it")
        return
    film(run, PICTURES / f"{name}.mp4", key)
    if name == "cartpole":
        swing_up(run, PICTURES / "swingup.png")
    row = store.trials(run)[best(run) - 1]
    success, seconds = row["success_rate"], row["plant_seconds"]
    print(f"{name}.mp4: after {seconds:g} s of plant time, {success:.0%} of 20 episodes succeed")


def main(words: list[str]) -> None:
    """The command line of this module. Raises ConfigError for a word that it does not know, and for what is no run."""
    options = only([] if words == ["plants"] else words, tuple(RUNS))
    for name, run in options.items():
        if not store.holds(Path(run)):
            raise ConfigError(f"{name}={run} is not a run; pegasus-train {RUNS[name][0]} out={run} makes it")
    PICTURES.mkdir(parents=True, exist_ok=True)
    plants()
    for name in RUNS if words != ["plants"] else ():
        of_run(name, Path(options.get(name, f"runs/film-{name}")))


if __name__ == "__main__":
    command(main, __doc__)
