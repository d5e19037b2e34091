"""Scenarios: every draw is a function of key, block and epoch, so a search may stop and go on anywhere."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from pegasus_jax.imagine import scenarios
from pegasus_jax.math.linalg import standardize
from pegasus_jax.types import Period, Scenarios
from probes import rig, same

STEPS = 7
# The same sampler for every block: two blocks with one key would show as equal draws.
PLAIN = scenarios.Blocks(*[lambda key, posterior: posterior * jax.random.bits(key, (2,))] * 5)
periods = st.builds(Period, *[st.integers(0, STEPS + 1)] * 5)


def chained(key, first, **pieces):
    """The scenarios of STEPS iterations, as a search redraws them one after the other."""

    def step(held, i):
        held = scenarios.redraw(key, i, held, jnp.uint32(1), i == first, **pieces)
        return held, held

    begun = scenarios.begin(key, first, jnp.uint32(1), **pieces)
    return jax.lax.scan(step, begun, first + jnp.arange(STEPS))[1]


def naive(key, first, **pieces):
    """The same, each drawn on its own."""
    return jax.lax.map(lambda i: scenarios.draw(key, i, jnp.uint32(1), **pieces), first + jnp.arange(STEPS))


@settings(max_examples=4, phases=[Phase.generate])  # each compiles: a failure is not worth shrinking
@given(periods, st.integers(0, 2**16), st.integers(0, 20))
def test_periods(period, seed, first):
    """Redrawing what changed equals drawing everything; a draw is kept for its period; no two draws are alike."""
    pieces = dict(blocks=PLAIN, period=period)
    both = jax.jit(lambda key, first: (chained(key, first, **pieces), naive(key, first, **pieces)))
    ours, expected = both(jax.random.key(seed), first)
    assert same(ours, expected)
    seen = {}
    for block, (values, every) in enumerate(zip(ours, period, strict=True)):
        for i, value in enumerate(np.asarray(values), first):
            seen.setdefault((block, i // every if every else 0), []).append(value.tobytes())
    assert all(len(set(values)) == 1 for values in seen.values())
    assert len({values[0] for values in seen.values()}) == len(seen)


def test_a_block_of_random_keys_is_held_as_any_other():
    """A policy of one's own may draw the key that it acts with."""
    keys = PLAIN._replace(policy=lambda key, posterior: jax.random.split(key, 2))
    for period in (Period(policy=3), Period(policy=0)):
        pieces = dict(blocks=keys, period=period)
        ours, expected = jax.jit(lambda key: (chained(key, 2, **pieces), naive(key, 2, **pieces)))(jax.random.key(0))  # noqa: B023
        assert same(jax.random.key_data(ours.policy), jax.random.key_data(expected.policy))


def test_the_belief_of_the_day_reaches_the_draws():
    """The model's draws are of the posterior given, not of one closed over."""
    pieces = dict(blocks=PLAIN, period=Period())
    one, two = (scenarios.draw(jax.random.key(0), 0, jnp.uint32(b), **pieces) for b in (1, 2))
    assert np.array_equal(2 * one.dynamics, two.dynamics)


@pytest.fixture(scope="module")
def drawn():
    r = rig(particles=50)
    return jax.jit(partial(scenarios.draw, step=0, blocks=r.blocks, period=Period()))(
        jax.random.key(0), posterior=r.posterior
    )


def test_shapes_and_one_draw_a_particle(drawn):
    assert drawn.start.shape == (50, 3)
    assert drawn.sensor.shape == drawn.match.shape == (4, 50, 3)
    assert isinstance(drawn, Scenarios)
    for part in (drawn.start, drawn.dynamics[1], drawn.policy[0]):  # log-normal masks, uniforms of the policy
        assert len(np.unique(np.asarray(part), axis=0)) == 50
    assert not np.any(np.asarray(drawn.sensor) == np.asarray(drawn.match))


def test_noise_is_standard_normal_and_fresh_at_every_step(drawn):
    z = np.concatenate([np.asarray(drawn.sensor).ravel(), np.asarray(drawn.match).ravel()])
    np.testing.assert_allclose([z.mean(), z.std()], [0, 1], atol=0.1)
    assert len(np.unique(z)) == len(z)


def test_balanced_noise_has_the_moments_at_every_step():
    r = rig(particles=9, horizon=4)
    blocks = scenarios.blocks(
        dynamics=r.dynamics,
        policy=r.policy,
        start=lambda key: jax.random.normal(key, (3,)),
        particles=9,
        horizon=4,
        standardized_noise=True,
    )
    samplers = blocks.sensor, blocks.match, r.blocks.match

    @jax.jit
    def draw(key):
        return [sampler(jax.random.clone(key), r.posterior) for sampler in samplers]

    *both, plain = draw(jax.random.key(0))
    for z in both:
        assert z.shape == (4, 9, 3)
        np.testing.assert_allclose(z.mean(1), 0, atol=1e-5)
        for at_t in np.asarray(z):
            np.testing.assert_allclose(np.cov(at_t.T), np.eye(3), atol=1e-4)
    np.testing.assert_allclose(standardize(plain), z, atol=1e-4)  # the same draw, balanced
