"""The cart-poles against the paper's equations, against C MuJoCo and against conservation of energy."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.plants.in_c import in_c
from envs import references
from envs.references import simulated
from pegasus_envs import physics
from pegasus_envs.cartpole import cartpole
from pegasus_envs.double_cartpole import double_cartpole
from pegasus_envs.plant import saturating, simulate

RATES = {4: references.cartpole_rate, 6: references.double_cartpole_rate}


@pytest.fixture(params=["cart", "double"])
def system(request):
    return request.getfixturevalue(request.param)


def errors(system, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Largest error over the state at each time, against the paper's equations and against C MuJoCo, from hanging."""
    state, controls = (
        system.plant.state_from_observation(system.plant.start_mean.astype(np.float32)),
        system.random(seed),
    )
    xs = np.asarray(system.run(state, controls), float)
    exact = references.integrate(RATES[xs.shape[1]], xs[0], controls)
    qpos, qvel, _ = in_c(system.plant, state.qpos, state.qvel, controls)
    c = np.stack([system.plant.observe(physics.Motion(q, v)) for q, v in zip(qpos, qvel, strict=True)])
    return np.abs(xs - exact).max(axis=1)[1:], np.abs(xs[1:] - c).max(axis=1)


@pytest.mark.parametrize("seed", range(5))
def test_follows_the_papers_equations_and_c(system, seed):
    """After 2.5 s and 3 s; the double pendulum is chaotic, so its bar is wider."""
    tolerance = 1e-3 if len(system.plant.start_mean) == 4 else 1e-2
    against_equations, against_c = errors(system, seed)
    assert against_equations.max() < tolerance
    assert against_c.max() < tolerance


def test_errors_of_the_double_cartpole_grow_from_rounding(double):
    """Chaos multiplies what single precision rounds off, by ten each half second or so; little else is in the error.

    A force sequence that balances a rod for a moment makes more of it, which is why this takes the median of many.
    """
    growth = np.stack([errors(double, seed)[0] for seed in range(12)])[:, 4::5]
    median = np.median(growth, axis=0)
    print("error each half second: median", median, "worst", growth.max(axis=0))
    assert median[0] < 5e-6
    assert median[-1] < 1e-3
    assert median[-1] > 10 * median[0]
    assert (growth[:, -1] < 1e-2).mean() > 0.8


@pytest.mark.parametrize(("construct", "tilt"), [(cartpole, 2.0), (double_cartpole, 1.0)])
def test_keeps_its_energy_without_friction(construct, tilt):
    plant = construct(friction=0.0)
    x = jnp.asarray(plant.start_mean).at[np.array(plant.angles)].add(tilt)
    xs = np.asarray(jax.jit(lambda x: simulate(plant, plant.state_from_observation(x), jnp.zeros((100, 1))))(x), float)
    energy = references.energy(xs)
    # The zero of energy is a matter of taste: compare with what there is above the hanging rest.
    rest = references.energy(np.asarray(plant.start_mean)[None])[0]
    assert np.ptp(xs[:, plant.angles[-1]]) > 1.0
    assert np.abs(energy - energy[0]).max() < 1e-3 * (energy[0] - rest)


def test_constructor_and_file_agree_on_the_constants():
    for construct, name in ((cartpole, "cartpole.xml"), (double_cartpole, "double_cartpole.xml")):
        built, written = construct().model, physics.default(name)
        for field in ("body_mass", "body_inertia", "body_ipos", "body_pos", "dof_damping", "geom_pos", "geom_size"):
            np.testing.assert_allclose(getattr(built, field), getattr(written, field), atol=1e-12, err_msg=field)
        np.testing.assert_array_equal(built.opt.gravity, written.opt.gravity)


def test_limits_of_the_paper(cart, double):
    assert (cart.plant.control_high, cart.plant.horizon, cart.plant.dt, cart.plant.width) == (10.0, 25, 0.1, 0.25)
    assert (double.plant.control_high, double.plant.horizon, double.plant.dt, double.plant.width) == (
        20.0,
        30,
        0.1,
        0.5,
    )


def test_force_is_held_and_clipped(system):
    plant, state = system.plant, system.start(3)
    high = plant.control_high.astype(np.float32)
    ten = np.tile(high, (10, 1))
    np.testing.assert_array_equal(system.run(state, ten), system.run(state, 7.0 * ten))
    assert not np.array_equal(system.run(state, ten), system.run(state, 0.99 * ten))
    # A force that changed within the period, or reached it late, would miss what the equations do with a held one.
    xs = np.asarray(system.run(state, ten), float)
    exact = references.integrate(RATES[xs.shape[1]], xs[0], ten)
    np.testing.assert_allclose(xs[1], exact[1], atol=1e-5)


def test_goal_is_where_the_tip_stands_upright(cart, double):
    for plant, upright in ((cart.plant, [0, 0, 0, np.pi]), (double.plant, [0.0] * 6)):
        assert saturating(plant, jnp.asarray(upright)) < 1e-10
        beside = jnp.asarray(upright).at[0].add(0.3)
        assert np.isclose(saturating(plant, beside), 1 - np.exp(-0.5 * (0.3 / plant.width) ** 2), rtol=1e-4)
        full_turn = jnp.asarray(plant.start_mean).at[plant.angles[0]].add(2 * np.pi)
        assert np.isclose(saturating(plant, full_turn), saturating(plant, jnp.asarray(plant.start_mean)), atol=1e-6)


