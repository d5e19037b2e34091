"""pegasus-play: a film that can be watched, from a run that has barely begun."""

from __future__ import annotations

from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest

from pegasus_jax.report.play import HEIGHT, STRIP, WIDTH, composed, strip
from pegasus_jax.tasks import make
from pegasus_jax.types import Trajectory
from test_train import call

TINY = ["task=cartpole", "model.hidden=[8]", "policy.hidden=[8]", "search.steps=5", "fit.steps=5", "trials=1"]
TINY += ["search.particles=8"]
OPTIMISED = {"JAX_DISABLE_MOST_OPTIMIZATIONS": "0"}  # twenty episodes take longer than compiling them


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "run"
    done = call("train", *TINY, f"out={folder}", cwd=folder.parent, **OPTIMISED)
    assert done.returncode == 0, done.stderr
    return folder


def test_a_film_of_a_tiny_run(run: Path) -> None:
    done = call("play", run, "seed=3", cwd=run.parent, **OPTIMISED)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.split() == [str(run / "play.mp4")]
    assert not list(run.glob(".play*"))
    reader = imageio.get_reader(run / "play.mp4")
    pictures = [picture.astype(int) for picture in reader]
    assert len(pictures) == 50  # 25 control periods of .1 s
    assert reader.get_meta_data()["fps"] == 20
    assert {picture.shape for picture in pictures} == {(HEIGHT + STRIP, WIDTH, 3)}
    first, last = pictures[0], pictures[-1]
    assert np.abs(first[:HEIGHT] - last[:HEIGHT]).max() > 50  # the pole has moved
    assert np.abs(first[HEIGHT:] - last[HEIGHT:]).max() > 50  # and the curves have appeared


def test_curves_appear_as_time_goes_on() -> None:
    task = make("cartpole")
    u = np.linspace(-10, 10, 25)[:, None]
    drawn = strip(Trajectory(np.zeros((26, 4)), u, np.linspace(1, 0, 25)), task, "title")  # type: ignore[arg-type]
    assert drawn.picture.shape == (STRIP, WIDTH, 3)
    assert 0 < drawn.left < drawn.right < WIDTH
    assert 0 < drawn.top < drawn.bottom < STRIP
    pictures = composed([np.zeros((HEIGHT, WIDTH, 3), np.uint8)] * 50, drawn)
    ink = [np.sum(255 - picture[HEIGHT:].astype(int)) for picture in pictures]
    assert np.all(np.diff(ink[:-1]) > 0)


def test_nothing_to_draw_with_is_one_line(run: Path) -> None:
    done = call("play", run, cwd=run.parent, MUJOCO_GL="glfw", DISPLAY="", WAYLAND_DISPLAY="")
    assert done.returncode == 2
    assert "Cannot draw" in done.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere"], "nowhere is not a run"),
        (["nowhere", "episode=3"], "did you mean 'episodes'"),
        (["a", "b"], "name one run"),
    ],
)
def test_bad_input_is_one_clear_line(words: list[str], message: str, tmp_path: Path) -> None:
    done = call("play", *words, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert message in done.stderr


def test_no_episodes_make_no_film(run: Path) -> None:
    done = call("play", run, "episodes=0", cwd=run.parent)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "episodes=0 is not a whole number" in done.stderr


def test_help_is_there(tmp_path: Path) -> None:
    done = call("play", "--help", cwd=tmp_path)
    assert done.returncode == 0
    assert "episodes=1" in done.stdout
