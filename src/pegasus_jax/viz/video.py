"""A film of a run's policy on its plant, with cost and command drawn below as they come about."""

import os
import sys
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import imageio.v2 as imageio
import jax
import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image, ImageOps

from pegasus_jax import episode, tasks
from pegasus_jax.assembly.experiments import assembled
from pegasus_jax.checks import RunError
from pegasus_jax.config import Config
from pegasus_jax.runs import restore
from pegasus_jax.runs.collect import failed
from pegasus_jax.runs.files import take_place
from pegasus_jax.task import Task
from pegasus_jax.types import Array, Key, Params, Policy, Trajectory

WIDTH, HEIGHT, STRIP = 640, 480, 192  # [pixels], multiples of the 16 of a video's blocks
COST, CURSOR = "#d1495b", np.array([40, 40, 40], np.uint8)
os.environ.setdefault("IMAGEIO_FFMPEG_NO_PREVENT_SIGINT", "1")  # else it forks by hand, which JAX's threads forbid

EVERY = 0.04  # from one picture of an environment to the next at least [s]
COMING = 0.15  # how much is seen of what is yet to come


class Strip(NamedTuple):
    """Cost and command of one episode against time, as a picture."""

    picture: np.ndarray  # [STRIP, WIDTH, 3] 8-bit colors
    left: int  # column of the episode's first moment [pixels]
    right: int  # column of its last
    top: int  # first row of the axes [pixels]
    bottom: int  # last row of the axes


def film(run: Path, episodes: int, seed: int, trial: restore.Trial = restore.BEST, mjcf: str | None = None) -> Path:
    """Write RUN/play.mp4: `episodes` episodes that are not data, one after the other, in real time.

    An environment is opened for it with render_mode="rgb_array". Raises ConfigError for one that does not render.
    """
    config, experiment, state = restore.ready(run, trial, mjcf)
    task, number = experiment.task, int(state.trial)
    print(restore.chosen(run, trial, number), file=sys.stderr)
    if task.environment is None:
        perform = jax.jit(partial(performance, task=task, policy=experiment.policy))
        keys = jax.random.split(jax.random.key(seed), episodes)
        performed = (until_end(*perform(key, state.policy.params)) for key in keys)
        played = ((ran, pictures(task, states)) for ran, states in performed)
    else:
        played = driven(config, state.policy.params, range(seed, seed + episodes))
    path, writer = run / "play.mp4", None
    # A folder of its own beside: ffmpeg opens no file that was there, and what was at `path`, a link too, is replaced.
    with TemporaryDirectory(dir=run, prefix=".play.") as folder:
        beside = Path(folder) / path.name
        try:
            for place, (trajectory, drawn) in enumerate(played, start=1):
                title = f"{task.name}, trial {number}, episode {place} of {episodes}"
                if writer is None:
                    periods = len(trajectory.u) if task.environment is None else len(drawn) * between(task)
                    writer = _writer(beside, rate=max(1, round(len(drawn) / (periods * task.dt))))
                for picture in composed(drawn, strip(trajectory, task, title)):
                    writer.append_data(picture)
        finally:
            tasks.close(task)
            if writer is not None:
                writer.close()
        take_place(beside, path)
    return path


def performance(key: Key, params: Params, *, task: Task, policy: Policy) -> tuple[Trajectory, Any]:
    """One episode of a policy, and the plant's states on the way [H, n, ...], n a control period."""

    def act(key: Key, t: Array, x: Array) -> Array:
        return policy.apply(params, policy.sample(key), x)

    return episode.run_with_trace(key, act, task, task.plant.substates)


def until_end(ran: Trajectory, states: Any) -> tuple[Trajectory, Any]:
    """An episode and the plant's states on the way [H, n, ...] without the periods after an early end, in NumPy."""
    ran = episode.trimmed(jax.tree.map(np.asarray, ran))
    return ran, jax.tree.map(lambda leaf: np.asarray(leaf)[: len(ran.u)], states)


def driven(config: Config, params: Params, seeds: range) -> Iterator[tuple[Trajectory, list[np.ndarray]]]:
    """One episode a seed on a config's environment, and its pictures on the way, at most one each `EVERY` seconds.

    Raises ConfigError for an environment that does not render, RunError where an episode, or its rendering, failed.
    """
    task, look, drawn = tasks.of_config(config), tasks.camera(config), list[np.ndarray]()
    watched = task._replace(environment=filmed(task.environment, look, between(task), drawn))
    drive: Any = assembled(config, watched, None, 0).drive
    for seed in seeds:
        ran = drive(jax.random.key(seed), params, False)
        failed(ran, task, kept=False)
        yield ran.trajectory, [*drawn] or [fitted(look())]


