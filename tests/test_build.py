"""Composition: every named choice builds, and what a config says reaches the piece it is about."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from pegasus_jax import config, cost, dataset, moments, scenarios, settings, tasks, types
from pegasus_jax.build import (
    AGGREGATES,
    EXPLORATIONS,
    build,
    compose,
    dropout_of,
    dynamics_of,
    fit_of,
    search_of,
    start,
)
from pegasus_jax.config import DROPOUTS, Config, Period, SettingError
from pegasus_jax.dynamics.gp import gp
from pegasus_jax.dynamics.ssgp import ssgp
from pegasus_jax.fit import falling
from pegasus_jax.gaussian import affine
from pegasus_jax.network import INITIALISERS
from pegasus_jax.noisy import HEADS
from pegasus_jax.policy.squash import SQUASHES
from pegasus_jax.search import objective
from pegasus_jax.trial import SEARCH, trial_key
from pegasus_jax.types import Dataset, Learner
from pegasus_jax.variants import ALGORITHMS, MODELS, POLICIES
from probes import PENDULUM, SCALAR, cart, dial, known, linear_policy, same, tiny

pytestmark = pytest.mark.usefixtures("quick_compile")


def test_the_choices_of_a_config_are_the_pieces_there_are():
    """config.py cannot import the pieces; it lists their names, and this keeps the lists true."""
    assert tuple(HEADS) == config.HEADS
    assert tuple(INITIALISERS) == config.INITIALISERS
    assert tuple(SQUASHES) == config.SQUASHES
    assert tuple(EXPLORATIONS) == config.EXPLORATIONS
    assert tuple(AGGREGATES) == config.AGGREGATES


@pytest.mark.parametrize("kind", DROPOUTS)
def test_every_dropout_is_the_one_of_its_name(kind):
    """By its parameters and its mean; an unknown name must not fall through to no noise."""
    noise = dropout_of(config.BNN(dropout=kind, rate=0.3, low=-4.0, high=0.5))
    params = noise.init(jax.random.key(0), 5)
    names = dict(log_normal={"location", "scale"}, concrete={"logit"}, gaussian={"logit"}, sparse={"position"})
    assert set(params) == names.get(kind, set())
    mean = np.asarray(noise.retain(params))
    if kind in ("binary", "concrete"):
        np.testing.assert_allclose(mean, 0.7, atol=0.01)  # the rate is the one given
    if kind == "log_normal":
        tall = noise.mask({name: jnp.full(5, 50.0) for name in params}, jnp.full(5, 0.999999))
        np.testing.assert_allclose(tall, np.exp(0.5), rtol=1e-3)  # and so is the interval


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("policy", POLICIES)
def test_every_variant_has_the_shapes_of_the_loop(model, policy):
    """eval_shape traces the loop without compiling it."""
    task = cart() if model == "lagrangian" else dial()  # which has no rates
    exp = compose(settings.parse({"model": model, "policy": policy}), task)
    state = jax.eval_shape(exp.init, jax.random.key(0))
    state = jax.eval_shape(exp.absorb, state, jax.eval_shape(exp.collect, state))
    improved, _ = jax.eval_shape(exp.improve, state)
    assert jax.tree.structure(improved) == jax.tree.structure(state)
    shapes = [[(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(tree)] for tree in (improved, state)]
    assert shapes[0] == shapes[1]


def test_a_mechanism_needs_coordinates_and_their_rates():
    with pytest.raises(SettingError, match=r"model=lagrangian needs .*task=dial.*the nearest is model=log_normal"):
        compose(settings.parse({"model": "lagrangian"}), dial())


def test_the_rates_of_a_gym_are_named_and_checked():
    words = {"task": "gym", "env": "InvertedPendulum-v5", "cost": "math:cos", "model": "lagrangian", "angles": "[1]"}
    compose(known := settings.parse(words | {"rates": "[2,3]"}), tasks.of_config(known))
    for rates, expected in (
        ("[2,9]", "rates=9 is not an entry"),
        ("[1,2]", "model=lagrangian needs"),
        ("[2]", "needs"),
    ):
        wrong = settings.parse(words | {"rates": rates})
        with pytest.raises(SettingError, match=expected):
            compose(wrong, tasks.of_config(wrong))


@pytest.mark.parametrize(
    ("words", "shape"),
    [
        ({"model": "gp", "model.features": "6"}, (2, 6)),
        ({"model": "ssgp", "model.points": "4"}, (2, 8)),
    ],
)
def test_the_size_of_a_gaussian_process_is_the_one_given(words, shape):
    dynamics = compose(settings.parse(words), cart()).dynamics
    data = jax.eval_shape(lambda: dataset.empty(9, 2, 1))
    belief = jax.eval_shape(dynamics.condition, jax.eval_shape(dynamics.init, jax.random.key(0)), data)
    draw = jax.eval_shape(dynamics.sample, jax.random.key(0), belief)
    assert shape in [leaf.shape for leaf in jax.tree.leaves(draw)]


@pytest.mark.parametrize("algorithm", sorted({*ALGORITHMS} - {"pilco"}))
def test_every_algorithm_is_a_matter_of_periods_particles_and_clipping(algorithm):
    chosen = settings.parse({"algorithm": algorithm})
    periods, particles, clip = {
        "pegasus": (Period(start=1, dynamics=100, policy=1, sensor=1, match=1), 100, 1.0),  # docs/decisions/0001
        "paper": (Period(start=1, dynamics=0, policy=0, sensor=0, match=0), 100, 1.0),  # Alg. 3
        "deep_pilco": (Period(1, 1, 1, 1, 1), 10, None),  # Alg. 2
    }[algorithm]
    assert chosen.search.period == periods
    assert (chosen.search.particles, chosen.search.clip) == (particles, clip)
    jax.eval_shape(compose(dataclasses.replace(tiny(), search=chosen.search), cart()).init, jax.random.key(0))


def test_a_config_is_built_once():
    """A tuple of functions hashes by identity: built twice, everything would compile twice."""
    one, two = build(Config()), build(Config())
    assert one is two
    assert build(Config(seed=1)).task.name == "cartpole"


def test_the_data_set_has_room_for_the_whole_run():
    state = jax.eval_shape(compose(tiny(trials=7), cart(horizon=5)).init, jax.random.key(0))
    assert state.data.x.shape == (35, 2)


def test_your_own_model_and_policy_take_the_place_of_the_configured_ones():
    dynamics, policy = known(SCALAR), linear_policy(1, 1)
    exp = compose(tiny(), dial(), dynamics=dynamics, policy=policy)
    assert exp.dynamics is dynamics
    assert exp.policy is policy


@pytest.mark.parametrize(
    ("search", "part"),
    [
        (dict(particles=2, match=True), "search.particles=2"),
        (dict(particles=2, match=False, balanced=True), "search.particles=2"),
    ],
)
def test_too_few_particles_for_a_covariance_are_refused(search, part):
    """Two particles span a line; matching, or balancing, in the two dimensions of the cart would divide by zero."""
    chosen = dataclasses.replace(tiny(), search=config.Search(**search))
    with pytest.raises(SettingError, match=part):
        compose(chosen, cart())


# What reaches the search, seen on pieces that compile in no time: a linear model, noisy, and a linear policy


def eagerly(function):
    """Operation by operation: for one step of a tiny search, nine times faster than compiling it."""

    def call(*arguments):
        with jax.disable_jit():
            return function(*arguments)

    return call


def searcher(gain=-0.5, **search):
    """An experiment under a config, its first state, and a one-step search from it."""
    chosen = dataclasses.replace(
        tiny(), search=config.Search(**{"steps": 1, "particles": 5, "cost": "particles", "widen": 1.0, **search})
    )
    policy = linear_policy(2, 1)._replace(init=lambda key: gain * jnp.array([[1.0, 1.6]]))
    exp = compose(chosen, cart(horizon=2), dynamics=known(PENDULUM, noise_std=0.2), policy=policy)
    return exp, exp.init(jax.random.key(0)), eagerly(exp.search)


def first_objective(**search):
    _, state, run = searcher(**search)
    return float(run(state)[1].objective[0])


def test_settings_of_the_search_reach_the_objective():
    plain = first_objective()
    changes = dict(match=False, balanced=True, discount=0.5, aggregate="total", risk=0.4, cost="matched", widen=2.0)
    values = {name: first_objective(**{name: value}) for name, value in changes.items()}
    np.testing.assert_allclose(values.pop("aggregate"), 2 * plain, rtol=1e-4)  # the sum over 2 steps
    assert values["discount"] < 0.9 * plain
    assert values["risk"] > 1.01 * plain  # the worst two of five
    assert all(abs(value - plain) > 1e-6 for value in values.values()), values
    assert len(set(values.values())) == len(values)


@pytest.mark.parametrize("of", ["particles", "matched"])
def test_a_search_starts_with_the_wider_cost_and_ends_with_the_tasks(of):
    """A cost twice as wide is the task's cost of half the error; from half of the search on it is the task's own."""
    wide = float(searcher(cost=of, widen=2.0)[2](searcher(cost=of)[1])[1].objective[0])
    halved = cart(horizon=2)._replace(
        cost=cost.saturating(lambda x: x / 2, 1.0), expected_cost=cost.expected_saturating(lambda x: x / 2, 1.0, ())
    )
    chosen = dataclasses.replace(tiny(), search=config.Search(steps=1, particles=5, cost=of, widen=1.0))
    exp, state, _ = searcher()
    by_hand = compose(chosen, halved, dynamics=exp.dynamics, policy=exp.policy).search
    np.testing.assert_allclose(wide, eagerly(by_hand)(state)[1].objective[0], rtol=1e-5)
    slow = dict(cost=of, steps=4, learning_rate=1e-30)
    narrowed, plain = (searcher(**slow, widen=widen) for widen in (2.0, 1.0))
    values = [run(state)[1].objective for _, state, run in (narrowed, plain)]
    np.testing.assert_allclose(values[0][2:], values[1][2:], rtol=1e-5)
    assert np.all(values[0][:2] < 0.9 * values[1][:2])


HELD = dict(steps=4, period=Period(0, 0, 0, 0, 0))  # the same scenarios for every iteration
ALONE = dict(match=False, restart=False, **HELD)


def test_a_search_that_lost_its_way_refines_the_policy_it_was_given():
    """With steps of 10 the matched half is of no use. What refines has no matching, and each particle's own cost."""
    _, state, run = searcher(cost="matched", widen=2.0, refine=0.5, learning_rate=10.0, **HELD)
    (after, info), (_, _, alone) = run(state), searcher(learning_rate=1e-30, **ALONE)
    np.testing.assert_allclose(info.objective[2], alone(state)[1].objective[0], rtol=1e-5)
    assert np.any(after.policy.params != state.policy.params)


