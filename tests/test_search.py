"""Policy search: the objective against closed forms and finite differences, the optimizer against a loop."""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from pegasus_jax.imagine import costs, matching, scenarios
from pegasus_jax.imagine.objective import objective
from pegasus_jax.imagine.rollout import NoiseUse
from pegasus_jax.imagine.scenarios import Sampler, sampler
from pegasus_jax.learn.gradient import gradient_search
from pegasus_jax.learn.rounds import after_row, unrefined
from pegasus_jax.learn.schedule import STEP, SearchTable, search_table
from pegasus_jax.learn.search import Problem, searcher
from pegasus_jax.learn.widening import holding
from pegasus_jax.types import Cost, Period, Scenarios, TrainState
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
    draw = jax.jit(lambda seed: scenarios.draw(jax.random.key(seed), 0, r.posterior, blocks=r.blocks, period=Period()))
    value = partial(objective, dynamics=r.dynamics, policy=r.policy, match=matching.match, cost=r.cost)
    gradient = jax.jit(jax.value_and_grad(value))
    return draw, lambda given: gradient(r.params, r.posterior, given)


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
    given = jax.jit(lambda k: scenarios.draw(k, 0, r.posterior, blocks=r.blocks, period=Period()))(jax.random.key(0))
    pieces = dict(dynamics=r.dynamics, policy=r.policy, match=matching.match, cost=r.cost, noise=NoiseUse(1.0, 0.5))
    value = jax.jit(partial(objective, **pieces))
    gradient = jax.jit(jax.grad(partial(objective, **pieces)))(r.params, r.posterior, given)
    for seed in range(4):
        noise = np.random.default_rng(seed)
        direction = jax.tree.map(lambda leaf, noise=noise: jnp.asarray(noise.normal(size=leaf.shape)), r.params)
        direction |= {"input": jax.tree.map(jnp.zeros_like, r.params["input"])}  # which is not learned
        move = lambda step, d=direction: jax.tree.map(lambda p, v: p + step * v, r.params, d)  # noqa: E731
        slope = (value(move(1e-6), r.posterior, given) - value(move(-1e-6), r.posterior, given)) / 2e-6
        np.testing.assert_allclose(optax.tree.vdot(gradient, direction), slope, rtol=1e-5, atol=1e-9)
        assert abs(slope) > 1e-4


# The linear-Gaussian plant, whose expected cost and best gain are known


