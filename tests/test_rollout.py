"""Rollouts: a scan and a vmap that equal the loop of Alg. 3 written out, particle by particle."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pegasus_jax.imagine import matching
from pegasus_jax.imagine.rollout import UNROLL, NoiseUse, limited, rollout
from pegasus_jax.imagine.scenarios import draw
from pegasus_jax.types import Dynamics, Period, Policy, Prediction, Scenarios
from pegasus_jax.vectorized import Vectorized
from probes import Linear, known, linear_policy, rig

K, H, D = 7, 4, 3
MATCHES = {"match": matching.match, "keep": matching.keep}
NOISE = NoiseUse(policy=0.7, state=0.4)
every_match = pytest.mark.parametrize("match", MATCHES)
seeds = st.integers(0, 2**16)


@pytest.fixture(scope="module")
def jitted():
    """Seed -> scenarios, and (scenarios, match) -> rollout, compiled once."""
    r = rig(K, H)
    scenarios = jax.jit(lambda seed: draw(jax.random.key(seed), 0, r.posterior, blocks=r.blocks, period=Period()))
    roll = {
        name: jax.jit(partial(rollout, dynamics=r.dynamics, policy=r.policy, match=match, noise=NOISE))
        for name, match in MATCHES.items()
    }
    return scenarios, lambda given, name: roll[name](r.params, r.posterior, given)


def match_numpy(x, z):
    """Mean + L z with the library's Cholesky factor, in float64."""
    return x.mean(0) + z @ np.linalg.cholesky(np.cov(x.astype(np.float64).T)).T


@every_match
def test_the_scan_equals_a_python_loop(match, jitted):
    r, given = rig(K, H), jitted[0](3)
    act, predict = jax.jit(r.policy.apply), jax.jit(r.dynamics.apply)
    draws = [jax.tree.map(lambda leaf, k=k: leaf[k], (given.policy, given.dynamics)) for k in range(K)]
    x, blur = np.asarray(given.start), np.zeros((K, D))
    xs, us, stds = [x], [], []
    for t in range(H):
        u, after, std = [], [], []
        for k, (mask, weights) in enumerate(draws):
            u.append(np.asarray(act(r.params, mask, x[k] + NOISE.policy * blur[k])))
            change = predict(r.posterior, weights, x[k], u[k])
            after.append(x[k] + change.mean + NOISE.state * change.std * given.sensor[t, k])
            std.append(change.std)
        x, std = np.array(after), np.array(std)
        blur = std * np.asarray(given.sensor[t])
        if match == "match":
            x = match_numpy(x, np.asarray(given.match[t]))
        xs.append(x)
        us.append(u)
        stds.append(std)
    imagined = jitted[1](given, match)
    for ours, loops in zip(imagined, (xs, us, stds), strict=True):
        assert ours.shape == np.shape(loops)
        np.testing.assert_allclose(ours, np.array(loops), rtol=2e-4, atol=2e-4)


def test_an_unrolled_loop_is_the_loop(jitted, monkeypatch):
    """Three steps at once, of four: neither values nor gradients know of it."""
    r, given = rig(K, H), jitted[0](3)

    def value(params):
        rolled = rollout(
            params, r.posterior, given, dynamics=r.dynamics, policy=r.policy, match=matching.match, noise=NOISE
        )
        return sum(jnp.sum(jnp.sin(leaf)) for leaf in rolled)

    loop = jax.jit(jax.value_and_grad(value))(r.params)
    monkeypatch.setitem(UNROLL, jax.default_backend(), 3)
    again = partial(value)  # a function of its own: what has been traced before is not traced again
    assert "unroll=3" in str(jax.make_jaxpr(again)(r.params))
    unrolled = jax.jit(jax.value_and_grad(again))(r.params)
    for a, b in zip(jax.tree.leaves(loop), jax.tree.leaves(unrolled), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4)