def test_a_search_that_found_a_better_policy_refines_that():
    better = dict(cost="matched", widen=1.0, learning_rate=0.02)
    _, state, run = searcher(gain=-0.1, refine=0.5, **better, **HELD)
    _, info = run(state)
    exp, _, _ = searcher(gain=-0.1, **better, **HELD)
    found, _ = eagerly(partial(exp.search, steps=2))(state)
    _, _, alone = searcher(learning_rate=1e-30, **ALONE)
    np.testing.assert_allclose(info.objective[2], alone(found)[1].objective[0], rtol=1e-5)
    assert info.objective[2] < alone(state)[1].objective[0]


def test_a_refining_search_in_parts_is_the_whole():
    exp, state, run = searcher(cost="matched", widen=2.0, refine=0.5, learning_rate=10.0, **HELD)
    part, parts = eagerly(partial(exp.search, steps=1)), state
    for first in range(4):
        parts, _ = part(parts, first)
    np.testing.assert_allclose(parts.policy.params, run(state)[0].policy.params, rtol=1e-6)


def test_a_cost_without_a_width_cannot_be_widened():
    task = cart(horizon=2)._replace(widened=None)
    with pytest.raises(SettingError, match=r"search\.widen=4 needs a cost with a width.*the nearest is 1"):
        compose(tiny(), task)


