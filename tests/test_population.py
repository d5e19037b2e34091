"""Several searches side by side: each is the search it would be alone, and the best of them goes on."""

from functools import partial
from operator import itemgetter

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from pegasus_jax import config
from pegasus_jax.assembly.experiments import compose
from pegasus_jax.assembly.searchers import fresh_policies, judged
from pegasus_jax.checks import ConfigError
from pegasus_jax.imagine import limits
from pegasus_jax.imagine.scenarios import Sampler
from pegasus_jax.learn.gradient import SearchInfo
from pegasus_jax.learn.multistart import best_of
from pegasus_jax.learn.schedule import search_table
from pegasus_jax.learn.search import Problem, searcher
from pegasus_jax.types import PolicyOptimizer, Rollout, TrainState
from probes import cart, noisy_linear_policy, regression, same, tiny, unchecked

STARTS, STEPS, DEEPER = 4, 60, 0.1


def wells(params, posterior):
    """Two valleys, at -1 and 1; the posterior says how much deeper that at 1 is. Beyond 3 nothing is known."""
    return jnp.where(params > 3, jnp.nan, (params**2 - 1) ** 2 - posterior * params)


def descent():
    """Plain gradient descent, as a searcher without scenarios; each search begins with a new optimizer."""
    optimizer = optax.sgd(0.02, momentum=0.5)

    def run(key, learner, posterior, *, first, steps, earlier=0):
        def step(learner, _):
            value, gradient = jax.value_and_grad(wells)(learner.params, posterior)
            updates, state = optimizer.update(gradient, learner.optimizer)
            return TrainState(learner.params + updates, state), (value, jnp.abs(gradient))

        renewed = TrainState(learner.params, optimizer.init(learner.params))
        learner = optax.tree.where(jnp.asarray(first) == 0, renewed, learner)
        learner, (values, norms) = jax.lax.scan(step, learner, None, steps)
        return learner, SearchInfo(values, norms, jnp.int32(0))

    return PolicyOptimizer(optimizer.init, run)


