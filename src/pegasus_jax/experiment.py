"""Alg. 1: `collect` runs an episode on the plant, `add_episode` stores it, `improve` fits and searches."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.core import Tracer

from pegasus_jax import episode
from pegasus_jax import memory as recall
from pegasus_jax.episode import Episode
from pegasus_jax.imagine import limits
from pegasus_jax.learn import data as dataset
from pegasus_jax.learn.fit import FitInfo
from pegasus_jax.learn.gradient import SearchInfo
from pegasus_jax.learn.successor import after_episode, came_back
from pegasus_jax.models.calibration import calibration, filtered_errors, one_step_errors
from pegasus_jax.policies.driver import driver
from pegasus_jax.policies.rate_limited import before, explored, with_state
from pegasus_jax.shapes import check_trajectory
from pegasus_jax.task import Task
from pegasus_jax.types import (
    Array,
    Dataset,
    Dynamics,
    Key,
    ModelLearner,
    Params,
    Policy,
    PolicyOptimizer,
    Rollout,
    RunState,
    TrainState,
    Trajectory,
)

# What the key of a trial is folded with, so that no two draws share a key. `init` uses the first two of trial 0, in
# which no episode runs and no data are there to be fitted.
COLLECT, FIT, SEARCH, IMAGINE, EVALUATE, RESTART, CALIBRATE = range(7)


class Successor(NamedTuple):
    """What a policy is expected to do on fresh scenarios, and what the one before it would have."""

    rollout: Rollout  # of the policy that goes on
    cost: Array  # [H, K] of that rollout
    incumbent: Array  # [] expected cost a step of the policy before the search; NaN where it was not asked for
    replaced: Array  # [] whether the search's policy took its place
    chance: Array | None = None  # [] that an episode breaks the task's constraint, as expected; None: there is none


class Experiment(NamedTuple):
    """One configured method on one task: pure functions, closed over their pieces by `build`."""

    task: Task
    dynamics: Dynamics
    policy: Policy
    init: Callable[[Key], RunState]
    episode: Callable[[Key, Params, Array | bool], Trajectory]  # (key, policy parameters, random controls?)
    collect: Callable[[RunState], Trajectory]  # Alg. 1 line 3; with `episode`, the only one that touches the plant
    add_episode: Callable[[RunState, Trajectory], RunState]  # Alg. 1 line 4
    fit: Callable[..., tuple[RunState, FitInfo]]  # Alg. 1 line 5
    search: Callable[..., tuple[RunState, SearchInfo]]  # Alg. 1 line 6
    # (state, policy parameters before the search) -> (state with the policy that goes on, Successor)
    succeed: Callable[[RunState, Params], tuple[RunState, Successor]]
    improve: Callable[[RunState], tuple[RunState, tuple[FitInfo, SearchInfo]]]  # fit, search, succeed
    imagine: Callable[[RunState], tuple[Rollout, Array]]  # fresh scenarios -> (rollout, cost [H, K])
    calibrate: Callable[[RunState, Trajectory], Array]  # of the model, on an episode not yet added -> calibration
    # `episode` on the task's environment, which says how it ended and keeps the rows of one that failed; None: the
    # plant is in JAX
    drive: Callable[[Key, Params, bool], Episode] | None = None


class TrialInfo(NamedTuple):
    """What a trial of a whole-program study reports."""

    trajectory: Trajectory  # the episode that became data
    evaluation: Array  # [E, H] costs of episodes that did not
    fit: FitInfo
    search: SearchInfo


def trial_key(key: Key, trial: Array | int, purpose: int) -> Key:
    """The key of one purpose in one trial of the run with root key `key`."""
    return jax.random.fold_in(jax.random.fold_in(key, trial), purpose)


trial_keys = jax.vmap(trial_key, (0, None, None))  # of several runs at once


def experiment(
    *,
    task: Task,
    dynamics: Dynamics,
    policy: Policy,
    fit: ModelLearner,
    fit_steps: int,
    search: PolicyOptimizer,
    search_steps: int,
    imagine: Callable[[Key, Params, Params], tuple[Rollout, Array]],
    expect: Callable[[Key, Params, Params], Array] | None = None,
    remember: Callable[[Any, RunState], Any] | None = None,
    explore: Callable[[Key], Array],
    explore_trials: int,
    first_search: int,
    num_fresh: int = 2,
    refine_successes: bool = False,
    begun: bool = False,
    compare: bool,
    capacity: int,
) -> Experiment:
    """Compose the pieces into an `Experiment`. Every function of it is pure and can be jitted, vmapped, scanned.

    `imagine(key, policy parameters, posterior)` rolls out fresh scenarios -> (rollout, cost [H, K]), and `expect` says
    what a policy costs a step; None: the mean of that. `first_search` is the trial after which a policy is searched for
    the first time; 0: before the first episode. One that is `begun` has learned elsewhere before that. With `compare` a
    policy whose newest episode succeeded is followed only by one that is expected to cost less.
    All of them are given `remember(posterior, state)` in place of the posterior. With an environment instead of a
    plant in JAX, `episode` and `collect` are not pure, and `drive` is there. A search is given `num_fresh` untrained
    policies. With `refine_successes` the search after an episode that succeeded is called with works=True.
    """
    states, controls, memory = len(task.state_names), len(task.control_names), task.memory
    see, given, _ = recall.steps(memory)
    inputs, more = recall.given_size(memory, controls), 0 if task.hindsight is None else task.hindsight.more

    def init(key: Key) -> RunState:
        model_key, policy_key = jax.random.split(jax.random.fold_in(key, 0))
        model, controller = dynamics.init(model_key), policy.init(policy_key)
        return RunState(
            key,
            dataset.empty(capacity, states, inputs + more, len(memory.names)),
            TrainState(model, fit.init(model)),
            TrainState(controller, search.init(controller)),
            jnp.int32(0),
            jnp.int32(0),
            jnp.bool_(False),
            controller,
            jnp.int32(0),
        )

    def act(params: Params, key: Key, x: Array) -> Array:
        return policy.apply(params, policy.sample(key), x)

    def one_episode(key: Key, policy_params: Params, exploring: Array | bool) -> Trajectory:
        """An episode of the policy, or of random controls. One function, because a plant is slow to compile."""
        plan_key, run_key = jax.random.split(key)
        plan = explore(plan_key)

        def control(key: Key, t: Array, both: Array) -> Array:
            seen, x = jnp.split(both, [len(both) - states])
            first = explored(task, x, plan[t], before(seen, task), jnp)
            return jnp.where(exploring, first, act(policy_params, key, seen))

        return episode.run(run_key, control, with_state(task))

    def driven(key: Key, policy_params: Params, exploring: Array | bool) -> Trajectory:
        if isinstance(key, Tracer):
            raise ValueError(f"task {task.name} has an environment, which nothing can trace: call this outside of jit")
        found = drive(key, policy_params, bool(exploring))
        if found.error is not None:
            raise found.error
        return episode.padded(found.trajectory, task.horizon)

    def collect(state: RunState) -> Trajectory:
        """The next episode: random controls in the first trials, the policy's afterwards (Alg. 1 line 3)."""
        key = trial_key(state.key, state.trial + 1, COLLECT)
        return run_episode(key, state.policy.params, state.trial < explore_trials)

    drive = driver(task, policy, explore)
    run_episode = one_episode if task.environment is None else driven

    def add_episode(state: RunState, trajectory: Trajectory) -> RunState:
        """The run with one more episode in its data (Alg. 1 line 4).

        Raises ValueError for arrays of other shapes, and, outside of jit, for numbers that are not finite and where
        there is no room left.
        """
        trajectory = as_arrays(trajectory)
        check_episode(state, trajectory, controls)
        ran, m = as_modeled(trajectory)
        data = dataset.add(state.data, ran, task.angles, m)
        state = state._replace(data=data, trial=state.trial + 1, succeeded=episode.works(trajectory, task))
        return after_episode(state) if compare else state

    def as_modeled(trajectory: Trajectory) -> tuple[Trajectory, Array | None]:
        """An episode as the model learns it, with its states and controls [H, V], and what was remembered [H+1, M]."""
        m = recall.replay(memory, trajectory)
        u = trajectory.u if m is None else jax.vmap(given)(m[:-1], trajectory.u)
        if task.hindsight is None:
            return trajectory._replace(u=u), m
        length = jnp.int32(len(u)) if trajectory.length is None else trajectory.length
        x, more = task.hindsight.states(trajectory.x, length, u)
        return trajectory._replace(x=x, u=jnp.concatenate([u, more], 1)), m

    def learn(state: RunState, steps: int = fit_steps) -> tuple[RunState, FitInfo]:
        """Fit the model to the data (Alg. 1 line 5)."""
        learner, info = fit.run(trial_key(state.key, state.trial, FIT), state.model, state.data, steps)
        return state._replace(model=learner), info

    def posterior_of(state: RunState) -> Any:
        posterior = dynamics.posterior(state.model.params, state.data)
        return posterior if remember is None else remember(posterior, state)

    def adapted(params: Params, data: Dataset) -> Params:
        if policy.adapt is None:
            return params
        return policy.adapt(params, data._replace(x=jax.vmap(see)(data.memory, data.x)))

    def improve_policy(
        state: RunState, first: Array | int = 0, steps: int = search_steps
    ) -> tuple[RunState, SearchInfo]:
        """Improve the policy in imagination (Alg. 1 line 6), from iteration `first` of the trial's search."""
        key = trial_key(state.key, state.trial, SEARCH)
        posterior = posterior_of(state)

        # A policy driven into saturation sits where the saturating cost is flat: no gradient brings it back, and an
        # untrained policy is the better start.
        keys = jax.random.split(trial_key(state.key, state.trial, RESTART), num_fresh)
        fresh = jax.vmap(lambda key: adapted(policy.init(key), state.data))(keys)
        untrained = (state.trial <= first_search) & (first == 0)
        worked = state.succeeded & (state.policy_trial > 0)  # a policy, and not random controls
        given = state.policy.params  # one that has learned keeps the inputs that it has learned with
        if not begun:
            given = optax.tree.where(untrained, adapted(given, state.data), given)
        learner, info = search.run(
            key,
            state.policy._replace(params=given),
            posterior,
            first=first,
            earlier=jnp.maximum(state.trial - first_search, 0),
            steps=steps,
            fresh=fresh,
            **({"works": worked + jnp.int32(compare & came_back(state))} if refine_successes else {}),
        )
        if not isinstance(learner, TrainState):  # which unpacks into two, too
            raise ValueError(
                f"searcher.run returns a {type(learner).__name__} first; expected (TrainState, SearchInfo)"
            )
        return state._replace(policy=learner), info

    def chance_of(rolled: Rollout) -> Any:
        return None if task.constraint is None else limits.probability(rolled.x, task.constraint)

    def succeed(state: RunState, incumbent: Params) -> tuple[RunState, Successor]:
        """The policy that goes on after a search: the new one, or an incumbent that works and should cost no more.

        Both are imagined under the same fresh scenarios and the new model. An incumbent that failed is replaced: its
        next episode would teach nothing new. If one of them alone should keep the task's constraint, that one goes on.
        """
        posterior = posterior_of(state)
        key = trial_key(state.key, state.trial, IMAGINE)
        rolled, cost = imagine(key, state.policy.params, posterior)
        chance = chance_of(rolled)
        if not compare:
            return state._replace(policy_trial=state.trial), Successor(
                rolled, cost, jnp.full((), jnp.nan), jnp.bool_(True), chance
            )
        old_rolled, old_cost = imagine(key, incumbent, posterior)
        old, new, old_chance = jnp.mean(old_cost), jnp.mean(cost), chance_of(old_rolled)
        if expect is not None:
            old, new = (expect(key, params, posterior) for params in (incumbent, state.policy.params))
        unlearned = jnp.bool_(False) if begun else state.policy_trial == 0 if first_search else state.trial == 0
        better = ~state.succeeded | (new < old) | jnp.isnan(old)
        if task.constraint is not None:
            better = limits.prefers(better, chance, old_chance, bound=task.constraint.bound)
        replaced = unlearned | better
        rolled, cost, params, chance = optax.tree.where(
            replaced, (rolled, cost, state.policy.params, chance), (old_rolled, old_cost, incumbent, old_chance)
        )
        state = state._replace(
            policy=state.policy._replace(params=params),
            policy_trial=jnp.where(replaced, state.trial, state.policy_trial),
        )
        return state, Successor(rolled, cost, old, replaced, chance)

    def improve(state: RunState) -> tuple[RunState, tuple[FitInfo, SearchInfo]]:
        """Fit and search (Alg. 1 lines 5 and 6); neither where the next episode is random too, and an info of NaN."""
        if explore_trials < 2:
            return learn_and_improve(state)
        info = jax.tree.map(_unknown, jax.eval_shape(learn_and_improve, state)[1])
        return jax.lax.cond(state.trial < explore_trials, lambda old: (old, info), learn_and_improve, state)

    def learn_and_improve(state: RunState) -> tuple[RunState, tuple[FitInfo, SearchInfo]]:
        state, fitted = learn(state)
        incumbent = state.policy.params
        state, searched = improve_policy(state)
        state = succeed(state, incumbent)[0] if compare else state._replace(policy_trial=state.trial)
        return state, (fitted, searched)

    def simulate(state: RunState) -> tuple[Rollout, Array]:
        """Rollouts of the policy under scenarios the search has not seen, and their costs [H, K]."""
        posterior = posterior_of(state)
        return imagine(trial_key(state.key, state.trial, IMAGINE), state.policy.params, posterior)

    def calibrate(state: RunState, trajectory: Trajectory) -> Array:
        """`calibration` of the model as it is, on the next episode before it is added; NaN before the first fit.

        With a key of its own, so that asking changes nothing. Raises ValueError for arrays of other shapes.
        """
        trajectory = as_arrays(trajectory)
        check_trajectory(trajectory, states, controls)
        posterior = posterior_of(state)
        key = trial_key(state.key, state.trial + 1, CALIBRATE)
        ran, _ = as_modeled(trajectory)
        ran = ran._replace(u=ran.u[:, :inputs])
        by_positions = task.hindsight is not None
        errors = partial(filtered_errors, rates=task.rates, dt=task.dt) if by_positions else one_step_errors
        found = calibration(key, posterior, ran, dynamics=dynamics, angles=task.angles, errors=errors)
        return jnp.where(state.trial >= first_search, found, jnp.nan)

    return Experiment(
        task,
        dynamics,
        policy,
        init,
        run_episode,
        collect,
        add_episode,
        learn,
        improve_policy,
        succeed,
        improve,
        simulate,
        calibrate,
        None if task.environment is None else drive,
    )