@given(seed=seeds)
def test_the_same_scenarios_give_the_same_bits(jitted, seed):
    scenarios, roll = jitted
    first, second = (roll(scenarios(seed), "match") for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def test_k_particles_are_k_rollouts_of_one(jitted):
    r, given = rig(K, H), jitted[0](5)
    alone = jax.jit(partial(rollout, dynamics=r.dynamics, policy=r.policy, match=matching.keep, noise=NOISE))
    together = jitted[1](given, "keep")
    for k in range(K):
        one = slice(k, k + 1)
        only = Scenarios(
            given.start[one],
            *jax.tree.map(lambda leaf, one=one: leaf[one], (given.dynamics, given.policy)),
            given.sensor[:, one],
            given.match[:, one],
        )
        for a, b in zip(alone(r.params, r.posterior, only), together, strict=True):
            np.testing.assert_allclose(a[:, 0], b[:, k], rtol=1e-5, atol=1e-5)


@every_match
@given(seed=seeds)
def test_permuting_the_scenarios_permutes_the_particles(match, jitted, seed):
    scenarios, roll = jitted
    given = scenarios(seed)
    order = np.random.default_rng(seed).permutation(K)
    mixed = Scenarios(
        given.start[order],
        *jax.tree.map(lambda leaf: leaf[order], (given.dynamics, given.policy)),
        given.sensor[:, order],
        given.match[:, order],
    )
    for a, b in zip(roll(mixed, match), roll(given, match), strict=True):
        np.testing.assert_allclose(a, b[:, order], rtol=1e-3, atol=1e-3)


def test_matched_particles_lose_their_own_path_but_not_their_moments(jitted):
    """With matching, the match noise of step t decides the particles at t; without, it is not read at all."""
    scenarios, roll = jitted
    given = scenarios(8)
    other = given._replace(match=given.match.at[1].multiply(-1))
    kept, kept_other = roll(given, "keep"), roll(other, "keep")
    assert all(np.array_equal(a, b) for a, b in zip(kept, kept_other, strict=True))
    matched, matched_other = roll(given, "match"), roll(other, "match")
    assert np.array_equal(matched.x[:2], matched_other.x[:2])
    assert not np.allclose(matched.x[2], matched_other.x[2], atol=1e-2)


# Pieces whose draws can be read off the trajectories

CONSTANT = Scenarios(
    start=jnp.arange(6.0).reshape(3, 2),
    dynamics=jnp.array([[1.0, 0.0], [0.0, 10.0], [-5.0, 2.0]]),
    policy=jnp.array([3.0, -1.0, 0.5]),
    sensor=jnp.asarray(np.random.default_rng(0).normal(size=(5, 3, 2)), jnp.float32),
    match=jnp.zeros((5, 3, 2)),
)


def model(apply):
    nothing = lambda *a: None  # noqa: E731
    return Dynamics(nothing, nothing, nothing, nothing, nothing, apply)


def controller(apply):
    return Policy(lambda key: None, lambda key: None, apply)


def test_a_particle_holds_its_draws_for_the_whole_trajectory():
    dynamics = model(lambda posterior, draw, x, u: Prediction(draw, jnp.zeros(2)))
    policy = controller(lambda params, noise, x: noise[None])
    imagined = rollout(None, None, CONSTANT, dynamics=dynamics, policy=policy, match=matching.keep)
    steps = np.diff(imagined.x, axis=0)
    np.testing.assert_allclose(steps, np.broadcast_to(CONSTANT.dynamics, (5, 3, 2)), atol=1e-5)
    assert np.array_equal(imagined.u[..., 0], np.broadcast_to(CONSTANT.policy, (5, 3)))
    assert np.array_equal(imagined.x[0], CONSTANT.start)


def test_a_model_of_all_particles_at_once_is_taken_for_the_model_of_one():
    one = model(lambda posterior, draw, x, u: Prediction(draw, jnp.zeros(2)))
    backwards = lambda posterior, draws, x, u: Prediction(draws[::-1], jnp.zeros((3, 2)))  # noqa: E731
    many = one._replace(apply=Vectorized(one.apply, backwards))
    pieces = dict(policy=controller(lambda params, noise, x: noise[None]), match=matching.keep)
    steps = [np.diff(rollout(None, None, CONSTANT, dynamics=d, **pieces).x, axis=0) for d in (one, many)]
    np.testing.assert_allclose(steps[0], steps[1][:, ::-1], atol=1e-5)


@given(*[st.floats(0, 2, width=32)] * 2)
def test_noise_factors_do_what_they_say(policy_factor, state_factor):
    """The controller repeats what it sees, the model stands still: each factor can be read off."""
    std = jnp.array([0.5, 2.0])
    imagined = STILL(NoiseUse(policy_factor, state_factor), std)
    blur = np.asarray(std * CONSTANT.sensor)
    np.testing.assert_allclose(imagined.u[0], imagined.x[0], atol=1e-6)  # the first state is seen as it is
    np.testing.assert_allclose(imagined.u[1:], imagined.x[1:-1] + policy_factor * blur[:-1], atol=1e-5)
    np.testing.assert_allclose(np.diff(imagined.x, axis=0), state_factor * blur, atol=1e-5)
    assert np.array_equal(imagined.std, np.broadcast_to(std, (5, 3, 2)))


@jax.jit
def STILL(noise, std):
    dynamics = model(lambda posterior, draw, x, u: Prediction(jnp.zeros(2), std))
    policy = controller(lambda params, noise, x: x)
    return rollout(None, None, CONSTANT, dynamics=dynamics, policy=policy, match=matching.keep, noise=noise)


def test_the_default_is_the_authors_noise_on_the_policy_input_alone():
    assert NoiseUse() == (1.0, 0.0, None)


@pytest.mark.parametrize("factor", range(2))
def test_no_gradient_flows_through_the_predicted_noise(factor):
    """A policy that could lower its cost by making the model sure of itself must not be told so."""
    noise = NoiseUse(*(float(i == factor) for i in range(2)))
    policy = controller(lambda params, draw, x: jnp.stack([params, x[0]]))  # what the std depends on; what is seen

    def loss(params, through_mean):
        dynamics = model(lambda posterior, draw, x, u: Prediction(through_mean * u[:1] * jnp.ones(2), (u[0] * x) ** 2))
        imagined = rollout(params, None, CONSTANT, dynamics=dynamics, policy=policy, match=matching.keep, noise=noise)
        return jnp.sum(imagined.x[1:] ** 2) + jnp.sum(imagined.u[..., 1] ** 2)

    value, gradient = jax.jit(loss), jax.jit(jax.grad(loss))
    params = jnp.float32(0.1)
    assert value(params, 0.0) != value(2 * params, 0.0)  # the noise does depend on the parameters
    assert gradient(params, 0.0) == 0
    assert gradient(params, 0.1) != 0


# The limit of a particle's gradient


def limited_at(start, limit):
    """(states, gradient by the gain) of a plant that doubles its state each step, 12 steps, from start [K, 1]."""
    one = np.eye(1)
    dynamics, policy = known(Linear(2 * one, one, one, np.zeros(1), np.ones(1), 12)), linear_policy(1, 1)
    none, k = jnp.zeros((12, len(start), 1)), len(start)
    given = Scenarios(jnp.asarray(start), jnp.zeros(k), jnp.zeros(k), none, none)

    def value(gain):
        x = rollout(gain, None, given, dynamics=dynamics, policy=policy, match=matching.keep, limit=limit).x
        return jnp.mean(x[1:]), x

    gradient, x = jax.jit(jax.grad(value, has_aux=True))(jnp.zeros((1, 1)))
    return np.asarray(x), np.asarray(gradient)


def test_a_limit_beyond_every_gradient_changes_nothing(x64):
    free, loose = limited_at([[1.0], [-3.0]], None), limited_at([[1.0], [-3.0]], 1e9)
    np.testing.assert_allclose(loose[1], free[1], rtol=1e-12)


def test_nothing_beyond_the_limit_goes_back_through_a_state(x64):
    """By hand: dx[t+1]/dgain = x[t], and what comes back to x[t+1] is its own 1 / 12 K and the rest, if not dropped."""
    start, limit = np.array([[1.0], [-3.0]]), 0.1
    x, gradient = limited_at(start, limit)
    np.testing.assert_array_equal(x, limited_at(start, None)[0])  # what is imagined does not change
    back, total, dropped = 0.0, 0.0, 0
    for t in reversed(range(12)):
        whole = 1 / 24 + back
        total += whole * x[t].sum()
        back = 2 * whole if 2 * whole <= limit else 0.0
        dropped += back == 0
    np.testing.assert_allclose(gradient, [[total]], rtol=1e-12)
    assert 0 < dropped < 12


def test_a_particle_whose_gradient_overflows_does_not_silence_the_others():
    """Gradients of 1e30 have squares that float32 does not hold."""
    scale = jnp.array([[1.0], [1e30]])
    gradient = jax.grad(lambda x: jnp.sum(scale * limited(x, 2.0)))(jnp.ones((2, 1)))
    assert gradient.tolist() == [[1.0], [0.0]]
