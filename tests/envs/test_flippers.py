"""The swimmer's equations of motion against C MuJoCo's."""

from functools import partial

import jax
import mujoco
import numpy as np
import pytest

from pegasus_envs import physics
from pegasus_envs.swimmer.dynamics import acceleration
from pegasus_envs.swimmer.layout import mechanism
from pegasus_envs.swimmer.plant import swimmer


def in_c(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, command: np.ndarray) -> np.ndarray:
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, command
    mujoco.mj_forward(model, data)
    return data.qacc


def motions(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, velocities and commands [N, ...]: flippers all around, at about a turn a second."""
    rng = np.random.default_rng(0)
    qpos, qvel, command = rng.normal(size=(count, 19)), 5.0 * rng.normal(size=(count, 18)), rng.normal(size=(count, 6))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    return qpos, qvel, command


def test_accelerations_are_those_of_c():
    with jax.enable_x64(True):
        system = physics.load("swimmer.xml")
        accelerate = jax.jit(partial(acceleration, mechanism(system)))
        for qpos, qvel, command in zip(*motions(10), strict=True):
            exact = in_c(system.host, qpos, qvel, command)
            np.testing.assert_allclose(accelerate(qpos, qvel, command), exact, atol=1e-11 * np.abs(exact).max())


def test_every_constant_counts():
    """Each link with a mass, an inertia, a length and hinges of its own, in a thicker fluid."""
    rng, changes = np.random.default_rng(1), [("opt.density", (), 700.0), ("opt.viscosity", (), 0.3)]
    for field in ("body_mass", "body_inertia", "jnt_stiffness", "dof_damping", "dof_armature"):
        value = getattr(physics.default("swimmer.xml"), field)
        factor = rng.uniform(0.8, 1.25, (len(value), *(1,) * (value.ndim - 1)))  # the box keeps its shape
        changes += [(field, ..., value * factor)]
    for hip in range(2, 14, 2):
        changes += [("body_pos", hip, rng.normal(size=3)), ("body_pos", (hip + 1, 0), rng.normal())]
        changes += [("body_ipos", (body, 0), rng.normal()) for body in (hip, hip + 1)]
    gains = rng.uniform(50.0, 100.0, 6)
    changes += [("actuator_gainprm", (slice(None), 0), gains), ("actuator_biasprm", (slice(None), 1), -gains)]
    with jax.enable_x64(True):
        system = physics.load("swimmer.xml", changes)
        accelerate = jax.jit(partial(acceleration, mechanism(system)))
        for qpos, qvel, command in zip(*motions(5), strict=True):
            exact = in_c(system.host, qpos, qvel, command)
            np.testing.assert_allclose(accelerate(qpos, qvel, command), exact, atol=1e-11 * np.abs(exact).max())


@pytest.mark.slow
def test_a_batch_equals_its_members():
    """A plant's step under `vmap`, with states, controls, or both batched, and within another `vmap`."""
    plant = swimmer("knife_edge", 6)
    states = jax.vmap(plant.reset)(jax.random.split(jax.random.key(0), 4))
    controls = np.random.default_rng(0).uniform(plant.control_low, plant.control_high, (4, 18)).astype(np.float32)
    step = jax.jit(plant.step)
    pick = lambda i: jax.tree.map(lambda leaf: leaf[i], states)  # noqa: E731

    def check(found, wanted):
        jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4), found, wanted)

    both = jax.jit(jax.vmap(plant.step))(states, controls)
    every = jax.jit(jax.vmap(lambda state: jax.vmap(lambda control: plant.step(state, control))(controls)))(states)
    for i in range(4):
        check(jax.tree.map(lambda leaf, i=i: leaf[i], both), step(pick(i), controls[i]))
        check(jax.tree.map(lambda leaf, i=i: leaf[i, 1], every), step(pick(i), controls[1]))


def test_a_plant_may_be_built_inside_jit_first():
    build = lambda: swimmer("knife_edge", 2, hull_mass=14.9)  # noqa: E731  (constants that no other test asks for)
    depth = lambda key: build().observe(build().reset(key))[3]  # noqa: E731
    assert jax.jit(depth)(jax.random.key(0)) == depth(jax.random.key(0))