def as_arrays(trajectory: Trajectory) -> Trajectory:
    """The episode, whose numbers may be NumPy's, in arrays of JAX."""
    return trajectory._replace(**{name: jnp.asarray(getattr(trajectory, name)) for name in ("x", "u", "cost")})


def check_episode(state: RunState, trajectory: Trajectory, controls: int) -> None:
    """Raise ValueError for an episode that is not one of the task's, as far as can be told."""
    horizon = len(trajectory.u)
    check_trajectory(trajectory, state.data.x.shape[1], controls)
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((state.data.size, trajectory))):
        return
    told: Any = horizon if trajectory.length is None else trajectory.length
    if (length := int(told)) != told or not 0 <= length <= horizon:
        raise ValueError(f"an episode's length is {told}; expected a whole number from 0 to {horizon}")
    for name, rows in (("x", trajectory.x[: length + 1]), ("u", trajectory.u[:length])):
        for t, i in np.argwhere(~np.isfinite(np.asarray(rows)))[:1]:
            raise ValueError(f"an episode's {name}[{t}, {i}] is {rows[t, i]}; expected finite numbers")
    room = len(state.data.x) - int(state.data.size)
    if length > room:
        raise ValueError(
            f"an episode of {length} rows does not fit: {room} are left; Config(trials=...) makes more room"
        )


