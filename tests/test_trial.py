"""The loop of Alg. 1: three seams that compose, one scan that equals them, and keys that no two purposes share."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pegasus_jax.assembly.experiments import compose
from pegasus_jax.config import Period
from pegasus_jax.experiment import COLLECT, EVALUATE, FIT, IMAGINE, RESTART, SEARCH, TrialInfo, run, trial_key
from pegasus_jax.learn.successor import after_episode
from pegasus_jax.types import Policy, Prediction, RunState, TrainState
from probes import Counter, Linear, cart, dial, known, noisy_linear_policy, regression, same, tiny, unchecked

TRIALS, EPISODES = 3, 4
QUICK = dict(trials=TRIALS, fit__steps=12, search__steps=6, search__particles=5)


class Watched:
    """A quick experiment whose model and policy count their traces, with its seams jitted."""

    def __init__(self):
        config, task = tiny(**QUICK), cart()
        dynamics, policy = regression(2, 1), noisy_linear_policy(task)
        self.loss, self.predict, self.act = Counter(dynamics.loss), Counter(dynamics.apply), Counter(policy.apply)
        self.exp = compose(
            config,
            task,
            dynamics=dynamics._replace(loss=self.loss, apply=self.predict),
            policy=policy._replace(apply=self.act),
        )
        self.init, self.collect = jax.jit(self.exp.init), jax.jit(self.exp.collect)
        self.add_episode, self.fit = jax.jit(self.exp.add_episode), jax.jit(self.exp.fit)
        self.search, self.succeed = jax.jit(self.exp.search), jax.jit(self.exp.succeed)
        self.episodes = unchecked(jax.jit(jax.vmap(self.exp.episode, (0, None, None))))

    def traces(self):
        return self.loss.count, self.predict.count, self.act.count


@pytest.fixture(scope="module")
def watched():
    return Watched()


def loop(watched, seed):
    """Three trials as a Python loop over the seams: (states, infos, traces after each trial)."""
    state = watched.init(jax.random.key(seed))
    states, infos, traces = [state], [], []
    for _ in range(TRIALS):
        trajectory = watched.collect(state)
        state = watched.add_episode(state, trajectory)
        state, fitted = watched.fit(state)
        incumbent = state.policy.params
        state, searched = watched.search(state)
        state, _ = watched.succeed(state, incumbent)
        keys = jax.random.split(trial_key(state.key, state.trial, EVALUATE), EPISODES)
        evaluation = watched.episodes(keys, state.policy.params, False)
        states.append(state)
        infos.append(TrialInfo(trajectory, evaluation.cost, fitted, searched))
        traces.append(watched.traces())
    return states, infos, traces


@pytest.fixture(scope="module")
def looped(watched):
    return loop(watched, 5)


def close(a, b, tolerance=2e-3):
    for p, q in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        if not jnp.issubdtype(p.dtype, jax.dtypes.prng_key):
            np.testing.assert_allclose(p, q, rtol=tolerance, atol=tolerance)


def test_nothing_is_traced_again_from_trial_to_trial(looped):
    _, _, traces = looped
    assert all(count > 0 for count in traces[0])
    assert traces[1] == traces[2] == traces[0]


@pytest.mark.slow
def test_a_study_of_many_seeds_as_one_program_is_the_loops_one_by_one(watched, looped):
    """`improve` is search after fit, `trial` is collect, add_episode, improve, and `run` a scan of so many trials."""
    study = unchecked(jax.jit(jax.vmap(run(watched.exp, TRIALS, EPISODES))))
    final, info = study(jnp.stack([jax.random.key(5), jax.random.key(6)]))
    for i, (states, infos, _) in enumerate((looped, loop(watched, 6))):
        close(jax.tree.map(lambda leaf, i=i: leaf[i], final), states[-1])
        close(jax.tree.map(lambda leaf, i=i: leaf[i], info), jax.tree.map(lambda *rows: jnp.stack(rows), *infos))
    assert same(final.key, jnp.stack([jax.random.key(5), jax.random.key(6)]))  # the root key never changes
    assert info.evaluation.shape == (2, TRIALS, EPISODES, 8)
    assert not np.allclose(info.evaluation[0], info.evaluation[1])


def test_every_episode_becomes_data_once_and_evaluations_never(looped):
    states, infos, _ = looped
    for t, state in enumerate(states):
        assert int(state.trial) == t
        assert int(state.data.size) == 8 * t
    flown = np.concatenate([info.trajectory.x[:-1] for info in infos])
    data, rows = states[-1].data, len(flown)
    assert np.array_equal(data.x[:rows], flown)
    assert np.array_equal(data.u[:rows], np.concatenate([info.trajectory.u for info in infos]))
    assert not np.any(data.x[rows:])
    np.testing.assert_allclose(states[-1].data.y[:8], np.diff(infos[0].trajectory.x, axis=0), atol=1e-6)


def test_the_seams_keep_to_their_part_of_the_state(watched, looped):
    """collect changes nothing, add_episode the data, fit the model, search the policy."""
    before = looped[0][1]
    added = watched.add_episode(before, watched.collect(before))
    fitted, _ = watched.fit(added)
    searched, _ = watched.search(fitted)
    parts = ("key", "data", "model", "policy", "trial")
    changes = [
        {part for part in parts if not same(getattr(a, part), getattr(b, part))}
        for a, b in ((before, added), (added, fitted), (fitted, searched))
    ]
    assert changes == [{"data", "trial"}, {"model"}, {"policy"}]


def test_a_trial_is_a_function_of_state_alone(watched, looped):
    """Resume is exact: the state after trial 2, and nothing else, decides trial 3."""
    states, infos, _ = looped
    trajectory = watched.collect(states[2])
    assert same(trajectory, infos[2].trajectory)
    state, fitted = watched.fit(watched.add_episode(states[2], trajectory))
    incumbent = state.policy.params
    state, searched = watched.search(state)
    state, _ = watched.succeed(state, incumbent)
    assert same(state, states[3])
    assert same((fitted, searched), infos[2][2:])


def test_a_search_in_pieces_is_the_search(watched, looped):
    """Also where it forgets Adam's moments, which only its first piece may do."""
    fitted, _ = watched.fit(watched.add_episode(looped[0][1], watched.collect(looped[0][1])))
    whole, info = watched.search(fitted)
    part = jax.jit(partial(watched.exp.search, steps=3))
    middle, first = part(fitted, 0)
    end, second = part(middle, 3)
    assert same(whole, end)
    assert np.array_equal(info.objective, np.concatenate([first.objective, second.objective]))