def test_truncation_reaches_the_gradient_and_only_that():
    (_, state, run), (_, _, cut) = searcher(), searcher(truncate=1)
    (_, plain), (_, truncated) = run(state), cut(state)
    assert plain.objective[0] == truncated.objective[0]
    assert abs(plain.gradient_norm[0] - truncated.gradient_norm[0]) > 1e-3


def test_a_limit_reaches_the_gradient_as_a_share_of_each_particle():
    (_, state, run), (_, _, limited), (_, _, loose) = searcher(), searcher(limit=1e-3), searcher(limit=1e6)
    plain, short, same = (f(state)[1] for f in (run, limited, loose))
    assert plain.objective[0] == short.objective[0]
    assert short.gradient_norm[0] < 0.9 * plain.gradient_norm[0]
    np.testing.assert_allclose(same.gradient_norm[0], plain.gradient_norm[0], rtol=1e-5)


def test_a_step_size_falls_as_half_a_cosine_and_begins_again():
    rate = falling(2.0, 0.1, 100)
    sizes = [float(rate(i)) for i in (0, 50, 99, 100, 150)]
    np.testing.assert_allclose(sizes, [2.0, 1.1, 0.2, 2.0, 1.1], atol=1e-3)
    assert falling(2.0, 1.0, 100) == 2.0


