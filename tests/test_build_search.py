"""What a config says of a search reaches the search: its objective, its gradient, its course."""

import dataclasses
import sys
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from pegasus_jax import config, types
from pegasus_jax.assembly.experiments import compose
from pegasus_jax.assembly.pieces import dynamics_of, fit_of
from pegasus_jax.assembly.searchers import costs_of, start
from pegasus_jax.checks import ConfigError
from pegasus_jax.config import Period
from pegasus_jax.experiment import SEARCH, trial_key
from pegasus_jax.imagine import costs as cost
from pegasus_jax.imagine import matching, scenarios
from pegasus_jax.imagine.objective import objective
from pegasus_jax.learn.fit import falling
from pegasus_jax.types import Cost, Dataset, TrainState
from probes import PENDULUM, cart, known, linear_policy, tiny


@cache  # many tests ask for the same one, such as the plain one: it is traced and compiled once
def searcher(gain=-0.5, scatter=0.0, **search):
    """An experiment under a config, its first state, and a one-step search from it, which weighs no fresh policy."""
    plain = {"steps": 1, "particles": 5, "cost_estimator": "particles", "cost_width_start": 1.0, "init": "previous"}
    chosen = dataclasses.replace(tiny(), search=config.Search(**{**plain, **search}))
    policy = linear_policy(2, 1)._replace(
        init=lambda key: gain * jnp.array([[1.0, 1.6]]) + scatter * jax.random.normal(key, (1, 2))
    )
    exp = compose(chosen, cart(horizon=2), dynamics=known(PENDULUM, noise_std=0.2), policy=policy)
    return exp, exp.init(jax.random.key(0)), jax.jit(exp.search)


def first_objective(**search):
    _, state, run = searcher(**search)
    return float(run(state)[1].objective[0])


def test_settings_of_the_search_reach_the_objective():
    plain = first_objective()
    changes = dict(matching="never", standardized_noise=True, cost_estimator="gaussian", cost_width_start=2.0)
    values = {name: first_objective(**{name: value}) for name, value in changes.items()}
    assert all(abs(value - plain) > 1e-6 for value in values.values()), values
    assert len(set(values.values())) == len(values)


@pytest.mark.parametrize("of", ["particles", "gaussian"])
def test_a_search_starts_with_the_wider_cost_and_ends_with_the_tasks(of):
    """A cost twice as wide is the task's cost of half the error; from half of the search on it is the task's own."""
    wide = float(searcher(cost_estimator=of, cost_width_start=2.0)[2](searcher(cost_estimator=of)[1])[1].objective[0])
    halved = cart(horizon=2)._replace(cost=cost.saturating(lambda x: x / 2, 1.0, ()))
    chosen = dataclasses.replace(
        tiny(), search=config.Search(steps=1, particles=5, cost_estimator=of, cost_width_start=1.0)
    )
    exp, state, _ = searcher()
    by_hand = compose(chosen, halved, dynamics=exp.dynamics, policy=exp.policy).search
    np.testing.assert_allclose(wide, jax.jit(by_hand)(state)[1].objective[0], rtol=1e-5)
    slow = dict(cost_estimator=of, steps=4, learning_rate=1e-30)
    narrowed, plain = (searcher(**slow, cost_width_start=widen) for widen in (2.0, 1.0))
    values = [run(state)[1].objective for _, state, run in (narrowed, plain)]
    np.testing.assert_allclose(values[0][2:], values[1][2:], rtol=1e-5)
    assert np.all(values[0][:2] < 0.9 * values[1][:2])


HELD = dict(steps=4, period=Period(0, 0, 0, 0, 0))  # the same scenarios for every iteration
ALONE = dict(matching="never", **HELD)


def test_a_search_that_refines_for_no_iteration_weighs_once_at_its_end():
    _, state, run = searcher(
        cost_estimator="gaussian", cost_width_start=2.0, refine_fraction=0.01, learning_rate=10.0, **HELD
    )
    after, info = run(state)
    assert np.array_equal(after.policy.params, state.policy.params)
    assert np.all(np.isfinite(info.objective))
    assert np.all(np.isfinite(info.gradient_norm))