def test_the_first_episodes_are_random_controls_within_limits(watched, looped):
    """Exploring, the policy has no say; afterwards it has all of it."""
    states, infos, _ = looped
    task = watched.exp.task
    for t in (0, 1):
        other = states[t]._replace(policy=states[t].policy._replace(params=states[3].policy.params))
        u, u_other = watched.collect(states[t]).u, watched.collect(other).u
        assert np.array_equal(u, u_other) == (t == 0)
    u = np.asarray(infos[0].trajectory.u)
    assert np.all((u >= task.control_low) & (u <= task.control_high))
    assert len(np.unique(u)) == len(u)


def test_evaluation_never_explores(watched, looped):
    """Its controls are the policy's at every observed state: here without noise, so they can be computed."""
    still = noisy_linear_policy(cart())._replace(sample=lambda key: jnp.zeros(1))
    exp = compose(tiny(**QUICK), cart(), dynamics=regression(2, 1), policy=still)
    params = looped[0][3].policy.params
    fly = jax.jit(exp.episode)
    flight = fly(jax.random.key(1), params, False)
    mean = jax.vmap(exp.policy.apply, (None, None, 0))(params, None, flight.x[:-1])
    np.testing.assert_allclose(flight.u, mean, atol=1e-5)
    sampled = watched.episodes(jnp.stack([jax.random.key(1)]), params, False)
    means = jax.vmap(exp.policy.apply, (None, None, 0))(params, None, sampled.x[0, :-1])
    assert not np.allclose(sampled.u[0], means, atol=1e-3)  # a mask of its own at each step


