"""Lagrange's equations of a network: finite differences of its energies, conservation, a plant it must learn."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.integrate import solve_ivp

from pegasus_jax.learn import data as dataset
from pegasus_jax.learn.fit import fit
from pegasus_jax.models import dropout
from pegasus_jax.models.lagrangian import LEAST_MASS, Posterior, Units, lagrangian, solve
from pegasus_jax.types import TrainState, Trajectory

SPEEDS = (2, 1)  # x is (cart, pole's speed, cart's speed, pole)


def mechanism(**changes):
    """A model of a cart with a pole, the pole's angle last, speeds in between and in the coordinates' order."""
    pieces = dict(
        states=4,
        controls=1,
        angles=(3,),
        rates=SPEEDS,
        dt=0.1,
        substeps=2,
        hidden=(8,),
        dropout=dropout.none(),
        activation="silu",
    )
    return lagrangian(**{**pieces, **changes})


def truth(x, u, mass=0.5, length=0.6, gravity=9.82):
    """The cart-pole's state a second's tenth later (docs/reference.md 1.1), by twenty steps of RK4; no friction."""

    def rate(s):
        _, turn, speed, angle = s
        d = 8 * mass - 3 * mass * jnp.cos(angle) ** 2
        load = 2 * mass * length * turn**2 * jnp.sin(angle) + 3 * mass * gravity * jnp.sin(angle) * jnp.cos(angle)
        swing = mass * length * turn**2 * jnp.sin(angle) * jnp.cos(angle)
        turned = -3 * (swing + 2 * (2 * mass * gravity * jnp.sin(angle) + u[0] * jnp.cos(angle))) / (length * d)
        return jnp.stack([speed, turned, (load + 4 * u[0]) / d, turn])

    def advance(s, _):
        h = 0.005
        one = rate(s)
        two = rate(s + h / 2 * one)
        three = rate(s + h / 2 * two)
        return s + h / 6 * (one + 2 * two + 2 * three + rate(s + h * three)), None

    return jax.lax.scan(advance, x, None, length=20)[0]


@pytest.fixture(scope="module")
def data():
    """Eight episodes of random forces, hanging at first."""

    def episode(key):
        start, force = jax.random.split(key)
        u = jax.random.uniform(force, (25, 1), minval=-10, maxval=10)
        x = 0.2 * jax.random.normal(start, (4,))
        _, xs = jax.lax.scan(lambda x, u: (truth(x, u),) * 2, x, u)
        return Trajectory(jnp.concatenate([x[None], xs]), u, jnp.zeros(25))

    episodes = jax.jit(jax.vmap(episode))(jax.random.split(jax.random.key(0), 8))
    found = dataset.empty(200, 4, 1)
    for i in range(8):
        found = dataset.add(found, jax.tree.map(lambda leaf: leaf[i], episodes), (3,))  # noqa: B023
    return found


@pytest.fixture(scope="module")
def fitted(data):
    """The model fitted to all but the last two episodes."""
    model = mechanism(hidden=(16, 16), dropout=dropout.log_normal(-10.0, 0.0), kl_weight=0.1)
    known = data._replace(size=jnp.int32(150))
    optimizer = optax.adam(1e-2)
    params = model.init(jax.random.key(1))
    learn = partial(fit, prepare=model.prepare, loss=model.loss, optimizer=optimizer, steps=1500, batch_size=50)
    learner, info = jax.jit(learn)(jax.random.key(2), TrainState(params, optimizer.init(params)), known)
    assert int(info.skipped) == 0
    return model, model.posterior(learner.params, known)


def predictions(model, posterior, x, u, draws=20):
    """Changes [draws, N, D]."""
    keys = jax.random.split(jax.random.key(3), draws)
    one = lambda key: jax.vmap(partial(model.apply, posterior, model.sample(key, posterior)))(x, u).mean  # noqa: E731
    return jax.jit(jax.vmap(one))(keys)


@pytest.mark.slow
def test_it_learns_a_mechanism_from_six_episodes(fitted, data):
    """The next two to 5 % of what changes, at the median; a network of changes is at 10 to 30 % then."""
    model, posterior = fitted
    x, u, y = data.x[150:], data.u[150:], data.y[150:]
    error = jnp.abs(predictions(model, posterior, x, u).mean(0) - y)
    assert np.all(np.median(error, 0) < 0.05 * np.std(y, 0))


def test_draws_differ_and_share_the_kinematics(data):
    """Particles disagree about forces; all of them move a coordinate by about what its speed says."""
    model = mechanism(hidden=(16, 16), dropout=dropout.log_normal(-10.0, 0.0), kl_weight=0.1)
    posterior = jax.jit(lambda key: model.posterior(model.init(key), data))(jax.random.key(1))
    x, u = data.x[:20], data.u[:20]
    drawn = predictions(model, posterior, x, u)
    assert np.all(np.asarray(drawn[:, :, SPEEDS].std(0)) > 0)
    between = 0.1 * (x[:, SPEEDS] + drawn[..., SPEEDS] / 2)  # exact for constant accelerations
    np.testing.assert_allclose(drawn[..., (0, 3)], between, atol=0.1)


@pytest.fixture(scope="module")
def made_up():
    """A mechanism of random numbers in units that are not one, in float64: the pieces of its posterior."""
    with jax.enable_x64(True):
        params = mechanism().init(jax.random.key(0))
        noise = np.random.default_rng(0)
        params |= {"resistance": jnp.asarray(noise.normal(size=(2, 2))), "constant": jnp.array([0.3, -0.2])}
        units = Units(*map(jnp.asarray, ([0.4, 0.0], [0.7, 1.0], [1.5, 6.0], [3.0], np.ones(4), 1)))
    return Posterior(params, units)


def energies(posterior, q):
    """M [2, 2] and V [] at q, in float64."""
    layers = jax.tree.map(np.asarray, posterior.params["network"]["params"])
    features = np.array([(q[0] - 0.4) / 0.7, np.sin(q[1]), np.cos(q[1])])
    hidden = features @ layers["layer_0"]["kernel"] + layers["layer_0"]["bias"]
    out = hidden / (1 + np.exp(-hidden)) @ layers["layer_1"]["kernel"] + layers["layer_1"]["bias"]
    diagonal = LEAST_MASS + np.log1p(np.exp(1 + out[[0, 2]]))
    lower = np.array([[diagonal[0], 0], [out[1], diagonal[1]]])
    return lower @ lower.T, out[3]


def followed(posterior, x, u, periods=1, **changes):
    """x after so many periods of the model's, in steps so small that they are all but exact."""
    with jax.enable_x64(True):
        model = mechanism(substeps=10, **changes)
        step = jax.jit(lambda x: x + model.apply(posterior, [None, jnp.ones(8)], x, jnp.asarray(u)).mean)
        for _ in range(periods):
            x = step(jnp.asarray(x))
    return np.asarray(x)