def test_a_search_that_lost_its_way_refines_and_ends_with_the_policy_it_was_given():
    """With steps of 10 neither half is of use. What refines has no matching, and each particle's own cost."""
    _, state, run = searcher(
        cost_estimator="gaussian", cost_width_start=2.0, refine_fraction=0.5, learning_rate=10.0, **HELD
    )
    (after, info), (_, _, alone) = run(state), searcher(learning_rate=1e-30, **ALONE)
    np.testing.assert_allclose(info.objective[1:], alone(state)[1].objective[0], rtol=1e-5)
    assert np.array_equal(after.policy.params, state.policy.params)


def test_a_search_that_found_a_better_policy_refines_that():
    better = dict(cost_estimator="gaussian", cost_width_start=1.0, learning_rate=0.02)
    _, state, run = searcher(gain=-0.1, refine_fraction=0.5, **better, **HELD)
    after, info = run(state)
    exp, _, _ = searcher(gain=-0.1, **better, **HELD)
    found, _ = jax.jit(partial(exp.search, steps=2))(state)
    _, _, alone = searcher(learning_rate=1e-30, **ALONE)
    np.testing.assert_allclose(info.objective[2], alone(found)[1].objective[0], rtol=1e-5)
    assert alone(after)[1].objective[0] < info.objective[2] < alone(state)[1].objective[0]


def test_after_a_stale_search_the_next_begins_from_a_fresh_policy_and_keeps_the_old():
    """Nothing moves at this step size, so that the first search goes back to the policy it was given: a better one."""
    still = dict(gain=0.3, refine_fraction=0.5, learning_rate=1e-30, cost_estimator="gaussian", **HELD)
    (_, fresh, run), (_, _, obstinate) = searcher(init="better", **still), searcher(**still)
    good = -0.5 * jnp.array([[1.0, 1.6]])
    stale, info = run(fresh._replace(policy=TrainState(good, fresh.policy.optimizer)))
    again, known = run(stale)
    assert np.array_equal(stale.policy.params, good)
    assert np.array_equal(again.policy.params, good)
    assert known.objective[0] == obstinate(fresh)[1].objective[0] > info.objective[0]
    assert obstinate(stale)[1].objective[0] == info.objective[0]


def test_a_search_that_always_begins_anew_keeps_a_policy_that_is_better():
    """As after a stale one, but from its first search on, and whatever the search before it found."""
    still = dict(gain=0.3, refine_fraction=0.5, learning_rate=1e-30, cost_estimator="gaussian", **HELD)
    (_, fresh, run), (_, _, usual) = (searcher(init=init, **still) for init in ("fresh", "better"))
    good = -0.5 * jnp.array([[1.0, 1.6]])
    state = fresh._replace(policy=TrainState(good, fresh.policy.optimizer))
    after, info = run(state)
    assert info.objective[0] == usual(fresh)[1].objective[0] > usual(state)[1].objective[0]
    assert np.array_equal(after.policy.params, good)
    assert info.objective[-1] < info.objective[0]


def test_after_a_search_that_found_a_better_policy_the_next_begins_from_that():
    better = dict(
        gain=-0.1, cost_estimator="gaussian", cost_width_start=1.0, learning_rate=0.02, refine_fraction=0.5, **HELD
    )
    _, state, run = searcher(init="better", **better)
    after, _ = run(state)
    _, _, obstinate = searcher(**better)
    assert run(after)[1].objective[0] == obstinate(after)[1].objective[0] != run(state)[1].objective[0]


def test_of_several_that_lost_their_way_the_best_that_was_given_goes_on():
    lost = dict(cost_estimator="gaussian", cost_width_start=2.0, refine_fraction=0.5, learning_rate=10.0, **HELD)
    _, state, run = searcher(scatter=0.3, num_starts=3, **lost)
    after, info = run(state)
    members = after.policy.optimizer.params
    assert np.array_equal(members[0], state.policy.params)
    _, begun, alone = searcher(learning_rate=1e-30, **ALONE)
    own = [begun._replace(policy=begun.policy._replace(params=params)) for params in members]
    costs = [float(alone(one)[1].objective[0]) for one in own]
    assert len(set(costs)) == 3
    assert np.array_equal(after.policy.params, members[int(np.argmin(costs))])
    np.testing.assert_allclose(info.objective[-1], min(costs), rtol=1e-5)