def test_forgetting_adams_moments_or_not(watched, looped):
    """fit warm-starts its optimizer, search does not, and can be told otherwise."""
    state = watched.add_episode(looped[0][2], watched.collect(looped[0][2]))
    fresh = watched.init(jax.random.key(0))
    forgot = state._replace(
        model=state.model._replace(optimizer=fresh.model.optimizer),
        policy=state.policy._replace(optimizer=fresh.policy.optimizer),
    )
    assert same(watched.search(state)[0], watched.search(forgot)[0]._replace(model=state.model))
    assert not same(watched.fit(state)[0].model.params, watched.fit(forgot)[0].model.params)
    pieces = dict(dynamics=watched.exp.dynamics, policy=watched.exp.policy)
    other = compose(tiny(**QUICK, search__reset_optimizer=False), watched.exp.task, **pieces)
    search = jax.jit(other.search)
    assert not same(search(state)[0].policy.params, search(forgot)[0].policy.params)


def test_a_bad_model_leaves_the_policy_as_it_is_and_is_counted(watched, looped):
    """A model of NaN: every imagined gradient is bad, the run goes on."""
    state = looped[0][1]
    poisoned = state._replace(
        model=state.model._replace(params=jax.tree.map(lambda p: p * jnp.nan, state.model.params))
    )
    after, info = watched.search(poisoned)
    assert same(after.policy.params, state.policy.params)
    assert info.skipped == 6


def test_imagination_is_fresh_and_of_the_state(watched, looped):
    imagine = jax.jit(watched.exp.imagine)
    imagined, costs = imagine(looped[0][3])
    assert imagined.x.shape == (9, 5, 2)
    np.testing.assert_allclose(costs[2, 3], watched.exp.task.cost.of_state(imagined.x[3, 3]), rtol=1e-5)
    again, _ = imagine(looped[0][3])
    other, _ = imagine(looped[0][2])
    assert same(imagined, again)
    assert not np.any(np.isclose(imagined.x[0], other.x[0]))  # other start particles in another trial


def test_no_two_purposes_trials_or_iterations_share_a_key():
    """Every key that reaches a piece in two whole trials is seen once.

    All periods are 1, so that each draw is used; `fold_in(key, i)` and `split(key)[i]` are the same key in JAX, which
    is how purposes that look apart could meet.
    """
    seen = []

    def note(key):
        jax.debug.callback(lambda data: seen.append(data.tobytes()), jax.random.key_data(key))

    def noted(function, position=0):
        def wrapped(*arguments):
            note(arguments[position])
            return function(*arguments)

        return wrapped

    task = cart(horizon=3)
    config = tiny(
        **{**QUICK, "fit__steps": 4, "search__steps": 3}, search__init="previous", search__period=Period(1, 1, 1, 1, 1)
    )
    dynamics, policy = regression(2, 1), noisy_linear_policy(task)
    exp = compose(
        config,
        task._replace(plant=task.plant._replace(reset=noted(task.plant.reset))),
        dynamics=dynamics._replace(
            init=noted(dynamics.init), loss=noted(dynamics.loss, 1), sample=noted(dynamics.sample)
        ),
        policy=policy._replace(init=noted(policy.init), sample=noted(policy.sample)),
    )
    unchecked(jax.jit(run(exp, 2, 3)))(jax.random.key(0))
    jax.effects_barrier()
    searched = 2 * 3 * 2 * 5  # trials, iterations, model and policy, particles
    episodes = 2 * (1 + 3) * (1 + 3)  # trials, collected and evaluated, a reset and the policy's draws
    fresh = 2 * 2  # two policies that a search may begin with, in each trial
    assert len(seen) == 2 + 2 * 4 + fresh + searched + episodes
    assert len(set(seen)) == len(seen)


def test_purposes_have_names_and_numbers_apart():
    purposes = [COLLECT, FIT, SEARCH, IMAGINE, EVALUATE, RESTART]
    root = jax.random.key(0)
    keys = {jax.random.key_data(trial_key(root, t, p)).tobytes() for t in range(1, 40) for p in purposes}
    assert len(keys) == 39 * 6
    assert jax.random.key_data(root).tobytes() not in keys


