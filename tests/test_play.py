"""pegasus-play: a film that can be watched, of a policy that was drawn and not learned."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

import imageio.v2 as imageio
import jax
import numpy as np
import pytest

from folders import a_run
from pegasus_envs import mjcf_plant
from pegasus_jax.assembly.experiments import build
from pegasus_jax.runs import config_io
from pegasus_jax.tasks import make
from pegasus_jax.types import Cost, Trajectory
from pegasus_jax.viz.video import HEIGHT, STRIP, WIDTH, composed, performance, pictures, strip, until_end
from test_train import call

ARM = """<mujoco><worldbody><body><joint name="elbow" type="hinge" axis="0 1 0"/>
<geom type="capsule" size=".03" fromto="0 0 0 0 0 -.5"/></body></worldbody>
<actuator><{motor} joint="elbow" ctrlrange="-2 2"/></actuator></mujoco>"""
MOTORS = {"arm": "motor", "arm_with_state": 'general dyntype="filter" dynprm=".1"'}
OPTIMISED = {"JAX_DISABLE_MOST_OPTIMIZATIONS": "0"}  # twenty episodes take longer than compiling them


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return a_run(tmp_path_factory.mktemp("runs") / "run", trials=1)


@pytest.mark.slow
def test_a_film_of_a_tiny_run_replaces_a_link_and_what_it_leads_to_stays(run: Path, tmp_path: Path) -> None:
    """Neither where the film goes nor where it is written is a file that was there opened."""
    kept = tmp_path / "kept"
    kept.write_text("mine")
    for name in ("play.mp4", ".play.mp4"):
        (run / name).symlink_to(kept)
    done = call("play", run, "seed=3", cwd=run.parent, **OPTIMISED)
    assert (done.returncode, done.stderr.startswith("best policy: trial 1")) == (0, True), done.stderr
    assert done.stdout.split() == [str(run / "play.mp4")]
    assert kept.read_text() == "mine"
    assert not (run / "play.mp4").is_symlink()
    mask = os.umask(0)
    os.umask(mask)
    assert (run / "play.mp4").stat().st_mode & 0o777 == 0o666 & ~mask
    assert [path.name for path in run.glob(".play*")] == [".play.mp4"]  # the link that was there
    (run / ".play.mp4").unlink()
    reader = imageio.get_reader(run / "play.mp4")
    pictures = [picture.astype(int) for picture in reader]
    assert len(pictures) == 50  # 25 control periods of .1 s
    assert reader.get_meta_data()["fps"] == 20
    assert {picture.shape for picture in pictures} == {(HEIGHT + STRIP, WIDTH, 3)}
    first, last = pictures[0], pictures[-1]
    assert np.abs(first[:HEIGHT] - last[:HEIGHT]).max() > 50  # the pole has moved
    assert np.abs(first[HEIGHT:] - last[HEIGHT:]).max() > 50  # and the curves have appeared


@pytest.mark.parametrize(
    "name",
    [
        "cartpole",
        pytest.param("double_cartpole", marks=pytest.mark.campaign),
        pytest.param("swimmer_corkscrew", marks=pytest.mark.slow),
        *MOTORS,
    ],
)
def test_every_kind_of_plant_can_be_filmed(name: str, tmp_path: Path) -> None:
    """Also one whose state has a part without entries, as an arm's whose motor has no state of its own."""
    words = {"task": name, "policy.hidden": "[8]"}
    if name in MOTORS:
        (tmp_path / "arm.xml").write_text(ARM.format(motor=MOTORS[name]))
        assert mjcf_plant.read(tmp_path / "arm.xml").na == (name == "arm_with_state")
        plant = {"mjcf": str(tmp_path / "arm.xml"), "cost": "jax.numpy:sum", "dt": ".04", "horizon": "2"}
        words |= {"task": "mjcf", **plant}
    experiment = build(config_io.parse(words))
    params = jax.jit(lambda key: experiment.init(key).policy.params)(jax.random.key(0))  # and no model
    task = experiment.task._replace(horizon=2, cost=Cost(lambda x: x[0]))
    perform = jax.jit(partial(performance, task=task, policy=experiment.policy))
    _, states = perform(jax.random.key(1), params)
    drawn = np.array(pictures(task, states, 64, 48), int)
    assert drawn.shape[1:] == (48, 64, 3)
    assert len(drawn) % 2 == 0
    assert drawn.std() > 0  # something is to be seen


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


@pytest.mark.parametrize(("length", "periods"), [(2, 2), (None, 4)])
def test_a_film_of_a_simulation_ends_where_its_episode_does(length, periods) -> None:
    rows = Trajectory(np.zeros((5, 2)), np.zeros((4, 1)), np.zeros(4), None if length is None else np.int32(length))
    ran, states = until_end(rows, {"q": np.zeros((4, 10, 3))})
    assert (len(ran.x), len(ran.u), len(ran.cost)) == (periods + 1, periods, periods)
    assert states["q"].shape == (periods, 10, 3)


def test_no_episodes_make_no_film(run: Path) -> None:
    done = call("play", run, "episodes=0", cwd=run.parent)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "episodes=0 is out of range" in done.stderr


def test_help_is_there(tmp_path: Path) -> None:
    done = call("play", "--help", cwd=tmp_path)
    assert done.returncode == 0
    assert "episodes=1" in done.stdout
