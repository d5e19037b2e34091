"""What a user's first controller is given: the same of a plant in JAX and of an environment."""

import shutil
from contextlib import nullcontext
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from folders import TINY, a_run
from pegasus_jax.assembly.experiments import compose
from pegasus_jax.checks import ConfigError
from pegasus_jax.config import Sensors
from pegasus_jax.runs import begin, check, checkpoint, config_io, first
from pegasus_jax.runs.train import train
from pegasus_jax.tasks.circled import of_angles
from pegasus_jax.tasks.sensed import sensed
from pegasus_jax.types import Cost
from probes import cart, tiny

H, DT = 8, 0.3
A, B = np.array([[1, DT], [0, 1]]), np.array([DT**2 / 2, DT])  # the probe's cart


class Robot(NamedTuple):
    """What the package asks of an environment."""

    reset: Any
    step: Any
    close: Any = lambda: None
    rest: Any = lambda: None


def backwards():
    """The probe's cart, its speed first."""
    task = cart(H)
    plant = task.plant._replace(observe=lambda x: x[::-1])
    known = dict(state_names=("v", "x"), rates=(0,), start_mean=task.start_mean[::-1], sensor_std=np.zeros(2))
    return task._replace(plant=plant, **known)


def outside():
    """The probe's cart outside of JAX, of which the position is measured."""
    now = np.zeros(2)

    def reset(seed):
        now[:] = 1, 0
        return now[:1].copy()

    def step(u):
        now[:] = A @ now + B * u[0]
        return now[:1].copy(), np.array(u), ""

    robot = Robot(reset, step)
    known = dict(state_names=("x",), rates=(), start_mean=np.ones(1), start_std=np.ones(1), sensor_std=np.zeros(1))
    return cart(H)._replace(plant=None, environment=robot, **known)


@pytest.mark.parametrize(("velocity", "made"), [("difference", backwards), ("filter", backwards), ("filter", outside)])
def test_a_first_controller_is_given_positions_and_their_differences_wherever_the_plant_is(velocity, made):
    """In the places that they have in the state, whatever the policy sees beside them."""
    task = made()
    place = task.state_names.index("x")
    task = task._replace(guide=lambda x: -1.2 * x[place : place + 1] - 0.7 * x[1 - place : 2 - place])
    sensors = Sensors(measured=(place,), velocity=velocity)
    exp = compose(tiny(sensors=sensors), sensed(task, sensors))
    episode_of = jax.jit(exp.episode) if exp.drive is None else exp.episode
    ran = episode_of(jax.random.key(0), exp.policy.init(jax.random.key(1)), True)
    q = np.asarray(ran.x)[:-1, place]
    rate = np.diff(q, prepend=q[0]) / DT
    np.testing.assert_allclose(ran.u[:, 0], np.clip(-1.2 * q - 0.7 * rate, -2, 2), atol=1e-5)
    assert np.abs(rate).max() > 0.5


def test_a_first_controller_drives_a_trial_also_beside_a_simulator():
    """Which needs no random episode: nothing that was asked for is left out without a word."""
    assert config_io.parse({"prior": "simulator:step"}).explore.trials == 0
    assert config_io.parse({"prior": "simulator:step", "explore.policy": "robot:stand"}).explore.trials == 1


# explore.policy=RUN

NETWORK = {"preset": "cartpole_network"}  # compiles faster than a mechanism


def begins(run, **words):
    words = {name.replace("__", "."): text for name, text in words.items()}
    given = {"fit.steps": "2", "eval_episodes": "0", "trials": "2", "explore.trials": "2", "explore.policy": str(run)}
    return config_io.parse(TINY | given | words)


def test_a_run_keeps_the_first_controller_that_it_began_with(tmp_path):
    """Whatever becomes of the run that it is of; of its own run there is one function, until it learns on."""
    config, x = (
        begins(a_run(tmp_path / "old", trials=1, **NETWORK), **NETWORK),
        np.array([1.0, -2.0, 3.0, 0.5], np.float32),
    )
    begun = first.loaded(config).explore.policy
    assert begun is first.loaded(config, tmp_path / "of an earlier version").explore.policy
    (tmp_path / "new").mkdir()
    first.copy(config, tmp_path / "new")
    shutil.rmtree(tmp_path / "old")
    np.testing.assert_array_equal(first.loaded(config, tmp_path / "new").explore.policy(x), begun(x))
    with pytest.raises(ConfigError, match=r"old is neither a run's folder nor a function; expected a folder with con"):
        first.loaded(config)
    a_run(tmp_path / "old", trials=1, seed="1", **NETWORK)
    assert not np.allclose(first.loaded(config).explore.policy(x), begun(x))


@pytest.mark.slow
def test_a_run_goes_on_without_the_run_of_its_first_controller(tmp_path, capfd):
    """Killed after its first episode, it ends as in one piece, though the other run is another one by now."""
    config = begins(a_run(tmp_path / "old", **NETWORK), **NETWORK)
    whole = train(config, tmp_path / "whole")
    assert "episode of explore.policy=" in capfd.readouterr().err
    cut = shutil.copytree(tmp_path / "whole", tmp_path / "cut")
    shutil.rmtree(cut / "checkpoints")
    (cut / "trials.jsonl").unlink()
    (cut / "episodes" / "0002.npz").unlink()
    shutil.rmtree(tmp_path / "old")
    a_run(tmp_path / "old", trials=4, seed="1", **NETWORK)
    assert checkpoint.fingerprint(train(config, cut, resume=True)) == checkpoint.fingerprint(whole)


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (dict(task="double_cartpole"), "is of cartpole with 4 states, and double_cartpole has 6 states"),
        (dict(), ""),
    ],
)
def test_a_first_controller_of_another_plant_is_one_line(words, part, tmp_path):
    config = begins(a_run(tmp_path / "old", **NETWORK), **words)
    with pytest.raises(ConfigError, match=part) if part else nullcontext():
        check.report(config)


def test_a_first_controller_suits_what_is_observed():
    """Also where one run has an angle for a cosine and a sine that the other learned from as they are."""
    task = cart(H)._replace(
        state_names=("cosine", "sine", "q"),
        angles=(2,),
        rates=(),
        **dict.fromkeys(("start_mean", "start_std"), np.ones(3)),
    )
    angle = of_angles(task._replace(cost=Cost(jnp.sum)), ((0, 1),))
    for mine, its in ((task, angle), (angle, task), (task, task)):
        begin.suits("explore.policy=old", mine, its, observed=True)
    begin.suits("explore.policy=old", task._replace(angles=()), task, observed=True)
    with pytest.raises(ConfigError, match=r"old is of .* with angles=\[2\], and .* has angles=\[\]"):
        begin.suits("init=old", task._replace(angles=()), task)
    with pytest.raises(ConfigError, match="with 3 states, and cart has 2 states"):
        begin.suits("init=old", angle, task)
    limits = {"control_low": np.array([-5.0]), "dt": 0.7}
    assert len(begin.otherwise(task, task._replace(**limits))) == 2
