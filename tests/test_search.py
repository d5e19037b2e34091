"""Policy search: the objective against closed forms and finite differences, the optimiser against a loop."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from pegasus_jax.imagine import costs, matching, scenarios
from pegasus_jax.imagine.rollout import NoiseUse
from pegasus_jax.learn.fit import guarded
from pegasus_jax.learn.schedule import Course, narrowing
from pegasus_jax.learn.search import keeping_best, objective, optimise, remembering, started
from pegasus_jax.types import Learner, Period, Scenarios, Searcher
from probes import (
    EMITTERS,
    PENDULUM,
    SCALAR,
    balanced_start,
    cart,
    expected_cost,
    known,
    linear_policy,
    make_rig,
    noisy_linear_policy,
    regression,
    rig,
    same,
)

# The objective on the rig


@pytest.fixture(scope="module")
def on_rig():
    """(seed) -> scenarios, scenarios -> (objective, gradient), compiled once."""
    r = rig()
    draw = jax.jit(lambda seed: scenarios.draw(jax.random.key(seed), 0, r.belief, blocks=r.blocks, period=Period()))
    value = partial(objective, dynamics=r.dynamics, policy=r.policy, match=matching.match, cost=r.cost)
    gradient = jax.jit(jax.value_and_grad(value))
    return draw, lambda given: gradient(r.params, r.belief, given)


@given(seed=st.integers(0, 2**16))
def test_the_same_scenarios_give_the_same_objective_to_the_bit(on_rig, seed):
    draw, value = on_rig
    first, again, other = value(draw(seed)), value(draw(seed)), value(draw(seed + 1))
    assert same(first, again)
    assert not same(first, other)
    assert 0 < first[0] < 1


@given(seed=st.integers(0, 2**16))
def test_the_objective_does_not_depend_on_the_order_of_particles(on_rig, seed):
    draw, value = on_rig
    given = draw(seed)
    order = np.random.default_rng(seed).permutation(rig().particles)
    mixed = Scenarios(
        given.start[order],
        *jax.tree.map(lambda leaf: leaf[order], (given.dynamics, given.policy)),
        given.sensor[:, order],
        given.match[:, order],
    )
    np.testing.assert_allclose(value(mixed)[0], value(given)[0], rtol=1e-4)


def test_the_gradient_equals_finite_differences(x64):
    """With the noise held the objective is an ordinary function. The model's noise is homoscedastic here, because no
    gradient is meant to flow through a predicted one."""
    r = make_rig(particles=7, horizon=4, heteroscedastic=False)
    given = jax.jit(lambda k: scenarios.draw(k, 0, r.belief, blocks=r.blocks, period=Period()))(jax.random.key(0))
    pieces = dict(dynamics=r.dynamics, policy=r.policy, match=matching.match, cost=r.cost, noise=NoiseUse(1.0, 0.5))
    value = jax.jit(partial(objective, **pieces))
    gradient = jax.jit(jax.grad(partial(objective, **pieces)))(r.params, r.belief, given)
    for seed in range(4):
        noise = np.random.default_rng(seed)
        direction = jax.tree.map(lambda leaf, noise=noise: jnp.asarray(noise.normal(size=leaf.shape)), r.params)
        direction |= {"input": jax.tree.map(jnp.zeros_like, r.params["input"])}  # which is not learned
        move = lambda step, d=direction: jax.tree.map(lambda p, v: p + step * v, r.params, d)  # noqa: E731
        slope = (value(move(1e-6), r.belief, given) - value(move(-1e-6), r.belief, given)) / 2e-6
        np.testing.assert_allclose(optax.tree.vdot(gradient, direction), slope, rtol=1e-5, atol=1e-9)
        assert abs(slope) > 1e-4


# The linear-Gaussian plant, whose expected cost and best gain are known


def linear_objective(plant, particles):
    """gain -> objective under exactly balanced noise, and the pieces `optimise` wants."""
    dynamics, policy = known(plant), linear_policy(*plant.b.shape)
    blocks = scenarios.blocks(
        dynamics=dynamics,
        policy=policy,
        start=lambda key: jax.random.normal(key, plant.mean.shape),
        particles=particles,
        horizon=plant.horizon,
        balanced=True,
    )._replace(start=balanced_start(plant, particles))
    value = partial(
        objective,
        dynamics=dynamics,
        policy=policy,
        match=matching.match,
        cost=costs.of_particles(lambda x: x @ jnp.asarray(plant.q, x.dtype) @ x),
    )
    return value, blocks


def best_gain(plant, particles):
    """The gain with the least expected cost, from the covariance recursion and nothing of the package."""
    shape = plant.b.T.shape
    found = minimize(
        lambda g: expected_cost(plant, g.reshape(shape), particles), np.full(shape, -1.0).ravel(), tol=1e-12
    )
    return found.x.reshape(shape)


@pytest.mark.parametrize("plant", [SCALAR, PENDULUM])
def test_matched_balanced_particles_give_the_exact_expected_cost(plant, x64):
    """Moment matching makes the particle cloud the Gaussian: a quadratic cost is then exact, for any draw."""
    particles = 5
    value, blocks = linear_objective(plant, particles)
    of_gain = jax.jit(lambda gain, given: value(gain, None, given))
    draw = jax.jit(lambda seed: scenarios.draw(jax.random.key(seed), 0, None, blocks=blocks, period=Period()))
    for seed in range(3):
        gain = np.random.default_rng(seed).normal(size=plant.b.T.shape)
        np.testing.assert_allclose(of_gain(gain, draw(seed)), expected_cost(plant, gain, particles), rtol=1e-8)


@pytest.mark.parametrize("plant", [SCALAR, PENDULUM])
def test_the_search_finds_the_best_gain(plant):
    particles = 12
    value, blocks = linear_objective(plant, particles)
    pieces = dict(blocks=blocks, period=Period())
    # The unstable start gives large gradients, which Adam must forget: hence b2.
    adam = optax.adam(optax.cosine_decay_schedule(0.1, 800), b2=0.95)
    optimizer = guarded(optax.chain(optax.clip_by_global_norm(1.0), adam))
    gain = jnp.zeros(plant.b.T.shape)
    search = jax.jit(
        partial(
            optimise,
            draw=partial(scenarios.draw, **pieces),
            redraw=partial(scenarios.redraw, **pieces),
            objective=value,
            optimizer=optimizer,
            steps=800,
        )
    )
    learner, info = search(jax.random.key(0), Learner(gain, optimizer.init(gain)), None)
    best = best_gain(plant, particles)
    if plant is SCALAR:
        np.testing.assert_allclose(best, [[-2.4]], atol=1e-4)  # -a / b brings any state to 0 in one step
    np.testing.assert_allclose(learner.params, best, atol=2e-3)
    np.testing.assert_allclose(info.objective[-1], expected_cost(plant, best, particles), rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(info.objective[0], expected_cost(plant, np.zeros_like(best), particles), rtol=1e-3)
    assert info.skipped == 0


def test_a_known_control_is_found_through_limits_and_costs():
    """One step of the cart probe, from rest at 1 m: the best force within the limits is a number."""
    task = cart(horizon=1)
    start = jnp.array([1.0, 0.0])
    cost_of = lambda u: task.cost(task.plant.step(start, u))  # noqa: E731
    grid = np.linspace(-2, 2, 4001, dtype=np.float32)[:, None]
    best = grid[np.argmin(jax.vmap(cost_of)(grid))]
    optimizer = guarded(optax.adam(0.05))
    learner, _ = optimise(
        jax.random.key(0),
        Learner(jnp.zeros(1), optimizer.init(jnp.zeros(1))),
        None,
        draw=lambda key, step, belief: None,
        redraw=lambda key, step, held, belief: held,
        objective=lambda params, belief, given: cost_of(2 * jnp.tanh(params)),
        optimizer=optimizer,
        steps=200,
    )
    np.testing.assert_allclose(2 * jnp.tanh(learner.params), best, atol=5e-3)


# The optimiser, on an objective simple enough to follow by hand: |params - scenarios|^2


def follow(key, step, belief):
    """A target of its own for every iteration."""
    return jax.random.normal(jax.random.fold_in(key, step), (3,))


def distance(params, belief, target):
    return jnp.sum((params - target) ** 2) * belief


def pursue(optimizer, steps, *, bad=(), value=jnp.nan, scale=1.0):
    """A jitted search whose target is `value` at the iterations `bad`."""

    def draw(key, step, belief):
        spoiled = jnp.isin(step, jnp.asarray(bad, jnp.int32)) if bad else False
        return jnp.where(spoiled, value, scale * follow(key, step, belief))

    return jax.jit(
        partial(
            optimise,
            draw=draw,
            redraw=lambda key, step, held, belief: draw(key, step, belief),
            objective=distance,
            optimizer=optimizer,
            steps=steps,
        )
    )


def begin(optimizer):
    return Learner(jnp.ones(3), optimizer.init(jnp.ones(3)))


def loop(optimizer, iterations):
    """The same search as a Python loop over the given iterations."""
    learner, key = begin(optimizer), jax.random.key(7)
    for i in iterations:
        gradient = jax.grad(distance)(learner.params, 1.0, follow(jax.random.clone(key), i, None))
        updates, state = optimizer.update(gradient, learner.optimizer, learner.params)
        learner = Learner(optax.apply_updates(learner.params, updates), state)
    return learner


def test_the_search_is_gradient_descent_on_the_scenarios_of_each_iteration():
    optimizer = guarded(optax.adam(0.1))
    learner, info = pursue(optimizer, 6)(jax.random.key(7), begin(optimizer), 1.0)
    expected = loop(optimizer, range(6))
    np.testing.assert_allclose(learner.params, expected.params, rtol=1e-5)
    assert info.objective.shape == info.gradient_norm.shape == (6,)
    first = distance(jnp.ones(3), 1.0, follow(jax.random.key(7), 0, None))
    np.testing.assert_allclose(info.objective[0], first, rtol=1e-6)
    np.testing.assert_allclose(info.gradient_norm[0], 2 * np.sqrt(first), rtol=1e-5)


@pytest.mark.parametrize("calls", [1, 2, 3])
def test_a_search_that_loses_what_it_found_ends_with_what_it_had_at_its_turn(calls):
    """Three steps find something better than what was given, three of ten thousand times the size lose it again."""
    optimizer = guarded(started(optax.sgd(0.1)))
    course = Course(turns=(3, 6), pace=lambda i: jnp.where(i < 3, 1.0, 1e4))
    still = dict(draw=lambda *_: jnp.zeros(3), redraw=lambda key, step, held, belief: held, optimizer=optimizer)
    run = jax.jit(partial(optimise, **still, objective=distance, course=course, steps=6 // calls))
    learner, values = begin(optimizer), []
    for call in range(calls):
        learner, info = run(jax.random.key(7), learner, 1.0, first=call * (6 // calls))
        values += info.objective.tolist()
    np.testing.assert_allclose(learner.params, 0.8**3, rtol=1e-5)
    np.testing.assert_allclose(values[:4], 3 * np.power(0.64, [0, 1, 3, 3]), rtol=1e-5)
    assert values[4] > 1e6
    np.testing.assert_allclose(values[5], values[3], rtol=1e-5)


def test_each_iteration_has_its_width_wherever_the_search_is_cut():
    optimizer = guarded(remembering(optax.adam(0.1)))
    pieces = dict(draw=follow, redraw=lambda key, step, held, belief: follow(key, step, belief), optimizer=optimizer)
    value = lambda *given: distance(*given[:3]) / given[3]  # noqa: E731
    run = partial(optimise, **pieces, course=Course(stage=narrowing(4.0, 3), settled=3), objective=value)
    whole, info = run(jax.random.key(7), begin(optimizer), 1.0, steps=6)
    half, _ = run(jax.random.key(7), begin(optimizer), 1.0, steps=2)
    rest, last = run(jax.random.key(7), half, 1.0, steps=4, first=2)
    np.testing.assert_allclose(rest.params, whole.params, rtol=1e-5)
    np.testing.assert_allclose(last.objective, info.objective[2:], rtol=1e-5)
    first = distance(jnp.ones(3), 1.0, follow(jax.random.key(7), 0, None))
    np.testing.assert_allclose(info.objective[0], first / 4, rtol=1e-6)
    best = optax.tree.get(whole.optimizer, "best_value")
    assert best == info.objective[3:].min(), "values of a wider cost do not count"


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_bad_gradient_skips_its_update_and_nothing_else(value):
    """Parameters and optimiser state are those of a search that never had these iterations."""
    optimizer = guarded(optax.chain(optax.clip_by_global_norm(1.0), optax.adam(0.1)))
    learner, info = pursue(optimizer, 8, bad=(2, 3, 6), value=value)(jax.random.key(7), begin(optimizer), 1.0)
    expected = loop(optimizer, [0, 1, 4, 5, 7])
    np.testing.assert_allclose(learner.params, expected.params, rtol=1e-5)
    for ours, theirs in zip(
        jax.tree.leaves(learner.optimizer.inner_state), jax.tree.leaves(expected.optimizer.inner_state), strict=True
    ):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5)
    assert info.skipped == 3
    assert np.array_equal(np.isfinite(info.gradient_norm), [1, 1, 0, 0, 1, 1, 0, 1])


def test_a_search_that_sees_nothing_but_bad_gradients_changes_nothing():
    optimizer = guarded(optax.adam(0.1))
    learner, info = pursue(optimizer, 5, bad=tuple(range(5)))(jax.random.key(7), begin(optimizer), 1.0)
    assert np.array_equal(learner.params, np.ones(3))
    assert same(learner.optimizer.inner_state, begin(optimizer).optimizer.inner_state)
    assert info.skipped == 5
    _, info = pursue(optimizer, 5)(jax.random.key(7), learner, 1.0)
    assert info.skipped == 0  # each call counts its own


def test_clipping_limits_the_update_and_keeps_its_direction():
    optimizer = guarded(optax.chain(optax.clip_by_global_norm(0.5), optax.sgd(1.0)))
    for scale in (1e-2, 1e3):
        learner, info = pursue(optimizer, 1, scale=0.0)(jax.random.key(7), begin(optimizer), scale)
        gradient = 2 * scale * np.ones(3)
        moved = np.ones(3) - np.asarray(learner.params)
        np.testing.assert_allclose(moved, gradient * min(1, 0.5 / np.linalg.norm(gradient)), rtol=1e-4)
        np.testing.assert_allclose(info.gradient_norm[0], np.linalg.norm(gradient), rtol=1e-5)  # before clipping


def test_a_search_in_pieces_is_the_same_search_to_the_bit():
    """What lets a progress display look in, and a killed run go on. The emitters of a run round both programs alike."""
    task = cart(horizon=4)
    dynamics, policy = regression(2, 1), noisy_linear_policy(task)
    blocks = scenarios.blocks(
        dynamics=dynamics,
        policy=policy,
        start=lambda key: jax.random.normal(key, (2,)),
        particles=5,
        horizon=4,
        balanced=False,
    )
    pieces = dict(blocks=blocks, period=Period(start=1, sensor=3))  # redrawn inside a piece and across two
    value = partial(
        objective, dynamics=dynamics, policy=policy, match=matching.match, cost=costs.of_particles(task.cost)
    )
    optimizer = guarded(optax.chain(optax.clip_by_global_norm(1.0), optax.adam(0.01)))

    def search(steps):
        draws = {name: partial(getattr(scenarios, name), **pieces) for name in ("draw", "redraw")}
        function = partial(optimise, **draws, objective=value, optimizer=optimizer, steps=steps)
        return jax.jit(function, compiler_options=EMITTERS)

    key, belief = jax.random.key(3), jnp.full((3, 2), 0.2)
    params = jnp.full((1, 2), 0.3)
    learner = Learner(params, optimizer.init(params))
    whole, info = search(6)(key, learner, belief)
    part, values = search(2), []
    for first in (0, 2, 4):
        learner, chunk = part(key, learner, belief, first=first)
        values.append(chunk.objective)
    assert same(whole, learner)
    assert np.array_equal(info.objective, np.concatenate(values))
    assert len(np.unique(info.objective)) == 6


# The best iterate


def seeking(optimizer, steps, value=jnp.nan, bad=(), last=12):
    """A keeping searcher around `pursue`."""
    init, run = optimizer.init, pursue(optimizer, steps, bad=bad, value=value)
    searcher = Searcher(init, lambda key, learner, belief, *, first, steps: run(key, learner, belief, first=first))
    return keeping_best(searcher, last)


def test_the_best_iterate_is_the_one_with_the_lowest_objective_seen():
    """One that is not the last; a search in pieces keeps the same one; NaN is no value."""
    key = jax.random.key(7)
    plain, remembers = guarded(optax.adam(0.3)), guarded(remembering(optax.adam(0.3)))
    one, learner, params, values = pursue(plain, 1), begin(plain), [], []
    for i in range(12):
        params.append(learner.params)
        learner, info = one(key, learner, 1.0, first=i)
        values.append(float(info.objective[0]))
    best = int(np.argmin(values))
    assert 0 < best < 11
    whole, _ = seeking(remembers, 12).run(key, begin(remembers), 1.0, first=0, steps=12)
    np.testing.assert_allclose(whole.params, params[best], rtol=1e-5)
    learner = begin(remembers)
    for first in (0, 4, 8):
        learner, _ = seeking(remembers, 4).run(key, learner, 1.0, first=first, steps=4)
        if first < 8:  # not over: the search goes on from where it is
            np.testing.assert_allclose(learner.params, params[first + 4], rtol=1e-4)
    assert same(learner, whole)
    spoiled, info = seeking(remembers, 12, bad=(best,)).run(key, begin(remembers), 1.0, first=0, steps=12)
    assert np.isnan(info.objective[best])
    assert np.all(np.isfinite(spoiled.params))
    assert not np.allclose(spoiled.params, whole.params)


def test_what_was_best_for_an_older_model_is_forgotten():
    remembers = guarded(remembering(optax.adam(0.3)))
    searcher = seeking(remembers, 12)
    learner, _ = searcher.run(jax.random.key(7), begin(remembers), 1.0, first=0, steps=12)
    start = learner.params + 3
    again, info = searcher.run(jax.random.key(8), Learner(start, learner.optimizer), 1e3, first=0, steps=12)
    assert float(optax.tree.get(again.optimizer, "best_value")) == np.min(info.objective)
