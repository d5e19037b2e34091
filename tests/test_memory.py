"""What a controller remembers is one computation, in imagination, on a plant, in the data and in what is exported."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pegasus_jax import memory
from pegasus_jax.assembly.experiments import compose
from pegasus_jax.imagine import matching
from pegasus_jax.imagine.rollout import NoiseUse, rollout
from pegasus_jax.imagine.scenarios import blocks, draw
from pegasus_jax.types import NO_MEMORY, Period
from probes import PENDULUM, cart, known, linear_policy, tiny

K, H = 5, 4


def goals(key):
    return jax.random.uniform(key, (1,))


def both():
    """The last two controls, which are seen, the time, and a goal: five entries, of which three are seen."""
    past = memory.past_controls(("u",), [0.5], 2, shown=True)
    return memory.combined(past, memory.clock(0.3), memory.constant(("goal",), goals))


def test_a_combination_has_each_parts_entries():
    whole = both()
    assert whole.names == ("u 1 before", "u 2 before", "t [s]", "goal")
    assert whole.shown == ("u 1 before", "u 2 before", "goal")
    assert not whole.matched
    m = memory.begin(whole, jax.random.key(0), jnp.zeros(2))
    np.testing.assert_allclose(m[:3], [0.5, 0.5, 0.0])
    assert m[3] != memory.begin(whole, jax.random.key(1), jnp.zeros(2))[3]
    see, given, advance = memory.steps(whole)
    for u in (1.0, 2.0, 3.0):
        m = advance(m, jnp.zeros(2), jnp.array([u]))
    np.testing.assert_allclose(m[:3], [3.0, 2.0, 0.9], rtol=1e-6)
    np.testing.assert_allclose(see(m, jnp.array([7.0, 8.0])), [7, 8, 3, 2, m[3]])
    assert given(m, jnp.array([4.0])) == 4
    assert memory.combined() == memory.combined(NO_MEMORY) == NO_MEMORY


def test_two_memories_that_change_the_models_control_are_refused():
    late = memory.past_controls(("u",), [0.0], 1, shown=False)._replace(applied=lambda m, u: m)
    with pytest.raises(ValueError, match="2 memories"):
        memory.combined(late, late)


def test_a_rollout_remembers_what_the_loop_written_out_does():
    """Two states, one control; the model is given the control before, and the policy sees it, with noise on x."""
    late = memory.past_controls(("u",), [0.3], 1, shown=True)._replace(applied=lambda m, u: m)
    policy = linear_policy(3, 1)._replace(memory=late)
    dynamics, noise = known(PENDULUM, 0.2), NoiseUse(policy=0.5)
    start = lambda key: jax.random.normal(key, (2,))  # noqa: E731
    drawn = blocks(dynamics=dynamics, policy=policy, start=start, particles=K, horizon=H, standardized_noise=False)
    given = draw(jax.random.key(0), 0, None, blocks=drawn, period=Period())
    assert given.start.shape == (K, 3)
    assert (given.sensor.shape, given.match.shape) == ((H, K, 2), (H, K, 3))
    gain = jnp.array([[0.4, -0.3, 0.5]])
    rolled = rollout(gain, None, given, dynamics=dynamics, policy=policy, match=matching.keep, noise=noise)
    x, before, blur = np.asarray(given.start[:, :2]), np.full((K, 1), 0.3), 0.0
    for t in range(H):
        u = np.concatenate([x + 0.5 * blur, before], 1) @ np.asarray(gain).T
        np.testing.assert_allclose(rolled.u[t], u, rtol=1e-4, atol=1e-5)
        x = x @ PENDULUM.a.T + before @ PENDULUM.b.T
        before, blur = u, 0.2 * np.asarray(given.sensor[t])
        np.testing.assert_allclose(rolled.x[t + 1], np.concatenate([x, before], 1), rtol=1e-4, atol=1e-5)


def experiment(remembered, **changes):
    return compose(tiny(**changes), cart()._replace(memory=remembered))


@pytest.fixture(scope="module")
def run():
    """An experiment with goals, a clock and past controls, and its first episode."""
    exp = experiment(both())
    state = jax.jit(exp.init)(jax.random.key(3))
    return exp, state, jax.jit(exp.episode)(jax.random.key(4), state.policy.params, False)


def test_an_episodes_memory_follows_from_its_start(run):
    exp, state, ran = run
    rows = memory.replay(exp.task.memory, ran)
    h, u = len(ran.u), np.asarray(ran.u[:, 0])
    np.testing.assert_allclose(rows[:, 0], [0.5, *u], rtol=1e-6)
    np.testing.assert_allclose(rows[:, 1], [0.5, 0.5, *u[:-1]], rtol=1e-6)
    np.testing.assert_allclose(rows[:, 2], 0.3 * np.arange(h + 1), rtol=1e-5)
    assert len(np.unique(rows[:, 3])) == 1
    # The controls are those of the policy, given what it saw.
    see = memory.steps(exp.task.memory)[0]
    seen = jax.vmap(see)(rows[:-1], ran.x[:-1])
    assert seen.shape == (h, 5)
    data = exp.add_episode(state, ran).data
    np.testing.assert_array_equal(data.memory[:h], rows[:-1])
    np.testing.assert_array_equal(data.u[:h], ran.u)


def test_a_cost_of_the_state_alone_is_blind_to_what_is_remembered(run):
    exp = run[0]
    plain = cart().cost
    whole = jnp.arange(6.0)
    assert exp.task.cost.of_state(whole) == plain.of_state(whole[:2])
    cov = jnp.eye(6).at[0, 5].set(0.3)
    assert exp.task.cost.expected(whole, cov) == plain.expected(whole[:2], cov[:2, :2])
    assert exp.task.cost.widen(2.0).of_state(whole) == plain.widen(2.0).of_state(whole[:2])


def test_goals_are_neither_matched_nor_averaged_over(run):
    """Every particle keeps its goal; of past controls alone the particles are redrawn, with their moments."""
    exp, state, ran = run
    state = exp.add_episode(state, ran)
    rolled, _ = jax.jit(exp.imagine)(state)
    assert rolled.x.shape == (9, tiny().search.particles, 6)
    goal = np.asarray(rolled.x[..., 5])
    assert np.array_equal(goal, np.broadcast_to(goal[0], goal.shape))
    assert len(np.unique(goal)) > 1
    np.testing.assert_allclose(rolled.x[1:, :, 2], rolled.u[..., 0], rtol=1e-6)


def test_without_a_memory_nothing_is_carried():
    exp = experiment(NO_MEMORY)
    state = jax.eval_shape(exp.init, jax.random.key(0))
    assert state.data.memory is None
    ran = jax.eval_shape(exp.episode, jax.random.key(0), state.policy.params, False)
    assert ran.memory is None