def test_the_whole_loop_learns_a_probe():
    """The network, the dropout policy, everything: from random controls to a good policy in four episodes of six
    steps. The way leads over the seam at 180 degrees, so differences that do not wrap teach nothing here."""
    exp = compose(tiny(), dial())
    _, info = unchecked(jax.jit(run(exp, 4, 20)))(jax.random.key(1))
    last = info.evaluation[-1]
    assert np.mean(last) < 0.7 * np.mean(info.trajectory.cost[0])  # random controls
    assert np.mean(last[:, -2:]) < 0.35
    assert np.all(np.isfinite(info.fit.loss))
    assert np.all(info.fit.skipped + info.search.skipped == 0)
    np.testing.assert_allclose(info.search.objective[-1, -1], np.mean(last), atol=0.15)  # imagination is about right


def test_a_run_longer_than_its_data_set_is_refused():
    """One more episode than there is room for would overwrite the last one's rows, silently."""
    exp = compose(tiny(**QUICK), cart(), dynamics=regression(2, 1), policy=noisy_linear_policy(cart()))
    room = jax.eval_shape(exp.init, jax.random.key(0)).data.x.shape[0] // exp.task.horizon
    with pytest.raises(ValueError, match="trials"):
        unchecked(jax.eval_shape)(run(exp, room + 1, 1), jax.random.key(0))


@pytest.mark.parametrize(("offset", "kept"), [(0.0, True), (-100.0, False)])
def test_a_search_starts_from_the_better_of_the_old_policy_and_a_fresh_one(offset, kept):
    """A policy pushed into saturation is left behind, one that does its task goes on.

    The cost is the distance of the state from 1, the old policy drives it there or, off by `offset`, far away. The
    step size is so small that nothing moves.
    """
    task = cart(horizon=4)
    task = task._replace(cost=task.cost._replace(of_state=lambda x: 1 - jnp.exp(-jnp.sum((x - 1) ** 2))))
    towards = Policy(
        init=lambda key: {"aim": jnp.full(2, -3.0)},
        sample=lambda key: (),
        apply=lambda params, noise, x: params["aim"][:1] - x[:1],
    )
    jump = regression(2, 1)._replace(
        sample=lambda key, posterior: (),
        apply=lambda posterior, draw, x, u: Prediction(jnp.broadcast_to(u, (2,)), jnp.zeros(2)),
    )
    config = tiny(search__steps=1, search__learning_rate=1e-12, search__matching="never")
    exp = compose(config, task, dynamics=jump, policy=towards)
    state = jax.jit(exp.init)(jax.random.key(0))
    old = {"aim": jnp.full(2, 1.0 + offset)}
    state = state._replace(policy=state.policy._replace(params=old), trial=jnp.int32(1))
    after, _ = jax.jit(exp.search)(state)
    np.testing.assert_allclose(after.policy.params["aim"], old["aim"] if kept else -3.0, atol=1e-6)
    resumed, _ = jax.jit(exp.search)(state, jnp.int32(1))  # not the first iteration: no second thoughts
    np.testing.assert_allclose(resumed.policy.params["aim"], old["aim"], atol=1e-6)


@pytest.mark.slow
def test_random_episodes_come_before_any_learning():
    """With two random trials the first leaves model and policy as they were, and says so."""
    exp = compose(
        tiny(**QUICK, explore__trials=2), cart(), dynamics=regression(2, 1), policy=noisy_linear_policy(cart())
    )
    first = exp.init(jax.random.key(5))
    last, info = unchecked(jax.jit(run(exp, 3, EPISODES)))(jax.random.key(5))
    unknown = [True, False, False]
    assert np.isnan(info.fit.loss).tolist() == np.isnan(info.search.objective).all(1).tolist() == unknown
    assert info.search.skipped.tolist() == [0, 0, 0]
    again = jax.jit(lambda s: exp.improve(exp.add_episode(s, exp.collect(s)))[0])
    kept = again(first)
    assert same((kept.model, kept.policy), (first.model, first.policy))
    learned = again(kept)
    assert not same(learned.policy, first.policy)
    close(again(learned), last)