def _unknown(like: jax.ShapeDtypeStruct) -> Array:
    """What an info says of what was not done: NaN, or a count of 0."""
    return jnp.full(like.shape, jnp.nan if jnp.issubdtype(like.dtype, jnp.floating) else 0, like.dtype)


def _an_experiment(caller: str, exp: Any) -> None:
    """Raises ValueError for what is none."""
    if not isinstance(exp, Experiment):
        raise ValueError(f"{caller} takes an Experiment, not a {type(exp).__name__}; build(config) makes one")


def trial(state: RunState, exp: Experiment, episodes: int = 20) -> tuple[RunState, TrialInfo]:
    """One round of Alg. 1: collect, add_episode, improve; then `episodes` more, whose costs [E, H] are not data."""
    _an_experiment("trial", exp)
    trajectory = exp.collect(state)
    state = exp.add_episode(state, trajectory)
    state, (fitted, searched) = exp.improve(state)
    keys = jax.random.split(trial_key(state.key, state.trial, EVALUATE), episodes)
    evaluation = jax.vmap(exp.episode, (0, None, None))(keys, state.policy.params, False)
    return state, TrialInfo(trajectory, evaluation.cost, fitted, searched)


def run(exp: Experiment, trials: int, episodes: int = 20) -> Callable[[Key], tuple[RunState, TrialInfo]]:
    """key -> (state, TrialInfo [T, ...]): a whole run as one function; jit(vmap(run(...)))(keys) is a study."""
    _an_experiment("run", exp)
    if exp.drive is not None:
        raise ValueError(f"task {exp.task.name} has an environment, which no program can hold; use pegasus-train")
    room = jax.eval_shape(exp.init, jax.random.key(0)).data.x.shape[0] // exp.task.horizon
    if trials > room:
        raise ValueError(
            f"trials={trials}: the experiment was built with room for {room} episodes; Config(trials={trials})"
        )

    def whole(key: Key) -> tuple[RunState, TrialInfo]:
        return jax.lax.scan(lambda state, _: trial(state, exp, episodes), exp.init(key), None, trials)

    return whole