def test_error_points_at_the_tip_that_mujoco_sees(cart, double):
    for system in (cart, double):
        plant = system.plant
        states = [
            plant.state_from_observation(x) for x in np.random.default_rng(0).normal(size=(5, len(plant.start_mean)))
        ]
        for state in states:
            tip = _geom(plant, np.asarray(state.qpos), "tip") - _geom(plant, np.asarray(state.qpos), "goal")
            np.testing.assert_allclose(jnp.abs(plant.error(plant.observe(state))), np.abs(tip[[0, 2]]), atol=1e-5)


def _geom(plant, qpos, name):
    import mujoco

    data = mujoco.MjData(plant.model)
    data.qpos[:] = qpos
    mujoco.mj_forward(plant.model, data)
    return data.geom(name).xpos


def test_constants_can_be_mapped_over(cart):
    lengths, frictions = jnp.array([0.4, 0.6, 0.9]), jnp.array([0.0, 0.1, 0.5])
    state, controls = cart.start(1), cart.random(1, 10)

    def run(length, friction):
        plant = cartpole(pole_length=length, friction=friction)
        xs = simulate(plant, state, controls)
        return xs, plant.error(xs[-1])

    xs, goal = jax.jit(jax.vmap(run))(lengths, frictions)
    for i, (length, friction) in enumerate(zip(lengths.tolist(), frictions.tolist(), strict=True)):
        exact = references.integrate(RATES[4], xs[i, 0], controls, length=length, friction=friction)
        np.testing.assert_allclose(xs[i], exact, atol=1e-3)
        tip = exact[-1, 0] + length * np.sin(exact[-1, 3]), length * (np.cos(exact[-1, 3]) + 1)
        np.testing.assert_allclose(goal[i], tip, atol=1e-3)
    changed = cartpole(pole_length=0.9, gravity=1.6).model
    assert np.isclose(changed.body("pole").ipos[2], -0.45)
    assert changed.opt.gravity[2] == -1.6
    assert physics.default("cartpole.xml").opt.gravity[2] == -9.82


def test_constants_of_the_double_cartpole_can_be_mapped_over(double):
    lengths, masses = jnp.array([0.6, 0.9]), jnp.array([0.5, 0.8])
    state, controls = double.start(1), double.random(1, 10)
    run = jax.vmap(
        lambda l, m: simulate(double_cartpole(outer_length=l, inner_mass=m, friction=0.2 * l), state, controls)
    )
    xs = jax.jit(run)(lengths, masses)
    for x, length, mass in zip(xs, lengths.tolist(), masses.tolist(), strict=True):
        plant = double_cartpole(outer_length=length, inner_mass=mass, friction=0.2 * length)
        qpos, qvel, _ = in_c(plant, state.qpos, state.qvel, controls)
        exact = [plant.observe(physics.Motion(q, v)) for q, v in zip(qpos, qvel, strict=True)]
        np.testing.assert_allclose(x[1:], exact, atol=1e-3)
    assert np.abs(xs[0, -1] - xs[1, -1]).max() > 0.1


def test_start_has_the_stated_spread(cart):
    x = jax.vmap(lambda key: cart.plant.observe(cart.plant.reset(key)))(jax.random.split(jax.random.key(0), 4000))
    np.testing.assert_allclose(x.mean(axis=0), cart.plant.start_mean, atol=0.02)
    np.testing.assert_allclose(x.std(axis=0), cart.plant.start_std, atol=0.01)


def test_place_is_the_inverse_of_observe(system):
    x = np.random.default_rng(0).normal(size=len(system.plant.start_mean)).astype(np.float32)
    np.testing.assert_allclose(system.plant.observe(system.plant.state_from_observation(x)), x, atol=1e-6)


@pytest.mark.parametrize("construct", [cartpole, pytest.param(double_cartpole, marks=pytest.mark.slow)])
def test_gradient_matches_finite_differences(construct):
    with jax.enable_x64(True):
        plant = construct()
        state = plant.state_from_observation(jnp.array([0.1, -0.2, 0.3, 0.4, 1.0, 2.0])[: len(plant.start_mean)])
        controls = jnp.asarray(np.random.default_rng(0).uniform(-8, 8, (5, 1)))
        final = jax.jit(lambda force: simulate(plant, state, controls.at[1, 0].set(force))[-1])
        gradient = jax.jit(jax.jacfwd(final))(2.0)
        step = 1e-5
        np.testing.assert_allclose(gradient, (final(2.0 + step) - final(2.0 - step)) / (2 * step), rtol=1e-7, atol=1e-9)
        assert np.abs(gradient).min() > 1e-3


@pytest.mark.slow
def test_double_precision_agrees_with_mjx_step():
    from mujoco import mjx

    with jax.enable_x64(True):
        system = physics.load("double_cartpole.xml")
        motion = physics.Motion(jnp.array([0.1, 2.0, 0.5]), jnp.array([0.3, -1.0, 2.0]))
        data = system.blank.replace(qpos=motion.qpos, qvel=motion.qvel, ctrl=jnp.array([7.0]))
        theirs = jax.jit(lambda data: mjx.step(system.device, data))(data)
        accelerate = partial(physics.acceleration, system)
        ours = jax.jit(lambda motion: physics.advance(accelerate, motion, jnp.array([7.0]), 0.0025))(motion)
        np.testing.assert_allclose(ours.qpos, theirs.qpos, rtol=1e-13)
        np.testing.assert_allclose(ours.qvel, theirs.qvel, rtol=1e-13)


def test_module_shares_nothing_between_precisions():
    with jax.enable_x64(True):
        assert simulated(cartpole()).plant.observe(cartpole().state_from_observation(jnp.zeros(4))).dtype == jnp.float64
    assert cartpole().observe(cartpole().state_from_observation(jnp.zeros(4))).dtype == jnp.float32