@pytest.mark.parametrize("better", [True, False])
@pytest.mark.parametrize("compare", ["better", "always"])
def test_a_successor_takes_over_where_it_is_expected_to_cost_less(better, compare):
    """Fresh scenarios under the new model: a policy of gain 0 does nothing for a cart that a gain of -1 stops."""
    task = cart()
    true = Linear(np.array([[1, 0.3], [0, 1]]), np.array([[0.045], [0.3]]), np.eye(2), np.zeros(2), np.zeros(2), 8)
    exp = compose(tiny(**QUICK, successor=compare), task, dynamics=known(true), policy=noisy_linear_policy(task))
    state = exp.init(jax.random.key(0))
    idle, good = jnp.zeros((1, 2)), jnp.array([[-0.8, -1.2]])
    new, old = (good, idle) if better else (idle, good)
    state = state._replace(policy=state.policy._replace(params=new), trial=jnp.int32(4), policy_trial=jnp.int32(3))
    state = state._replace(succeeded=jnp.bool_(True))
    after, found = jax.jit(exp.succeed)(state, old)
    replaced = better or compare == "always"
    assert bool(found.replaced) == replaced
    assert same(after.policy.params, new if replaced else old)
    assert int(after.policy_trial) == (4 if replaced else 3)
    assert np.isnan(found.incumbent) == (compare == "always")
    if compare == "better":
        assert (float(jnp.mean(found.cost)) < float(found.incumbent)) == better
        # One whose cost is not a number is no successor.
        lost = state._replace(policy=state.policy._replace(params=new * jnp.nan))
        after, found = jax.jit(exp.succeed)(lost, old)
        assert not bool(found.replaced)
        assert same(after.policy.params, old)
        # What has never learned anything is no incumbent.
        first, found = jax.jit(exp.succeed)(state._replace(policy_trial=jnp.int32(0)), old)
        assert (int(first.policy_trial), bool(found.replaced)) == (4, True)
        # Nor is one that failed on the plant, whatever is expected of it.
        failed, found = jax.jit(exp.succeed)(state._replace(succeeded=jnp.bool_(False)), old)
        assert same(failed.policy.params, new)
        assert (int(failed.policy_trial), bool(found.replaced)) == (4, True)


@pytest.mark.parametrize(("length", "succeeds"), [(None, True), (8, True), (7, False), (4, False)])
def test_a_state_says_whether_its_newest_episode_succeeded(watched, looped, length, succeeds):
    """Of the last five periods those that an early end left out cost `stop_cost`, 1: one of five is .2, a failure."""
    state, trajectory = looped[0][0], looped[1][0].trajectory
    length = None if length is None else jnp.int32(length)
    added = watched.exp.add_episode(state, trajectory._replace(cost=jnp.zeros(8), length=length))
    assert bool(added.succeeded) == succeeds
    assert not bool(watched.exp.add_episode(added, trajectory._replace(cost=jnp.ones(8))).succeeded)


# (trial after which the policy that runs was learned, whether its episode succeeds) one after the other, and then
# (trial of the policy that goes on, whether it counts as one that works, trial of the one to go back to).
RAN = {
    "none worked": ([(1, False), (2, False)], (2, False, 0)),
    "random controls are nobody's success": ([(0, True), (1, False)], (1, False, 0)),
    "one works": ([(1, True)], (1, True, 1)),
    "it goes on and works again": ([(1, True), (1, True)], (1, True, 1)),
    "it goes on and fails": ([(1, True), (1, False)], (1, False, 0)),
    "the next works too": ([(1, True), (2, True)], (2, True, 2)),
    "the next fails": ([(1, True), (2, False)], (1, True, 0)),
    "the one after that fails too": ([(1, True), (2, False), (3, False)], (3, False, 0)),
    "the next fails and the one gone back to works": ([(1, True), (2, False), (1, True)], (1, True, 1)),
    "and may be gone back to again": ([(1, True), (2, False), (1, True), (4, False)], (1, True, 0)),
}


