"""What a user's first controller is given: the same of a plant in JAX and of an environment."""

from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

from pegasus_jax.assembly.experiments import compose
from pegasus_jax.config import Sensors
from pegasus_jax.tasks.sensed import sensed
from probes import cart, tiny

H, DT = 8, 0.3
A, B = np.array([[1, DT], [0, 1]]), np.array([DT**2 / 2, DT])  # the probe's cart


class Robot(NamedTuple):
    """What the package asks of an environment."""

    reset: Any
    step: Any
    close: Any = lambda: None


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