def test_what_refines_is_imagined_as_it_was_searched():
    """A refined policy is good for particles; under their Gaussian it would be reported as worse than it is."""

    def fresh(**search):
        exp, state, _ = searcher(**search)
        return jax.jit(exp.imagine)(state)[1]

    assert np.array_equal(fresh(refine_fraction=0.5), fresh(matching="never"))
    assert not np.array_equal(fresh(refine_fraction=0.0), fresh(matching="never"))


def test_a_refining_search_in_parts_is_the_whole():
    exp, state, run = searcher(
        cost_estimator="gaussian", cost_width_start=2.0, refine_fraction=0.5, learning_rate=10.0, **HELD
    )
    part, parts = jax.jit(partial(exp.search, steps=1)), state
    for first in range(4):
        parts, _ = part(parts, first)
    whole = run(state)[0].policy
    np.testing.assert_allclose(parts.policy.params, whole.params, rtol=1e-6)
    assert all(learner.optimizer.no_improvement for learner in (parts.policy, whole))


def test_what_is_weighed_needs_no_second_program(monkeypatch):
    """The objective is traced as often with a restart and turns as without: to compile it again would take as long."""
    traced = []
    counted = lambda *given, **pieces: traced.append(1) or objective(*given, **pieces)  # noqa: E731
    monkeypatch.setattr(sys.modules["pegasus_jax.assembly.searchers"], "objective", counted)

    def times(**search):
        traced.clear()
        exp, state, _ = searcher.__wrapped__(steps=4, **search)
        jax.eval_shape(exp.search, state)
        return len(traced)

    assert times(refine_fraction=0.5, init="better") == times(refine_fraction=0.5) == times() > 0


def test_an_annealing_search_goes_on_where_that_of_the_trial_before_ended():
    """Two searches of two iterations narrow as one of four; in a third the cost is the task's, the step size 0."""
    course = dict(
        steps=2, learning_rate=1e-4, cost_width_start=2.0, decay=0.0, anneal_trials=2, period=Period(0, 0, 0, 0, 0)
    )
    _, state, run = searcher(**course)
    _, _, plain = searcher(**{**course, "cost_width_start": 1.0, "learning_rate": 1e-30, "anneal_trials": 1})
    moved = []
    for trial, wider in ((1, True), (2, False), (3, False)):
        now = state._replace(trial=jnp.int32(trial))
        (after, info), (_, task) = run(now), plain(now)
        if wider:
            assert np.all(info.objective < 0.95 * task.objective)
        else:
            np.testing.assert_allclose(info.objective, task.objective, rtol=1e-2)
        moved.append(np.abs(after.policy.params - now.policy.params).max())
    # Adam's first two steps are as long as the step size, and that is half a cosine: (1 + cos(pi j / 4)) / 2 of 1e-4.
    factors = (1 + np.cos(np.pi * np.arange(4) / 4)) / 2
    np.testing.assert_allclose(moved, [1e-4 * factors[:2].sum(), 1e-4 * factors[2:].sum(), 0], rtol=0.05, atol=1e-9)


def test_an_annealing_search_has_one_course():
    with pytest.raises(ConfigError, match=r"search.anneal_trials=2 needs search.refine_fraction=0"):
        config.Search(anneal_trials=2, refine_fraction=0.5)


@pytest.mark.parametrize("stop", [None, lambda x: jax.nn.sigmoid(9 * x[0])])
def test_a_cost_that_is_only_a_function_is_widened_as_well(stop):
    """Each particle's exactly, and their expectation by nodes; what an early end costs is not."""
    task = cart(horizon=3)._replace(stop=stop, stop_cost=1.5)
    x = 0.4 * jax.random.normal(jax.random.key(0), (3, 20, len(task.state_names)))
    for of, near in (("particles", 1e-6), ("gaussian", 0.01)):
        costs = (
            costs_of(config.Search(cost_estimator=of), t) for t in (task, task._replace(cost=Cost(task.cost.of_state)))
        )
        known, own = (jax.jit(lambda x, f=f: f(None, jnp.array(2.0))(x))(x) for f in costs)
        np.testing.assert_allclose(own, known, atol=near)