def linear_objective(plant, particles):
    """gain -> objective under exactly balanced noise, and how its scenarios are drawn."""
    dynamics, policy = known(plant), linear_policy(*plant.b.shape)
    blocks = scenarios.blocks(
        dynamics=dynamics,
        policy=policy,
        start=lambda key: jax.random.normal(key, plant.mean.shape),
        particles=particles,
        horizon=plant.horizon,
        standardized_noise=True,
    )._replace(start=balanced_start(plant, particles))
    value = partial(
        objective,
        dynamics=dynamics,
        policy=policy,
        match=matching.match,
        cost=costs.of_particles(Cost(lambda x: x @ jnp.asarray(plant.q, x.dtype) @ x)),
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
    # The unstable start gives large gradients, which Adam must forget: hence b2.
    adam = optax.adam(optax.cosine_decay_schedule(0.1, 800), b2=0.95)
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), adam)
    gain = jnp.zeros(plant.b.T.shape)
    search = jax.jit(
        partial(
            gradient_search,
            objective=value,
            sampler=sampler(blocks, Period()),
            optimizer=optimizer,
            steps=800,
        )
    )
    learner, info = search(jax.random.key(0), TrainState(gain, optimizer.init(gain)), None)
    best = best_gain(plant, particles)
    if plant is SCALAR:
        np.testing.assert_allclose(best, [[-2.4]], atol=1e-4)  # -a / b brings any state to 0 in one step
    np.testing.assert_allclose(learner.params, best, atol=2e-3)
    np.testing.assert_allclose(info.objective[-1], expected_cost(plant, best, particles), rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(info.objective[0], expected_cost(plant, np.zeros_like(best), particles), rtol=1e-3)
    assert info.skipped == 0


@pytest.mark.parametrize("optimizer", [optax.adam(0.05), optax.lbfgs()], ids=["adam", "lbfgs"])
def test_a_known_control_is_found_through_limits_and_costs(optimizer):
    """One step of the cart probe, from rest at 1 m: the best force within the limits is a number."""
    task = cart(horizon=1)
    start = jnp.array([1.0, 0.0])
    cost_of = lambda u: task.cost.of_state(task.plant.step(start, u))  # noqa: E731
    grid = np.linspace(-2, 2, 4001, dtype=np.float32)[:, None]
    best = grid[np.argmin(jax.vmap(cost_of)(grid))]
    learner, _ = gradient_search(
        jax.random.key(0),
        TrainState(jnp.zeros(1), optimizer.init(jnp.zeros(1))),
        None,
        sampler=Sampler(lambda *_: jnp.zeros(()), lambda key, step, held, posterior, begins: held),
        objective=lambda params, posterior, given: cost_of(2 * jnp.tanh(params)),
        optimizer=optimizer,
        steps=200,
    )
    np.testing.assert_allclose(2 * jnp.tanh(learner.params), best, atol=5e-3)


def test_a_misspelt_argument_of_the_plain_search_is_named():
    how = dict(objective=None, sampler=None, optimizer=None, steps=1)
    with pytest.raises(TypeError, match=r"^gradient_search has no argument frist="):
        gradient_search(jax.random.key(0), TrainState(None, None), None, **how, earlier=0, frist=3)


# The optimizer, on an objective simple enough to follow by hand: |params - scenarios|^2


def follow(key, step, posterior):
    """A target of its own for every iteration."""
    return jax.random.normal(jax.random.fold_in(key, step), (3,))


def distance(params, posterior, target):
    return jnp.sum((params - target) ** 2) * posterior


def pursue(optimizer, steps, *, bad=(), value=jnp.nan, scale=1.0):
    """A jitted search whose target is `value` at the iterations `bad`."""

    def draw(key, step, posterior):
        spoiled = jnp.isin(step, jnp.asarray(bad, jnp.int32)) if bad else False
        return jnp.where(spoiled, value, scale * follow(key, step, posterior))

    return jax.jit(
        partial(
            gradient_search,
            sampler=Sampler(draw, lambda key, step, held, posterior, begins: draw(key, step, posterior)),
            objective=distance,
            optimizer=optimizer,
            steps=steps,
        )
    )


def begin(optimizer):
    return TrainState(jnp.ones(3), optimizer.init(jnp.ones(3)))


def loop(optimizer, iterations, params=(1.0, 1.0, 1.0)):
    """The same search as a Python loop over the given iterations."""
    learner, key = TrainState(jnp.array(params), optimizer.init(jnp.array(params))), jax.random.key(7)
    for i in iterations:
        gradient = jax.grad(distance)(learner.params, 1.0, follow(jax.random.clone(key), i, None))
        updates, state = optimizer.update(gradient, learner.optimizer, learner.params)
        learner = TrainState(optax.apply_updates(learner.params, updates), state)
    return learner


def test_the_search_is_gradient_descent_on_the_scenarios_of_each_iteration():
    optimizer = optax.adam(0.1)
    learner, info = pursue(optimizer, 6)(jax.random.key(7), begin(optimizer), 1.0)
    expected = loop(optimizer, range(6))
    np.testing.assert_allclose(learner.params, expected.params, rtol=1e-5)
    assert info.objective.shape == info.gradient_norm.shape == (6,)
    first = distance(jnp.ones(3), 1.0, follow(jax.random.key(7), 0, None))
    np.testing.assert_allclose(info.objective[0], first, rtol=1e-6)
    np.testing.assert_allclose(info.gradient_norm[0], 2 * np.sqrt(first), rtol=1e-5)


def on_table(table, optimizer, draw=follow, value=distance, **more):
    """(searcher of a table, its learner at ones); the objective ignores the row unless `value` takes it."""
    drawing = Sampler(draw, lambda key, step, held, posterior, begins: draw(key, step, posterior))
    found = searcher(Problem(value, drawing, optimizer, table, **more))
    return found, TrainState(jnp.ones(3), found.init(jnp.ones(3)))


def rowless(params, posterior, target, row):
    return distance(params, posterior, target)


STILL = lambda *_: jnp.zeros(3)  # noqa: E731


@pytest.mark.parametrize(
    "optimizer",
    [optax.lbfgs(), optax.chain(optax.adam(0.05), optax.contrib.reduce_on_plateau(patience=2))],
    ids=["line search", "told the loss"],
)
@pytest.mark.parametrize("constrained", [False, True])
def test_a_table_of_plain_steps_takes_those_of_the_printed_search_with_any_optimizer(optimizer, constrained):
    value = (lambda *given: (rowless(*given[:4]), jnp.float32(0))) if constrained else rowless
    ascend = (lambda multiplier, chance: multiplier) if constrained else None
    found, learner = on_table(search_table(6), optimizer, value=value, ascend=ascend)
    after, info = jax.jit(partial(found.run, steps=6))(jax.random.key(7), learner, 1.0)
    plain, expected = pursue(optimizer, 6)(jax.random.key(7), begin(optimizer), 1.0)
    np.testing.assert_allclose(after.params, plain.params, rtol=1e-5)
    np.testing.assert_allclose(info.objective, expected.objective, rtol=1e-5)


@pytest.mark.parametrize("calls", [1, 2, 3])
def test_a_search_that_loses_what_it_found_ends_with_what_it_had_before_it_refined(calls):
    """Three steps find something better than what was given, three of ten thousand times the size lose it again."""
    table = search_table(6, refine=3)
    table = table._replace(step_size=np.where(table.refine, 1e4, 1.0)[None])
    found, learner = on_table(table, optax.sgd(0.1), STILL, rowless)
    run, values = jax.jit(partial(found.run, steps=6 // calls)), []
    for call in range(calls):
        learner, info = run(jax.random.key(7), learner, 1.0, first=call * (6 // calls))
        values += info.objective.tolist()
    np.testing.assert_allclose(learner.params, 0.8**3, rtol=1e-5)
    np.testing.assert_allclose(values[:4], 3 * np.power(0.64, [0, 1, 3, 3]), rtol=1e-5)
    assert values[4] > 1e6
    np.testing.assert_allclose(values[5], values[3], rtol=1e-5)
    assert not learner.optimizer.no_improvement


@pytest.mark.parametrize(
    ("own", "other", "stuck", "taken"),
    [
        *((2, 1, False, True), (1, 2, False, False), (1, 1, False, True), (1, 2, True, True)),
        *((1, np.nan, False, False), (1, np.nan, True, False), (np.nan, 1, False, True)),
    ],
)
def test_a_fresh_policy_is_taken_where_it_costs_no_more_or_the_last_search_found_nothing(own, other, stuck, taken):
    """Of two equal ones the fresh one, because a flat cost leads nowhere; what is not a number never."""
    found, learner = on_table(search_table(1, init="better"), optax.sgd(0.0), STILL, rowless)
    state = learner.optimizer._replace(no_improvement=jnp.asarray(stuck))
    learner = TrainState(jnp.full(3, float(own)), state)
    after, info = found.run(jax.random.key(0), learner, 1.0, steps=1, fresh=jnp.full((2, 3), float(other)))
    assert np.array_equal(after.params, np.full(3, other if taken else own))
    np.testing.assert_allclose(info.objective, 3 * float(other if taken else own) ** 2)


@pytest.mark.parametrize("init", ["better", "raced", "fresh"])
def test_a_policy_whose_particles_go_to_infinity_is_left_behind(init):
    """Its cost is not a number, and that of a fresh one is: what a search found is not given up for it."""

    def value(params, posterior, scenarios, row):
        return jnp.where(jnp.abs(params[0]) > 5, jnp.nan, 0.1 * (params[0] - 1) ** 2)

    found, learner = on_table(search_table(100, init=init, refine=50), optax.adam(0.05), STILL, value)
    learner = learner._replace(params=jnp.full(3, 10.0))
    learner, _ = found.run(jax.random.key(0), learner, 1.0, steps=100, fresh=jnp.zeros((2, 3)))
    np.testing.assert_allclose(learner.params[0], 1, atol=0.1)


def test_a_fresh_policy_that_a_table_needs_and_iterations_that_it_lacks_are_errors():
    found, learner = on_table(search_table(2, init="fresh"), optax.sgd(0.1), STILL, rowless)
    with pytest.raises(ValueError, match="fresh= is None; expected its parameters"):
        found.run(jax.random.key(0), learner, 1.0, steps=1)
    for first, steps in ((0, 3), (1, 2), (2, 1)):
        with pytest.raises(
            ValueError, match=f"first={first}, steps={steps}: the table of this search has 2 iterations"
        ):
            found.run(jax.random.key(0), learner, 1.0, first=first, steps=steps, fresh=jnp.zeros((2, 3)))


@pytest.mark.parametrize(("init", "asks"), [("previous", False), ("better", True), ("fresh", True), ("raced", True)])
def test_a_fresh_policy_that_no_row_asks_for_is_not_used(init, asks):
    """So that a program need not draw it."""
    found, learner = on_table(search_table(4, init=init, refine=4), optax.sgd(0.1), STILL, rowless)
    run = partial(found.run, jax.random.key(0), learner, 1.0, steps=4)
    program = jax.make_jaxpr(lambda fresh: run(fresh=fresh))(jnp.zeros((2, 3))).jaxpr
    assert any(program.invars[0] is used for step in program.eqns for used in step.invars) == asks


def test_one_program_serves_the_first_search_and_all_others():
    """The state has the types at its beginning that it has after a search: else each would compile again."""
    found, learner = on_table(search_table(2, refine=1), optax.adam(0.1), value=rowless)
    run = jax.jit(partial(found.run, steps=2))
    for _ in range(2):
        learner, _ = run(jax.random.key(7), learner, 1.0, first=0)
    assert run._cache_size() == 1


def test_a_new_search_forgets_the_moments_or_goes_on_with_them():
    for reset in (True, False):
        found, learner = on_table(search_table(3), optax.adam(0.1), value=rowless, reset_optimizer=reset)
        once, _ = found.run(jax.random.key(7), learner, 1.0, steps=3)
        twice, _ = found.run(jax.random.key(7), once, 1.0, steps=3)
        assert twice.optimizer.optimizer[0].count == (3 if reset else 6)


@pytest.mark.parametrize("calls", [1, 3])
def test_a_search_that_only_refines_is_the_last_part_of_a_whole_one(calls):
    """In one piece or several, in the program of the whole one; the iterations that it has no need of are not done."""
    optimizer, table = optax.adam(0.1), search_table(6, refine=4)
    last = SearchTable(*(column[..., table.iteration >= 4] for column in table))
    last = last._replace(iteration=last.iteration - 4, scenarios=last.scenarios - 4)
    alone, learner = on_table(last, optimizer, lambda key, step, _: follow(key, step + 4, None), rowless)
    expected, wanted = alone.run(jax.random.key(7), learner, 1.0, steps=2)
    found, learner = on_table(table, optimizer, follow, rowless)
    run, infos = jax.jit(partial(found.run, steps=6 // calls)), []
    for call in range(calls):
        learner, info = run(jax.random.key(7), learner, 1.0, first=call * (6 // calls), works=True)
        infos.append(info)
    np.testing.assert_allclose(learner.params, expected.params, rtol=1e-6)
    objective, done = np.concatenate([i.objective for i in infos]), sum(int(i.iterations) for i in infos)
    np.testing.assert_allclose(objective, [*wanted.objective, *[np.nan] * 4], rtol=1e-6)
    assert done == wanted.iterations == 2
    _, info = run(jax.random.key(7), on_table(table, optimizer)[1], 1.0, first=0, works=False)
    assert info.iterations == 6 // calls
    assert run._cache_size() == 1


@pytest.mark.parametrize("init", ["better", "raced"])
def test_what_works_is_refined_but_in_the_first_second_fourth_eighth_search(init):
    """One that does not work, as with `False`, begins the count again."""
    found, learner = on_table(search_table(6, init=init, refine=4), optax.adam(0.1), value=rowless)
    run, done = jax.jit(partial(found.run, steps=6, fresh=jnp.zeros((2, 3)))), []
    for works in [True] * 9 + [False] + [True] * 3:
        learner, info = run(jax.random.key(7), learner, 1.0, first=0, works=works)
        done.append(int(info.iterations))
    assert done == [6, 6, 2, 6, 2, 2, 2, 6, 2, 6, 6, 6, 2]
    assert run._cache_size() == 1


@pytest.mark.parametrize(
    ("given", "iterations"),
    [
        ([1, 2, 1, 1, 1, 1], [6, 2, 2, 2, 6, 2]),
        ([1, 1, 2, 1, 1], [6, 6, 2, 6, 2]),
        ([1, 2, 2, 2], [6, 2, 2, 2]),
        ([0, 1, 1, 1, 1, 2], [6, 6, 6, 2, 6, 2]),
    ],
)
def test_where_what_replaced_it_has_failed_a_policy_is_only_refined(given, iterations):
    """2 says so; whole searches are rarer from then on."""
    found, learner = on_table(search_table(6, init="better", refine=4), optax.adam(0.1), value=rowless)
    run, done = jax.jit(partial(found.run, steps=6, fresh=jnp.zeros((2, 3)))), []
    for works in given:
        learner, info = run(jax.random.key(7), learner, 1.0, first=0, works=jnp.int32(works))
        done.append(int(info.iterations))
    assert done == iterations
    assert run._cache_size() == 1


@pytest.mark.parametrize(("works", "starts"), [(False, 1.0), (True, 9.0)])
def test_a_whole_search_that_is_given_what_works_begins_with_a_fresh_policy_and_ends_with_the_better(works, starts):
    """Here the fresh one costs more, and steps do not move it."""
    found, learner = on_table(search_table(2, init="better", refine=1), optax.sgd(0.0), STILL, rowless)
    fresh = jnp.full((2, 3), 3.0)
    after, info = found.run(jax.random.key(0), learner, 1.0, steps=2, fresh=fresh, works=works)
    np.testing.assert_allclose(info.objective, [3.0, 3.0])  # of the policy at the end of each iteration
    assert np.array_equal(after.params, np.ones(3))
    moving, learner = on_table(search_table(3, init="better", refine=2), optax.sgd(0.0), STILL, rowless)
    _, info = moving.run(jax.random.key(0), learner, 1.0, steps=1, fresh=fresh, works=works)
    np.testing.assert_allclose(info.objective, [3 * starts])


@pytest.mark.parametrize("calls", [1, 4])
@pytest.mark.parametrize(
    ("given", "works", "stuck", "objectives", "end"),
    [
        (0.5, False, False, [3, 3, 0.75, 0.75, 0.75, 0.75, 0.75, 0.75], 0.5),  # the given one runs second, and wins
        (2, False, False, [3, 3, 12, 3, 3, 3, 3, 3], 1),  # or loses
        (2, False, True, [3, 3, 27, 3, 3, 3, 3, 3], 1),  # what the last search could not better runs no more
        (0.5, True, False, [3, 3, 27, 3, 3, 3, 3, 0.75], 0.5),  # one that works is challenged, and kept if better
        (2, True, False, [3, 3, 27, 3, 3, 3, 3, 3], 1),
    ],
)
def test_the_winner_of_a_race_goes_on_and_the_better_of_it_and_the_given_policy_stays(
    given, works, stuck, objectives, end, calls
):
    """Fresh ones at 1 and at 3, where a step moves nothing; the objective is that of the end of each iteration."""
    found, learner = on_table(search_table(8, init="raced", refine=8), optax.sgd(0.0), STILL, rowless)
    learner = TrainState(jnp.full(3, float(given)), learner.optimizer._replace(no_improvement=jnp.asarray(stuck)))
    fresh, values = jnp.array([[1.0], [3.0]]) * jnp.ones(3), []
    run = jax.jit(partial(found.run, steps=8 // calls))
    for call in range(calls):
        first = call * (8 // calls)
        learner, info = run(jax.random.key(0), learner, 1.0, first=first, fresh=fresh, works=jnp.asarray(works))
        values += info.objective.tolist()
    np.testing.assert_allclose(values, objectives)
    np.testing.assert_allclose(learner.params, end)


@pytest.mark.parametrize("wins", ["first", "second"])
def test_a_race_is_of_two_searches_that_begin_alike_and_its_winner_goes_on_as_if_alone(wins):
    """With Adam, whose moments come back with the one that ran first; the scenarios are those of each iteration."""
    optimizer, table = optax.adam(0.1), search_table(8, init="raced", refine=8)
    draws = {"first": range(2), "second": range(2, 4)}[wins]
    near, far = jnp.full(3, 0.1), jnp.full(3, 9.0)
    order = [near, far] if wins == "first" else [far, near]
    found, _ = on_table(table, optimizer, value=rowless)
    learner = TrainState(order[1], found.init(order[1]))
    fresh = jnp.stack([order[0], order[0]])
    after, _ = found.run(jax.random.key(7), learner, 1.0, steps=8, fresh=fresh)
    expected = loop(optimizer, [*draws, *range(4, 8)], near)
    np.testing.assert_allclose(after.params, expected.params, rtol=1e-5)


@pytest.mark.parametrize("calls", [1, 4])
@pytest.mark.parametrize(("holds", "found_it"), [(False, False), (True, True)])
def test_a_cost_that_is_too_flat_is_held_wider_until_a_search_can_follow_it(holds, found_it, calls):
    """A narrow well fourteen widths away: single precision's 1 has no slope, that of a wider well has one."""

    def well(params, posterior, scenarios, row):
        return 1 - jnp.exp(-0.5 * ((params[0] - 15) / row.cost_width) ** 2)

    table = holding(search_table(400)) if holds else search_table(400)
    found, learner = on_table(table, optax.adam(0.1), STILL, well)
    run = jax.jit(partial(found.run, steps=400 // calls))
    for call in range(calls):
        learner, _ = run(jax.random.key(0), learner, 1.0, first=call * (400 // calls))
    np.testing.assert_allclose(learner.params[0], 15 if found_it else 1, atol=0.1)
    assert learner.optimizer.widening == 1  # it falls back


def test_only_steps_before_a_refinement_hold_a_cost():
    table = holding(search_table(4, init="better", refine=2))
    assert np.array_equal(table.holds, (table.action == STEP) & (table.iteration < 2))
    assert not search_table(4, refine=2).holds.any()


@pytest.mark.parametrize("calls", [1, 5])
@pytest.mark.parametrize(("slope", "iterations"), [(1.0, 200), (0.0, 100)])
def test_a_refinement_ends_with_the_round_that_has_gained_nothing(slope, iterations, calls):
    """A cost that falls with every step is followed to the end; one that is noise alone is left after two rounds."""
    table = search_table(200, refine=range(0, 200, 50))
    noise = lambda key, step, _: jnp.where(step // 50 == 0, 1.0, 1.2) + 0.1 * (step % 2)  # noqa: E731
    value = lambda params, posterior, level, row: slope * params.sum() + level  # noqa: E731
    found, learner = on_table(table, optax.sgd(0.1), noise, value)
    run, infos = jax.jit(partial(found.run, steps=200 // calls)), []
    for call in range(calls):
        learner, info = run(jax.random.key(7), learner, 1.0, first=call * (200 // calls))
        infos.append(info)
    objective = np.concatenate([info.objective for info in infos])
    assert sum(int(info.iterations) for info in infos) == np.isfinite(objective).sum() == iterations
    assert np.isfinite(objective[:iterations]).all()
    _, info = run(jax.random.key(7), learner, 1.0, first=0)  # the next search begins again
    assert info.iterations == min(100 if slope == 0 else 200, 200 // calls)


def test_a_round_has_gained_what_lowers_the_mean_by_more_than_the_standard_error():
    def judged(before, now):
        """Whether a search is over after two rounds with these objectives."""
        progress = unrefined()
        for values in (before, now):
            for i, value in enumerate(values):
                row = SimpleNamespace(counts=jnp.bool_(True), ends=jnp.bool_(i == len(values) - 1))
                progress = after_row(progress, row, jnp.float32(value))
        return bool(progress.over)

    before = np.array([1.0, 1.2, 0.8, 1.1, 0.9])
    error = np.sqrt(2 * np.var(before, ddof=1) / 5)
    assert judged(before, before - 0.95 * error)
    assert not judged(before, before - 1.05 * error)
    assert judged(before, before + 1)
    assert not judged(before, np.append(before - 1.5 * error, np.nan))  # a step under bad numbers says nothing


def test_each_iteration_has_its_width_wherever_the_search_is_cut():
    value = lambda *given: distance(*given[:3]) / given[3].cost_width  # noqa: E731
    found, learner = on_table(search_table(6, cost_width_start=4.0), optax.adam(0.1), value=value)
    whole, info = found.run(jax.random.key(7), learner, 1.0, steps=6)
    half, _ = found.run(jax.random.key(7), learner, 1.0, steps=2)
    rest, last = found.run(jax.random.key(7), half, 1.0, steps=4, first=2)
    np.testing.assert_allclose(rest.params, whole.params, rtol=1e-5)
    np.testing.assert_allclose(last.objective, info.objective[2:], rtol=1e-5)
    first = distance(jnp.ones(3), 1.0, follow(jax.random.key(7), 0, None))
    np.testing.assert_allclose(info.objective[0], first / 4, rtol=1e-6)


def test_the_table_search_skips_and_counts_bad_gradients_as_the_plain_one_does():
    draw = lambda key, step, posterior: jnp.where(step == 2, jnp.nan, follow(key, step, posterior))  # noqa: E731
    found, learner = on_table(search_table(5), optax.adam(0.1), draw, rowless)
    ours, info = found.run(jax.random.key(7), learner, 1.0, steps=5)
    plain, expected = pursue(optax.adam(0.1), 5, bad=(2,))(jax.random.key(7), begin(optax.adam(0.1)), 1.0)
    np.testing.assert_allclose(ours.params, plain.params, rtol=1e-6)
    assert info.skipped == expected.skipped == 1
    assert np.array_equal(np.isnan(info.objective), np.isnan(expected.objective))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_bad_gradient_skips_its_update_and_nothing_else(value):
    """Parameters and optimizer state are those of a search that never had these iterations."""
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(0.1))
    learner, info = pursue(optimizer, 8, bad=(2, 3, 6), value=value)(jax.random.key(7), begin(optimizer), 1.0)
    expected = loop(optimizer, [0, 1, 4, 5, 7])
    np.testing.assert_allclose(learner.params, expected.params, rtol=1e-5)
    for ours, theirs in zip(jax.tree.leaves(learner.optimizer), jax.tree.leaves(expected.optimizer), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5)
    assert info.skipped == 3
    assert np.array_equal(np.isfinite(info.gradient_norm), [1, 1, 0, 0, 1, 1, 0, 1])


def test_a_search_that_sees_nothing_but_bad_gradients_changes_nothing():
    optimizer = optax.adam(0.1)
    learner, info = pursue(optimizer, 5, bad=tuple(range(5)))(jax.random.key(7), begin(optimizer), 1.0)
    assert np.array_equal(learner.params, np.ones(3))
    assert same(learner.optimizer, begin(optimizer).optimizer)
    assert info.skipped == 5
    _, info = pursue(optimizer, 5)(jax.random.key(7), learner, 1.0)
    assert info.skipped == 0  # each call counts its own


def test_clipping_limits_the_update_and_keeps_its_direction():
    optimizer = optax.chain(optax.clip_by_global_norm(0.5), optax.sgd(1.0))
    for scale in (1e-2, 1e3):
        learner, info = pursue(optimizer, 1, scale=0.0)(jax.random.key(7), begin(optimizer), scale)
        gradient = 2 * scale * np.ones(3)
        moved = np.ones(3) - np.asarray(learner.params)
        np.testing.assert_allclose(moved, gradient * min(1, 0.5 / np.linalg.norm(gradient)), rtol=1e-4)
        np.testing.assert_allclose(info.gradient_norm[0], np.linalg.norm(gradient), rtol=1e-5)  # before clipping


@pytest.mark.slow
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
        standardized_noise=False,
    )
    draws = sampler(blocks, Period(start=1, sensor=3))  # redrawn inside a piece and across two
    value = partial(
        objective, dynamics=dynamics, policy=policy, match=matching.match, cost=costs.of_particles(task.cost)
    )
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(0.01))
    found = searcher(Problem(lambda *given: value(*given[:3]), draws, optimizer, search_table(6)))
    compiled = partial(jax.jit, compiler_options=EMITTERS)
    key, posterior = jax.random.key(3), jnp.full((3, 2), 0.2)
    params = jnp.full((1, 2), 0.3)
    begins = learner = TrainState(params, found.init(params))
    whole, info = compiled(partial(found.run, steps=6))(key, learner, posterior)
    part, values = compiled(partial(found.run, steps=2)), []
    for first in (0, 2, 4):
        learner, chunk = part(key, learner, posterior, first=first)
        values.append(chunk.objective)
    assert same(whole, learner)
    assert np.array_equal(info.objective, np.concatenate(values))
    assert len(np.unique(info.objective)) == 6
    # Alg. 3 as printed is the table of nothing but steps.
    printed = partial(gradient_search, objective=value, sampler=draws, optimizer=optimizer, steps=6)
    plain, expected = compiled(printed)(key, TrainState(params, begins.optimizer.optimizer), posterior)
    assert info.iterations == 6
    info = info._replace(iterations=None)
    assert same((plain.params, plain.optimizer, expected), (whole.params, whole.optimizer.optimizer, info))


@pytest.mark.parametrize("init", ["previous", "fresh"])
def test_a_search_without_a_refinement_is_whole_where_the_policy_works_too(init):
    """There is nothing of it to begin with."""
    found, learner = on_table(search_table(5, init=init), optax.sgd(0.1), value=rowless)
    run = partial(found.run, jax.random.key(7), posterior=1.0, steps=5, fresh=jnp.full((2, 3), 2.0))
    searched = {works: run(learner, works=works) for works in (False, True)}
    assert same(searched[True][0].params, searched[False][0].params)
    assert same(searched[True][1], searched[False][1])
    assert int(searched[True][1].iterations) == 5


def test_a_search_goes_as_far_in_double_precision(x64):
    """Its loop counts in 32 bits wherever it begins."""
    found, learner = on_table(search_table(6, refine=3), optax.sgd(0.1), value=rowless)
    after, info = found.run(jax.random.key(7), learner, 1.0, steps=6, works=jnp.bool_(True))
    assert int(info.iterations) == 3
    assert after.params.dtype == jnp.float64


def test_the_plain_search_goes_on_where_a_piece_of_it_has_ended():
    """What else a trial tells its searcher is of no use to it."""
    optimizer = optax.adam(0.1)
    whole, _ = pursue(optimizer, 6)(jax.random.key(7), begin(optimizer), 1.0)
    piece, learner = pursue(optimizer, 3), begin(optimizer)
    for first in (0, 3):
        learner, _ = piece(jax.random.key(7), learner, 1.0, first=first, earlier=2, fresh=None)
    np.testing.assert_allclose(learner.params, whole.params, rtol=1e-6)