def test_a_period_is_one_of_lagranges_equations(made_up):
    """d/dt (M v) = d/dq (v' M v / 2 - V) + F, by finite differences and SciPy's integrator."""
    speed, force, step = np.array([1.5, 6.0]), np.array([2.0]), 1e-5
    params = jax.tree.map(np.asarray, made_up.params)

    def rate(_, state):
        """In the data's units of time and speed; coordinates stay in their own."""
        q, v = state[:2], state[2:] / speed
        sides = [(energies(made_up, q + d), energies(made_up, q - d)) for d in np.diag(step * speed * 0.1)]
        mass_slopes = [(up[0] - down[0]) / (2 * step) for up, down in sides]
        potential = np.array([(up[1] - down[1]) / (2 * step) for up, down in sides])
        kinetic = np.array([v @ slope @ v / 2 for slope in mass_slopes])
        turning = sum(slope * part for slope, part in zip(mass_slopes, v, strict=True)) @ v
        push = params["control"] @ (force / 3.0) + params["constant"] - params["resistance"] @ v
        acceleration = np.linalg.solve(energies(made_up, q)[0], push - turning + kinetic - potential)
        return np.concatenate([0.1 * state[2:], speed * acceleration])

    x = np.array([0.3, 4.0, -1.2, 0.8])  # cart, pole's speed, cart's speed, pole
    expected = solve_ivp(rate, (0, 1), x[[0, 3, 2, 1]], rtol=1e-9, atol=1e-9).y[:, -1]
    found = followed(made_up, x, force)
    np.testing.assert_allclose(found[[0, 3, 2, 1]], expected, atol=2e-3 * np.abs(expected - x[[0, 3, 2, 1]]).max())
    assert np.abs(expected - x[[0, 3, 2, 1]]).min() > 0.05