@pytest.mark.parametrize("refining", [True, None])
def test_a_particle_that_is_over_has_no_part_in_what_the_others_cost(refining):
    """Half of them end at once, and cost `stop_cost` from then on; the others are at the goal, alone or wide apart."""
    free = Cost(lambda x: jnp.where(jnp.abs(x[0]) > 1, 1.0, 0.0))
    task = cart(horizon=4)._replace(stop=lambda x: jnp.abs(x[0]) > 1, stop_cost=0.5, cost=free, angles=(1,))
    x = jnp.zeros((4, 10, 2)).at[:, :5, 0].set(3.0).at[:, ::2, 1].set(0 if refining else 3.0)
    asked = None if refining is None else jnp.asarray(refining)
    found = costs_of(config.Search(cost_estimator="gaussian", matching="narrow"), task)(asked, None)(x)
    np.testing.assert_allclose(jnp.mean(found, 1), [0.5, 0.25, 0.25, 0.25])


def test_a_model_that_diverges_beyond_an_end_spoils_no_search():
    """What has ended stays where it is: a model says nothing of what comes then."""
    runaway = known(PENDULUM._replace(a=1e3 * PENDULUM.a), noise_std=0.01)
    task = cart(horizon=40)._replace(stop=lambda x: jnp.abs(x[0]) > 1)
    exp = compose(tiny(search__steps=5), task, dynamics=runaway)
    _, info = jax.jit(exp.search)(exp.init(jax.random.key(0)))
    assert info.skipped == 0
    assert np.isfinite(info.objective).all()


def test_the_matched_cost_of_any_function_is_that_of_its_nodes():
    """Near the closed form of the same cost, which was not asked for; and of no width."""
    task, search = cart(horizon=3), config.Search(cost_estimator="gaussian", cost_width_start=1)
    x = 0.4 * jax.random.normal(jax.random.key(0), (3, 20, len(task.state_names)))
    own = costs_of(search, task._replace(cost=Cost(task.cost.of_state)))(None, None)(x)
    known = costs_of(search, task)(None, None)(x)
    assert own.shape == (3, 1)
    by_nodes = cost.expected_by_nodes(task.cost.of_state)
    np.testing.assert_allclose(own, cost.of_matched(task.cost._replace(expected=by_nodes))(x), rtol=1e-6)
    assert np.all(own != known)
    np.testing.assert_allclose(own, known, atol=0.03)


def test_a_limit_reaches_the_gradient_as_a_share_of_each_particle():
    (_, state, run), (_, _, limited), (_, _, loose) = (
        searcher(),
        searcher(particle_grad_limit=1e-3),
        searcher(particle_grad_limit=1e6),
    )
    plain, short, same = (f(state)[1] for f in (run, limited, loose))
    assert plain.objective[0] == short.objective[0]
    assert short.gradient_norm[0] < 0.9 * plain.gradient_norm[0]
    np.testing.assert_allclose(same.gradient_norm[0], plain.gradient_norm[0], rtol=1e-5)


@pytest.mark.parametrize(
    ("search", "message"),
    [
        (
            dict(warm_restart=0.3, decay=0.1),
            "search.warm_restart=0.3 needs searches that cool, search.anneal_trials=10",
        ),
        (
            dict(warm_restart=0.3, anneal_trials=10),
            "search.warm_restart=0.3 needs searches that cool, search.anneal_trials=10",
        ),
        (
            dict(warm_limit_factor=30, particle_grad_limit=1.0),
            "search.warm_limit_factor=30 needs search.particle_grad_limit=1 search.warm_restart=0.3",
        ),
        (
            dict(warm_limit_factor=30, warm_restart=0.3, anneal_trials=10, decay=0.1),
            "search.warm_limit_factor=30 needs search.particle_grad_limit=1 search.warm_restart=0.3",
        ),
    ],
)
def test_only_what_is_annealed_is_reheated_and_only_a_limit_loosened(search, message):
    with pytest.raises(ConfigError, match=message):
        config.Search(**search)