def test_a_falling_step_size_reaches_the_search():
    """Adam's first step is as long as the step size; of three that fall to nothing the others are 3/4 and 1/4 of it."""
    moved = {}
    for decay in (1.0, 0.0):
        _, state, run = searcher(steps=3, decay=decay, learning_rate=1e-4, period=Period(0, 0, 0, 0, 0))
        moved[decay] = np.abs(run(state)[0].policy.params - state.policy.params)
    np.testing.assert_allclose(moved[0.0], moved[1.0] * 2 / 3, rtol=0.02)


def test_a_falling_step_size_reaches_the_fit():
    """One row, so that every gradient has the same sign."""
    dynamics, moved = dynamics_of(config.BNN(hidden=(4,)), cart()), {}
    row = jnp.ones((1, 2)), jnp.ones((1, 1)), jnp.ones((1, 2))
    for decay in (1.0, 0.0):
        fit = fit_of(config.Fit(steps=2, batch=1, decay=decay, learning_rate=1e-5), dynamics)
        params = dynamics.init(jax.random.key(0))
        learner, _ = fit.run(jax.random.key(1), Learner(params, fit.init(params)), Dataset(*row, jnp.int32(1)), 2)
        moved[decay] = np.abs(ravel_pytree(learner.params)[0] - ravel_pytree(params)[0]).max()
    np.testing.assert_allclose(moved[0.0], moved[1.0] * 3 / 4, rtol=0.05)


def test_the_best_parameters_of_a_search_reach_the_policy():
    """One step: they are those it began with, while the last are one step further."""
    moved, kept = (searcher(best=best) for best in (False, True))
    before = moved[1].policy.params
    assert not np.array_equal(moved[2](moved[1])[0].policy.params, before)
    state, info = kept[2](kept[1])
    assert np.array_equal(state.policy.params, before)
    assert info.gradient_norm[0] > 0


def test_each_factor_of_the_noise_reaches_its_place():
    """What the policy sees decides its controls, the state's own noise the states, the cost's only what it sees."""

    def imagined(**search):
        exp, state, _ = searcher(**{"match": False, "policy_noise": 0.0, **search})
        return eagerly(exp.imagine)(state)[0]

    plain = imagined()
    blur = np.asarray(imagined(cost_noise=1.0).seen - plain.seen)
    assert np.all(blur != 0)
    seen = imagined(cost_noise=0.5)
    assert np.array_equal(seen.x, plain.x)
    np.testing.assert_allclose(seen.seen - plain.seen, 0.5 * blur, atol=1e-5)
    moved = imagined(state_noise=0.5)
    np.testing.assert_allclose(moved.x[1] - plain.x[1], 0.5 * blur[0], atol=1e-5)
    told = imagined(policy_noise=0.5)
    np.testing.assert_allclose((told.u - plain.u)[1, :, 0], 0.5 * blur[0] @ np.array([-0.5, -0.8]), atol=1e-5)
    assert np.array_equal(told.x[1], plain.x[1])


def test_as_few_particles_as_are_allowed_do():
    assert np.isfinite(first_objective(particles=3, balanced=True))


def test_clipping_reaches_the_optimiser():
    """Adam's step hides the size of a gradient; its first moment, a tenth of what it was given, does not."""
    moved = {}
    for clip in (None, 1e-6):
        _, state, run = searcher(clip=clip)
        state, info = run(state)
        moved[clip] = float(jnp.linalg.norm(state.policy.optimizer.inner_state[1][0].mu))
        assert info.gradient_norm[0] > 1e-4
    np.testing.assert_allclose(moved[None], 0.1 * info.gradient_norm[0], rtol=1e-3)
    np.testing.assert_allclose(moved[1e-6], 0.1 * 1e-6, rtol=1e-3)


def test_the_search_minimises_what_objective_says():
    """The first objective of a search is `objective` of the public pieces, put together by hand."""
    exp, state, run = searcher()
    pieces = dict(dynamics=exp.dynamics, policy=exp.policy)
    of_task = partial(start, task=exp.task)
    blocks = scenarios.blocks(**pieces, start=of_task, particles=5, horizon=2, balanced=False)
    given = scenarios.draw(trial_key(state.key, 0, SEARCH), 0, None, blocks=blocks, period=types.Period())
    of_particles = cost.of_particles(exp.task.cost)
    by_hand = objective(state.policy.params, None, given, **pieces, match=moments.match, cost=of_particles)
    np.testing.assert_allclose(run(state)[1].objective[0], by_hand, rtol=1e-5)