def test_without_forces_energy_stays(made_up, monkeypatch):
    monkeypatch.setattr("pegasus_jax.models.lagrangian.GREATEST_SPEED", 1e3)  # the limit takes a little, else
    calm = {name: np.zeros_like(made_up.params[name]) for name in ("control", "constant", "resistance")}
    posterior = made_up._replace(params=made_up.params | calm)

    def energy(x):
        mass, potential = energies(posterior, x[[0, 3]])
        v = x[[2, 1]] / np.array([1.5, 6.0])
        return v @ mass @ v / 2 + potential

    start = np.array([0.3, 4.0, -1.2, 0.8])
    end = followed(posterior, start, np.zeros(1), periods=4)
    assert np.abs(end - start).max() > 0.5  # it went somewhere
    assert abs(energy(end) - energy(start)) < 1e-5 * abs(energy(start))


def test_a_speed_without_bounds_stays_finite(made_up):
    """Far from any data a rollout may be wrong, never infinite, and its gradient neither."""
    model, posterior = mechanism(), jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), made_up)

    def far(x):
        step = lambda x, _: (x + model.apply(posterior, [None, jnp.ones(8)], x, jnp.array([10.0])).mean, None)  # noqa: E731
        return jax.lax.scan(step, x, None, length=30)[0]

    end, slope = jax.jit(lambda x: (far(x), jax.jacfwd(far)(x)))(jnp.array([50.0, 300.0, -80.0, 1.0]))
    assert np.all(np.isfinite(end))
    assert np.all(np.isfinite(slope))


def test_a_control_and_a_coordinate_that_never_varied_are_not_seen(data):
    """A control of .2 beside one that was always .1, and a cart beside where it always was, move nothing else."""
    model, still = mechanism(controls=2), jnp.full((200, 1), 0.1)
    seen = data._replace(x=data.x.at[:, 0].set(0.3), u=jnp.concatenate([data.u, still], 1))
    x, u = seen.x[7], seen.u[7]

    @jax.jit
    def predicted(x, u):
        posterior = model.posterior(model.init(jax.random.key(1)), seen)
        change = lambda x, u: model.apply(posterior, [None, jnp.ones(8)], x, u).mean  # noqa: E731
        return change(x, u), jax.jacfwd(change, (0, 1))(x, u)

    usual, slopes = predicted(x, u)
    for there in ((x, u.at[1].add(0.1)), (x.at[0].add(0.1), u)):
        changed, _ = predicted(*there)
        np.testing.assert_allclose(changed, usual, rtol=1e-5)
    assert np.all(np.isfinite(usual))
    assert all(np.all(np.isfinite(slope)) for slope in slopes)
    assert np.abs(slopes[1][:, 0]).max() > 0


def test_solve_solves():
    lower = jnp.tril(jax.random.normal(jax.random.key(0), (4, 4))) + 2 * jnp.eye(4)
    force = jax.random.normal(jax.random.key(1), (4,))
    np.testing.assert_allclose(solve(lower, force), np.linalg.solve(lower @ lower.T, force), rtol=1e-4)
