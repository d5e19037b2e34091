"""The plants as Gymnasium environments: the checker's contract, seeds, rewards, pictures, cheap imports."""

import os
import subprocess
import sys
import warnings

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from pegasus_envs import IDS
from pegasus_envs.gym_env import PlantEnv
from pegasus_envs.plant import FRAME, saturating
from pegasus_envs.render import Renderer, frames, unstack

# Gymnasium's own environments get these two: controls in physical units, sensors without bounds.
HARMLESS = ("symmetric and normalized space", "Box observation space")


@pytest.mark.parametrize("name", IDS)
def test_every_id_passes_the_checker(name):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        env = gymnasium.make(name, render_mode="rgb_array")
        check_env(env.unwrapped)
    env.close()
    problems = [str(warning.message) for warning in caught if "gymnasium" in warning.filename]
    assert [text for text in problems if not any(part in text for part in HARMLESS)] == []


@pytest.fixture
def env():
    env = gymnasium.make("pegasus/CartPoleSwingUp-v0", render_mode="rgb_array")
    yield env
    env.close()


def test_reward_is_minus_the_cost_of_the_true_state(env):
    env.reset(seed=1)
    plant, noise = env.unwrapped.plant, []
    for step in range(plant.horizon):
        x, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert np.isclose(-reward, saturating(plant, jnp.asarray(info["x"])), atol=1e-6)
        assert (terminated, truncated) == (False, step == plant.horizon - 1)
        noise.append(x - info["x"])
    assert 0.005 < np.std(noise) < 0.015


def test_seed_decides_start_and_noise(env):
    first, again, other = (env.reset(seed=seed)[0] for seed in (5, 5, 6))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    x, info = env.reset(options={"x": [0.1, 0.2, 0.3, 0.4]})
    np.testing.assert_allclose(info["x"], [0.1, 0.2, 0.3, 0.4], atol=1e-6)
    np.testing.assert_allclose(x, info["x"], atol=0.06)


def test_environments_of_one_kind_share_one_compilation():
    make = lambda: gymnasium.make("pegasus/CartPoleSwingUp-v0").unwrapped  # noqa: E731
    assert make()._compiled is make()._compiled


@pytest.mark.parametrize(
    "name", ["pegasus/CartPoleSwingUp-v0", "pegasus/DoubleCartPole-v0", "pegasus/Swimmer2KnifeEdge-v0"]
)
def test_pictures_show_the_motion(name):
    plant = gymnasium.make(name).unwrapped.plant
    low, high = (plant.state_from_observation(jnp.asarray(plant.start_mean + tilt, jnp.float32)) for tilt in (0.0, 0.3))
    one, two, same = frames(plant, [low, high, low], width=160, height=120)
    assert one.shape == (120, 160, 3)
    assert one.std() > 10
    assert np.abs(one.astype(int) - two).max() > 50
    np.testing.assert_array_equal(one, same)


@pytest.mark.parametrize(
    "name", ["pegasus/CartPoleSwingUp-v0", "pegasus/DoubleCartPole-v0", "pegasus/Swimmer2KnifeEdge-v0"]
)
def test_a_film_ends_each_period_where_the_plant_does(name):
    """`substates` passes through `FRAME`-spaced states, none like the one before it, to the state that `step` gives."""
    plant = gymnasium.make(name).unwrapped.plant
    state = plant.state_from_observation(jnp.asarray(plant.start_mean + 0.1, jnp.float32))
    control = jnp.asarray(0.7 * plant.control_high, jnp.float32)
    on_the_way, after = jax.jit(plant.substates)(state, control), jax.jit(plant.step)(state, control)
    positions = np.stack([plant.qpos(entry) for entry in unstack(on_the_way)])
    assert len(positions) * FRAME == pytest.approx(plant.dt)
    np.testing.assert_allclose(positions[-1], plant.qpos(after), atol=1e-4)
    assert np.abs(np.diff(positions, axis=0)).max(axis=1).min() > 1e-3


def test_no_way_to_draw_ends_in_advice(monkeypatch, env):
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)
    with pytest.raises(RuntimeError, match="apt-get install libegl1"):
        Renderer(env.unwrapped.plant)


def test_unknown_render_mode_is_refused():
    with pytest.raises(ValueError, match="rgb_array"):
        PlantEnv("pegasus_envs.cartpole:cartpole", render_mode="human")


def test_import_registers_and_does_no_more():
    code = (
        "import sys, pegasus_envs, gymnasium; pegasus_envs.register(); "
        "assert set(pegasus_envs.IDS) <= set(gymnasium.registry); "
        "print([m for m in ('jax', 'mujoco', 'pegasus_jax') if m in sys.modules])"
    )
    path = os.pathsep.join(sys.path)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert (done.stdout.strip(), done.stderr) == ("[]", "")