def test_after_the_annealed_searches_each_is_reheated_and_its_limit_loosened():
    """Trials 2, 3 and 4 under the same scenarios: 1 and 2 are annealed, to a step of nothing; one step each."""
    course = dict(steps=1, learning_rate=1e-4, decay=0.0, anneal_trials=2, period=Period(0, 0, 0, 0, 0))
    _, state, run = searcher(**course, particle_grad_limit=1e-3, warm_restart=0.3, warm_limit_factor=1e9)
    _, _, plain = searcher(**course)
    at = [state._replace(trial=jnp.int32(trial)) for trial in (2, 3, 4)]
    moved = [np.max(np.abs(run(before)[0].policy.params - before.policy.params)) for before in at]
    np.testing.assert_allclose(moved, [0.5e-4, 0.3e-4, 0.3e-4], rtol=0.01)
    norms = [[float(f(before)[1].gradient_norm[0]) for f in (run, plain)] for before in at]
    assert norms[0][0] < 0.9 * norms[0][1]
    np.testing.assert_allclose([of[0] for of in norms[1:]], [of[1] for of in norms[1:]], rtol=1e-5)


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
        fit = fit_of(config.Fit(steps=2, batch_size=1, decay=decay, learning_rate=1e-5), dynamics)
        params = dynamics.init(jax.random.key(0))
        learner, _ = fit.run(jax.random.key(1), TrainState(params, fit.init(params)), Dataset(*row, jnp.int32(1)), 2)
        moved[decay] = np.abs(ravel_pytree(learner.params)[0] - ravel_pytree(params)[0]).max()
    np.testing.assert_allclose(moved[0.0], moved[1.0] * 3 / 4, rtol=0.05)


def test_each_factor_of_the_noise_reaches_its_place():
    """What the policy sees decides its controls, the state's own noise the states."""

    def imagined(**search):
        exp, state, _ = searcher(**{"matching": "never", "policy_noise": 0.0, **search})
        return jax.jit(exp.imagine)(state)[0]

    plain = imagined()
    blur = np.asarray(imagined(state_noise=1.0).x[1] - plain.x[1])
    assert np.all(blur != 0)
    moved = imagined(state_noise=0.5)
    np.testing.assert_allclose(moved.x[1] - plain.x[1], 0.5 * blur, atol=1e-5)
    told = imagined(policy_noise=0.5)
    np.testing.assert_allclose((told.u - plain.u)[1, :, 0], 0.5 * blur @ np.array([-0.5, -0.8]), atol=1e-5)
    assert np.array_equal(told.x[1], plain.x[1])
    known = imagined(
        policy_noise=1.0, observation_noise="plant"
    )  # .01 of the plant, and not the .2 that the model predicts
    np.testing.assert_allclose((known.u - plain.u)[1, :, 0], blur / 20 @ np.array([-0.5, -0.8]), atol=1e-6)


def test_sensors_that_are_not_known_cannot_be_expected():
    task = cart()._replace(sensor_std=np.zeros(2))
    with pytest.raises(ConfigError, match=r"search.observation_noise=plant needs .* task=cart is not; the nearest is"):
        compose(dataclasses.replace(tiny(), search=config.Search(observation_noise="plant")), task)


def test_as_few_particles_as_are_allowed_do():
    assert np.isfinite(first_objective(particles=3, standardized_noise=True))


def test_clipping_reaches_the_optimizer():
    """Adam's step hides the size of a gradient; its first moment, a tenth of what it was given, does not."""
    moved = {}
    for clip in (None, 1e-6):
        _, state, run = searcher(grad_clip=clip)
        state, info = run(state)
        moved[clip] = float(jnp.linalg.norm(state.policy.optimizer.optimizer[1][0].mu))
        assert info.gradient_norm[0] > 1e-4
    np.testing.assert_allclose(moved[None], 0.1 * info.gradient_norm[0], rtol=1e-3)
    np.testing.assert_allclose(moved[1e-6], 0.1 * 1e-6, rtol=1e-3)


def test_the_search_minimizes_what_objective_says():
    """The first objective of a search is `objective` of the public pieces, put together by hand."""
    exp, state, run = searcher()
    pieces = dict(dynamics=exp.dynamics, policy=exp.policy)
    of_task = partial(start, task=exp.task)
    blocks = scenarios.blocks(**pieces, start=of_task, particles=5, horizon=2, standardized_noise=False)
    given = scenarios.draw(trial_key(state.key, 0, SEARCH), 0, None, blocks=blocks, period=types.Period())
    of_particles = cost.of_particles(exp.task.cost)
    by_hand = objective(state.policy.params, None, given, **pieces, match=matching.match, cost=of_particles)
    np.testing.assert_allclose(run(state)[1].objective[0], by_hand, rtol=1e-5)