def between(task: Task) -> int:
    """Control periods of an environment from one picture to the next."""
    return max(1, round(EVERY / task.dt))


def filmed(environment: Any, look: Callable[[], np.ndarray], every: int, drawn: list[np.ndarray]) -> Any:
    """The environment, of which a picture is added to `drawn` after every so many steps, and where it ends early.

    A reset begins a film of its own: it empties `drawn`.
    """
    steps = count(1)

    def reset(seed: int) -> np.ndarray:
        nonlocal steps
        steps = count(1)
        drawn.clear()
        return environment.reset(seed)

    def step(u: np.ndarray) -> tuple[Any, ...]:
        answer = environment.step(u)
        if next(steps) % every == 0 or answer[2]:
            drawn.append(fitted(look()))
        return answer

    return environment._replace(reset=reset, step=step)


def fitted(picture: np.ndarray) -> np.ndarray:
    """A picture of any size as one [HEIGHT, WIDTH, 3]: as large as it can be, black beside it."""
    return np.asarray(ImageOps.pad(Image.fromarray(picture), (WIDTH, HEIGHT)))


def strip(trajectory: Trajectory, task: Task, title: str) -> Strip:
    """Draw an episode's cost and command; a control is held for its period, at whose end the cost is counted."""
    times = task.dt * np.arange(len(trajectory.u) + 1)
    cost, u = np.asarray(trajectory.cost), np.asarray(trajectory.u)
    low, high = np.asarray(task.control_low), np.asarray(task.control_high)
    units = {name.rpartition(" ")[2] for name in task.control_names}
    figure, (above, below) = plt.subplots(2, 1, sharex=True, figsize=(WIDTH / 100, STRIP / 100), dpi=100)
    figure.subplots_adjust(left=0.11, right=0.97, top=0.87, bottom=0.2, hspace=0.2)
    above.plot(times[1:], cost, color=COST, linewidth=1.5)
    above.set(ylim=(-0.05, 1.05), xlim=(0, times[-1]))
    above.set_title(f"{title}: mean cost {episode.charged(cost, task).mean():.3f}", fontsize=8)
    below.step(times, np.concatenate([u, u[-1:]]), where="post", linewidth=1.0)
    margin = 0.05 * (high.max() - low.min())
    below.set_ylim(low.min() - margin, high.max() + margin)
    below.set_xlabel("time [s]", fontsize=7, labelpad=1)
    above.set_ylabel("cost", fontsize=7)
    below.set_ylabel(f"command {units.pop()}" if len(units) == 1 else "command", fontsize=7)
    for axis in (above, below):
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.25)
    figure.align_ylabels()
    canvas: Any = figure.canvas
    canvas.draw()
    picture = np.asarray(canvas.buffer_rgba())[..., :3].copy()
    (left, right), (top, bottom) = above.bbox.intervalx, (above.bbox.y1, below.bbox.y0)
    plt.close(figure)
    return Strip(picture, round(left), round(right), STRIP - round(top), STRIP - round(bottom))


def composed(pictures: list[np.ndarray], drawn: Strip) -> list[np.ndarray]:
    """Each picture above its strip, in which what is yet to come is faint and a line marks the moment."""
    faint = (255 - COMING * (255.0 - drawn.picture)).astype(np.uint8)
    rows, whole = slice(drawn.top, drawn.bottom), []
    for number, picture in enumerate(pictures, start=1):
        now = drawn.left + round((drawn.right - drawn.left) * number / len(pictures))
        below = drawn.picture.copy()
        below[rows, now : drawn.right + 1] = faint[rows, now : drawn.right + 1]
        below[rows, now - 1 : now + 1] = CURSOR
        whole.append(np.concatenate([picture, below]))
    return whole


def pictures(task: Task, states: Any, width: int = WIDTH, height: int = HEIGHT) -> list[np.ndarray]:
    """Pictures [height, width, 3] of states [H, n, ...]. Raises RunError where nothing can be drawn."""

    def flat(leaf: Any) -> np.ndarray:  # sizes are named, because -1 means nothing for a leaf without entries
        return np.asarray(leaf).reshape(leaf.shape[0] * leaf.shape[1], *leaf.shape[2:])

    try:
        return tasks.pictures(task, jax.tree.map(flat, states), width, height)
    except RuntimeError as error:
        raise RunError(str(error).splitlines()[0]) from error


def _writer(path: Path, rate: int) -> Any:
    return imageio.get_writer(path, fps=rate, macro_block_size=16)