@pytest.mark.parametrize("name", RAN)
def test_a_policy_that_worked_comes_back_where_the_next_one_fails(name):
    """Once: docs/decisions.md 0021. Under vmap as alone, because the runs of many seeds are one program."""
    ran, (goes_on, works, remembered) = RAN[name]
    learner = TrainState(jnp.zeros(2), None)
    state = RunState(None, None, None, learner, *map(jnp.int32, (0, 0)), jnp.bool_(False), learner.params, jnp.int32(0))
    state = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), state)
    for trial, succeeds in ran:
        new = jnp.full((2, 2), 1.0 * trial)
        state = state._replace(policy=TrainState(new, None), policy_trial=jnp.full(2, trial, jnp.int32))
        state = jax.jit(jax.vmap(after_episode))(state._replace(succeeded=jnp.full(2, succeeds)))
    assert state.policy_trial.tolist() == [goes_on] * 2
    assert np.all(np.asarray(state.policy.params) == goes_on)
    assert state.succeeded.tolist() == [works] * 2
    assert state.working_trial.tolist() == [remembered] * 2
    assert not remembered or np.all(np.asarray(state.working) == remembered)


@pytest.mark.parametrize("compare", ["better", "always"])
def test_a_run_goes_back_only_where_it_compares(compare):
    """An episode of 8 periods that fail, after another policy has worked."""
    task = cart()
    exp = compose(tiny(**QUICK, successor=compare), task, policy=noisy_linear_policy(task))
    good, bad = jnp.full((1, 2), -0.5), jnp.full((1, 2), 0.5)
    state = exp.init(jax.random.key(0))
    state = state._replace(policy=state.policy._replace(params=bad), trial=jnp.int32(3), policy_trial=jnp.int32(2))
    state = state._replace(working=good, working_trial=jnp.int32(1))
    fails = exp.collect(state)._replace(cost=jnp.ones(8))
    after = exp.add_episode(state, fails)
    assert same(after.policy.params, good if compare == "better" else bad)
    assert (int(after.policy_trial), bool(after.succeeded)) == ((1, True) if compare == "better" else (2, False))


def test_an_episode_that_is_none_of_the_tasks_is_refused(watched, looped):
    state, trajectory = looped[0][0], looped[1][0].trajectory
    add_episode = watched.exp.add_episode
    with pytest.raises(ValueError, match=r"x has shape \(9, 3\); expected \(9, 2\)"):
        add_episode(state, trajectory._replace(x=jnp.zeros((9, 3))))
    with pytest.raises(ValueError, match=r"cost has shape \(7,\); expected \(8,\)"):
        jax.jit(add_episode)(state, trajectory._replace(cost=jnp.zeros(7)))
    with pytest.raises(ValueError, match=r"u\[3, 0\] is nan"):
        add_episode(state, trajectory._replace(u=trajectory.u.at[3, 0].set(jnp.nan)))
    add_episode(state, trajectory._replace(u=trajectory.u.at[3, 0].set(jnp.nan), length=jnp.int32(3)))
    full = state._replace(data=state.data._replace(size=jnp.int32(len(state.data.x))))
    with pytest.raises(ValueError, match="an episode of 8 rows does not fit: 0 are left"):
        add_episode(full, trajectory)
    kept = watched.add_episode(full, trajectory)  # inside jit nobody can be told, and nothing is lost
    assert same(kept.data, full.data)


def test_an_episode_that_ends_early_teaches_its_own_rows(watched, looped):
    """The rows behind its end say nothing: neither the data nor the model's calibration depends on them."""
    state, trajectory = looped[0][1], looped[1][1].trajectory
    short, other = (
        trajectory._replace(x=trajectory.x.at[6:].set(rows), u=trajectory.u.at[5:].set(rows), length=jnp.int32(5))
        for rows in (0.0, 7.0)
    )
    once, again = (watched.add_episode(state, episode).data for episode in (short, other))
    assert same(once, again)
    assert int(once.size) == 8 + 5
    assert np.array_equal(once.x[8:13], trajectory.x[:5])
    assert not np.any(once.x[13:])
    calibrate = jax.jit(watched.exp.calibrate)
    assert float(calibrate(looped[0][1], short)) == float(calibrate(looped[0][1], other))
    assert float(calibrate(looped[0][1], short)) != float(calibrate(looped[0][1], trajectory))