def found(own, others, key=0, calls=1):
    """(learner, info) of a search of 60 iterations in so many calls."""
    searcher = best_of(descent(), num_starts=STARTS, window=STEPS // 20)
    fresh = jax.random.choice(jax.random.key(key), jnp.asarray(others), (STARTS - 1,))
    learner = TrainState(jnp.float32(own), searcher.init(jnp.float32(own)))
    run, info = jax.jit(partial(searcher.run, steps=STEPS // calls)), None
    for call in range(calls):
        learner, info = run(None, learner, DEEPER, first=call * (STEPS // calls), fresh=fresh)
    return learner, info


def test_a_policy_in_the_wrong_valley_gives_way_to_a_fresh_one():
    learner, info = found(-1.2, [0.8])
    np.testing.assert_allclose(learner.params, 1.0, atol=0.05)
    np.testing.assert_allclose(info.objective[-1], wells(learner.params, DEEPER), atol=1e-5)
    np.testing.assert_allclose(learner.optimizer.params[0], -1.0, atol=0.05)  # it was searched from, too


def test_a_policy_in_the_right_valley_stays_itself():
    learner, _ = found(1.2, [-0.8])
    alone, _ = descent().run(
        None, TrainState(jnp.float32(1.2), optax.sgd(0.02, momentum=0.5).init(0.0)), DEEPER, first=0, steps=STEPS
    )
    np.testing.assert_allclose(learner.params, alone.params, rtol=1e-6)


def test_what_is_not_a_number_is_never_the_best():
    learner, info = found(-1.2, [4.0])
    np.testing.assert_allclose(learner.params, -1.0, atol=0.05)
    assert np.all(np.isfinite(info.objective))


def test_two_calls_do_what_one_does():
    (once, _), (twice, info) = found(-1.2, [0.5, 0.8]), found(-1.2, [0.5, 0.8], calls=2)
    assert same(once, twice)
    assert info.objective.shape == (STEPS // 2,)


def test_every_search_has_fresh_policies_of_its_own():
    others = np.linspace(-2, 2, 101)
    members = [found(0.3, others, key=key)[0].optimizer.params for key in (0, 0, 1)]
    assert np.array_equal(members[0], members[1])
    assert members[0][0] == members[2][0]  # the policy itself
    assert not np.any(members[0][1:] == members[2][1:])


def test_policies_that_last_go_on_from_search_to_search_and_others_are_fresh_in_each():
    draws = jax.random.uniform(jax.random.key(0), (2, STARTS - 1), minval=-2.0, maxval=2.0)

    def members(lasting):
        """After a search of 3 iterations, and after one more, with other fresh policies."""
        searcher = best_of(descent(), num_starts=STARTS, window=1, lasting=lasting)
        learner = TrainState(jnp.float32(0.3), searcher.init(jnp.float32(0.3)))
        first, _ = searcher.run(None, learner, DEEPER, first=0, earlier=0, steps=3, fresh=draws[0])
        second, _ = searcher.run(None, first, DEEPER, first=0, earlier=1, steps=3, fresh=draws[1])
        return first, second

    begun = jax.vmap(lambda own: descent().run(None, TrainState(own, descent().init(own)), DEEPER, first=0, steps=3)[0])
    first, second = members(lasting=True)
    assert len(set(first.optimizer.params.tolist())) == STARTS
    np.testing.assert_allclose(second.optimizer.params, begun(first.optimizer.params).params, rtol=1e-6)
    first, second = members(lasting=False)
    np.testing.assert_allclose(second.optimizer.params[0], begun(first.params[None]).params[0], rtol=1e-6)
    assert not np.any(np.isclose(second.optimizer.params[1:], begun(first.optimizer.params).params[1:], rtol=1e-3))


@pytest.mark.parametrize(
    ("lasting", "went_on", "stayed"),
    # Rises and falls of the multipliers of the given policy, and of two others that break the constraint.
    [(False, [2, 2, 2], [-2, 0, 0]), (True, [-2, 2, 2], [-2, 2, 2])],
)
def test_a_constraints_multiplier_goes_on_from_search_to_search(lasting, went_on, stayed):
    """That of the member whose policy it is: of the first, if the policy that it began with went on instead."""

    def value(p, posterior, target, row, multiplier):
        return -p + 0 * multiplier, jnp.asarray(p > 0.5, float)

    still = Sampler(lambda *_: jnp.zeros(()), lambda *_: jnp.zeros(()))
    problem = Problem(value, still, optax.sgd(0.0), search_table(3), ascend=partial(limits.ascend, bound=0.5))
    best = best_of(searcher(problem), num_starts=3, window=1, lasting=lasting)
    run, own = jax.jit(partial(best.run, steps=3, first=0)), jnp.float32(0.0)

    def rises(learner):
        return (learner.optimizer.optimizer.multiplier - limits.FIRST) / (3 * limits.RATE * 0.5)

    first, _ = run(jax.random.key(0), TrainState(own, best.init(own)), None, fresh=jnp.array([0.7, 0.8]))
    np.testing.assert_allclose(rises(first), [-1, 1, 1], rtol=1e-5)
    assert first.params > 0.5
    for given, expected in ((first.params, went_on), (jnp.float32(0.1), stayed)):
        second, _ = run(jax.random.key(1), first._replace(params=given), None, fresh=jnp.array([0.75, 0.85]))
        np.testing.assert_allclose(rises(second), expected, rtol=1e-5, atol=1e-5)


RAIL = limits.Constraint(lambda x: x[:1] - 1, 0.1)


def test_of_several_under_a_constraint_the_one_that_keeps_it_goes_on():
    """Its objective counts the constraint by a multiplier of its own, and is no measure of it."""

    def value(p, posterior, target, row, multiplier):
        return -p, jnp.asarray(p > 1, float)

    def imagine(key, p, posterior):
        x = jnp.full((4, 3, 1), p)
        return Rollout(x.at[0].set(0), x, x), -x[1:, :, 0]

    still = Sampler(lambda *_: jnp.zeros(()), lambda *_: jnp.zeros(()))
    problem = Problem(value, still, optax.sgd(0.0), search_table(3), ascend=partial(limits.ascend, bound=RAIL.bound))
    judge = partial(judged, imagine=imagine, task=cart()._replace(constraint=RAIL))
    for way, expected in ((None, 3.0), (judge, 0.9)):
        best = best_of(searcher(problem), num_starts=3, window=1, judge=way)
        begun = TrainState(jnp.float32(0.2), best.init(jnp.float32(0.2)))
        found, _ = best.run(jax.random.key(0), begun, None, first=0, steps=3, fresh=jnp.array([0.9, 3.0]))
        np.testing.assert_allclose(found.params, expected)


@pytest.mark.slow
@pytest.mark.parametrize("constraint", [None, RAIL])
def test_a_whole_experiment_keeps_its_shapes_and_executes_the_best(constraint):
    chosen = tiny(trials=2, fit__steps=5, search__steps=4, search__particles=5, search__num_starts=3)
    task = cart()._replace(constraint=constraint)
    exp = compose(chosen, task, dynamics=regression(2, 1), policy=noisy_linear_policy(cart()))
    state = exp.init(jax.random.key(0))
    after, (_, info) = unchecked(jax.jit(lambda s: exp.improve(exp.add_episode(s, exp.collect(s)))))(state)
    shapes = [jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), tree) for tree in (state.policy, after.policy)]
    assert shapes[0] == shapes[1]
    assert info.objective.shape == (4,)
    assert not same(after.policy.params, state.policy.params)
    everyone = after.policy.optimizer.params
    members = [jax.tree.map(itemgetter(i), everyone) for i in range(3)]
    assert any(same(after.policy.params, member) for member in members)


@pytest.mark.parametrize(
    ("search", "count"), [(config.Search(), 2), (config.Search(num_starts=4), 3), (config.Analytic(), 2)]
)
def test_a_search_is_given_as_many_fresh_policies_as_it_may_ask_for(search, count):
    assert fresh_policies(search) == count


def test_starts_begin_every_search_anew():
    with pytest.raises(
        ConfigError,
        match=r"search\.num_starts=4 begins every search with fresh policies; it needs search\.reset_optimizer=true",
    ):
        config.Search(num_starts=4, reset_optimizer=False)