def test_first_states_are_those_of_the_task():
    x = np.asarray(jax.vmap(partial(start, task=cart()))(jax.random.split(jax.random.key(0), 2000)))
    np.testing.assert_allclose(x.mean(0), [1.0, 0.0], atol=0.02)
    np.testing.assert_allclose(x.std(0), [0.1, 0.1], atol=0.02)


# PILCO

ANALYTIC = config.Analytic(steps=3, particles=5, restart=False)


def small_pilco(model, policy, task, **search):
    """An experiment of PILCO with the real pieces, small."""
    size = dict(states=len(task.state_names), controls=len(task.control_names), angles=task.angles)
    dynamics = {"gp": partial(gp, features=8), "ssgp": partial(ssgp, points=5)}[model](**size)
    sections = dict(policy=policy, search=dataclasses.replace(ANALYTIC, **search))
    return compose(dataclasses.replace(tiny(trials=2), **sections), task, dynamics=dynamics)


@pytest.mark.parametrize(
    ("model", "policy", "task"),
    [
        ("gp", config.Linear(), cart),
        ("ssgp", config.RBF(units=4), dial),
    ],
    ids=["gp-linear", "ssgp-rbf"],
)
def test_pilco_improves_a_policy_under_a_model(model, policy, task):
    """Jitted, deterministic, in whatever precision; the objective falls, and the policy is all that changes."""
    exp = small_pilco(model, policy, task(horizon=4))

    @jax.jit
    def start(key):
        state = exp.init(key)
        return exp.absorb(state, exp.collect(state))

    state = start(jax.random.key(0))
    search = jax.jit(exp.search)
    after, info = search(state)
    assert same(search(state), (after, info))
    assert np.all(np.isfinite(info.gradient_norm))
    assert info.objective[-1] < info.objective[0]
    assert same(after.model, state.model)
    assert not same(after.policy.params, state.policy.params)
    assert jax.tree.map(jnp.shape, after) == jax.tree.map(jnp.shape, state)
    rolled, costs = jax.jit(exp.imagine)(after)
    assert rolled.x.shape[:2] == (5, 5)
    assert costs.shape == (4, 5)


@pytest.mark.parametrize(
    ("policy", "pieces", "part"),
    [
        (config.RBF(), {}, "model=ssgp"),
        (config.MLP(), {"dynamics": True}, "policy=rbf, policy=linear"),
        (config.RBF(squash="tanh"), {"dynamics": True}, "policy=rbf"),
        (config.RBF(), {"dynamics": True, "task": True}, "closed form"),
    ],
)
def test_pilco_without_moments_is_refused(policy, pieces, part):
    """Naming what has them."""
    model = gp(states=2, controls=1, angles=()) if "dynamics" in pieces else None
    task = cart()._replace(expected_cost=None) if "task" in pieces else cart()
    with pytest.raises(SettingError, match=part) as caught:
        compose(dataclasses.replace(tiny(), policy=policy, search=ANALYTIC), task, dynamics=model)
    assert "\n" not in str(caught.value)


def test_a_cost_without_an_expectation_cannot_be_matched():
    with pytest.raises(SettingError, match=r"search\.cost=matched needs"):
        compose(dataclasses.replace(tiny(), search=config.Search(cost="matched")), cart()._replace(expected_cost=None))


def test_the_settings_of_pilcos_search_reach_its_objective():
    change = jnp.asarray(np.hstack([PENDULUM.a - np.eye(2), PENDULUM.b]), jnp.float32)
    dynamics = known(PENDULUM, noise_std=0.2)._replace(moments=lambda _, mean, cov: affine(mean, cov, change))
    policy = linear_policy(2, 1)._replace(moments=lambda gain, mean, cov: affine(mean, cov, gain))

    def value(**search):
        chosen = dataclasses.replace(ANALYTIC, **{"policy_noise": 0.0, "state_noise": 0.0, **search})
        searcher, _ = search_of(chosen, cart(horizon=3), dynamics, policy)
        params = jnp.full((1, 2), -0.5)
        run = jax.jit(partial(searcher.run, first=0, steps=1))
        return float(run(jax.random.key(0), Learner(params, searcher.init(params)), None)[1].objective[0])

    plain = value()
    np.testing.assert_allclose(value(aggregate="total"), 3 * plain, rtol=1e-4)
    values = [value(discount=0.5), *(value(**{f"{name}_noise": 1.0}) for name in ("policy", "state", "cost"))]
    assert all(abs(value - plain) > 1e-4 for value in values), (plain, values)
    assert len(set(values)) == 4
