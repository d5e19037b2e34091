"""The public names: each can be called with the others alone, and what a signature names is public too."""

import inspect
import itertools
import re
import subprocess
import sys
import tempfile
import typing
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import pegasus_jax as pg
from folders import a_run
from pegasus_jax.config import Explore, Sensors
from pegasus_jax.imagine.limits import Constraint
from pegasus_jax.task import Signal
from probes import unchecked

_counter = itertools.count()


def key() -> jax.Array:
    """A key that nobody had before."""
    return jax.random.key(next(_counter))


K, H, D, U = 5, 4, 2, 1
X, CONTROL = jnp.array([0.3, -0.2]), jnp.array([0.1])
CONFIG = pg.Config(
    trials=2,
    model=pg.config.BNN(hidden=(4,)),
    policy=pg.config.MLP(hidden=(4,)),
    fit=pg.config.Fit(steps=3, batch_size=4),
    search=pg.config.Search(steps=2, particles=K, init="previous", refine_fraction=0),
)


# A task and its pieces, of exported names alone


class Plant(NamedTuple):
    """What a task asks of a plant: a cart, of position and velocity, that a force drives."""

    reset: Callable[[jax.Array], jax.Array] = lambda key: jax.random.normal(key, (D,))
    step: Callable[[jax.Array, jax.Array], jax.Array] = lambda x, u: x + 0.3 * jnp.stack([x[1], u[0]])
    observe: Callable[[jax.Array], jax.Array] = lambda x: x


def error(x: jax.Array) -> jax.Array:
    return x


TASK = pg.Task(
    name="cart",
    plant=Plant(),
    cost=pg.costs.saturating(error, 1.0, ()),
    angles=(),
    start_mean=np.zeros(D),
    start_std=np.ones(D),
    sensor_std=np.full(D, 0.01),
    control_low=np.array([-2.0]),
    control_high=np.array([2.0]),
    horizon=H,
    dt=0.3,
    state_names=("position", "velocity"),
    control_names=("force",),
    rates=(1,),
)
DYNAMICS, POLICY = pg.dynamics_of(CONFIG.model, TASK), pg.policy_of(CONFIG.policy, TASK)


def trajectory() -> pg.Trajectory:
    x = jnp.linspace(0.0, 1.0, (H + 1) * D).reshape(H + 1, D)
    return pg.Trajectory(x, jnp.linspace(-1.0, 1.0, H)[:, None], jnp.zeros(H))


def experience() -> pg.Dataset:
    return pg.data.add(pg.data.empty(2 * H, D, U), trajectory(), ())


def blocks() -> pg.Blocks:
    start = lambda key: jax.random.normal(key, (D,))  # noqa: E731
    return pg.blocks(dynamics=DYNAMICS, policy=POLICY, start=start, particles=K, horizon=H, standardized_noise=False)


class Imagined(NamedTuple):
    """What a rollout and an objective take."""

    params: Any
    posterior: Any
    scenarios: pg.Scenarios


def imagined() -> Imagined:
    posterior = DYNAMICS.posterior(DYNAMICS.init(key()), experience())
    return Imagined(POLICY.init(key()), posterior, pg.draw(key(), 0, posterior, blocks=blocks(), period=pg.Period()))


@cache
def drawn() -> Imagined:
    """The same for tests that ask nothing of its numbers: as one program, and once."""
    return jax.jit(imagined)()


PIECES: dict[str, Any] = dict(dynamics=DYNAMICS, policy=POLICY, match=pg.matching.match)
J = partial(pg.objective, **PIECES, cost=pg.costs.of_particles(TASK.cost))


# An example of every exported function; what it returns must be finite

EXAMPLES: dict[str, Callable[[], Any]] = {}
IMPURE = {
    "build",
    "compose",
    "controller",
    "delay_of",
    "export",
    "load_logs",
    "tasks.make",
    "tasks.of_config",
    "angles.feature_names",
}


def example(*names: str) -> Callable[[Callable[[], Any]], Callable[[], Any]]:
    """Register an example of these names."""

    def register(function: Callable[[], Any]) -> Callable[[], Any]:
        EXAMPLES.update(dict.fromkeys(names, function))
        return function

    return register


@example("build")
def _() -> Any:
    state = jax.eval_shape(pg.build(CONFIG).init, key())
    assert isinstance(state, pg.RunState)
    assert state.data.x.shape == (1024, 4)  # room for the 50 rows of its trials, and more


@example("compose")
def _() -> Any:
    """Every piece of one's own takes the configured one's place."""
    fitted = pg.minibatches(DYNAMICS, optax.sgd(1e-3, momentum=0.9), batch_size=3)
    still = pg.PolicyOptimizer(init=lambda params: (), run=lambda key, learner, *_, **__: (learner, "searched"))
    twice = pg.Cost(lambda x: 2 * jnp.sum(x**2))
    own: dict[str, Any] = dict(dynamics=DYNAMICS, policy=POLICY, fitter=fitted, searcher=still, cost=twice)
    experiment = pg.compose(CONFIG, TASK, **own)
    assert experiment.task.cost.of_state(X) == pytest.approx(2 * float(X @ X))

    @jax.jit
    def learned() -> Any:
        state = experiment.init(key())
        assert jax.tree.structure(state.model.optimizer) == jax.tree.structure(fitted.init(state.model.params))
        state = experiment.add_episode(state, experiment.collect(state))
        searched, info = experiment.search(state)
        assert info == "searched"
        assert experiment.imagine(searched)[1].shape == (H, K)
        return experiment.fit(state)[1]

    return learned()


@example("run", "trial")
def _() -> Any:
    experiment = pg.compose(CONFIG, TASK)
    state, info = pg.run(experiment, 1, episodes=2)(key())
    assert info.evaluation.shape == (1, 2, H)
    shape = jax.eval_shape(partial(pg.trial, exp=experiment, episodes=2), state)  # `run` has just run one
    assert [leaf.shape for leaf in jax.tree.leaves(shape)] == [
        *(leaf.shape for leaf in jax.tree.leaves(state)),
        *(leaf.shape[1:] for leaf in jax.tree.leaves(info)),
    ]
    return state.data, info.evaluation, state.policy.params


@example("controller", "export", "train")
def _() -> Any:
    raise AssertionError("needs a run's folder: see below, and test_start.py")


def test_a_controller_of_a_run(tmp_path: Any) -> None:
    control = pg.controller(a_run(tmp_path / "run", trials=1), trial="last")
    assert isinstance(control, pg.Controller)
    assert control(np.zeros(4)).shape == (1,)
    assert pg.export(tmp_path / "run", out=tmp_path / "act.py").exists()


@example("delay_of")
def _() -> Any:
    u = np.random.default_rng(0).choice([-1.0, 1.0], (150, 1))
    x = np.cumsum(np.concatenate([np.zeros((2, 1)), u[:-1]]), 0) + 1e-3 * np.random.default_rng(1).normal(size=(151, 1))
    found = pg.delay_of([(x, u)])
    assert isinstance(found, pg.Delay)
    assert found.periods == 1
    return found.probabilities


@example("load_logs")
def _() -> Any:
    """As `add_episode` takes them: in arrays of H periods, with their lengths."""
    rows = np.column_stack([np.asarray(trajectory().x)[:4], np.asarray(trajectory().u)[:4]])
    with tempfile.TemporaryDirectory() as folder:
        np.savetxt(file := f"{folder}/log.csv", rows, delimiter=",", header="position,velocity,force", comments="")
        with pytest.warns(UserWarning, match="rows are taken to be dt=0.3 s apart"):
            (log,) = pg.load_logs(file, TASK)
    assert (log.x.shape, int(log.length)) == ((H + 1, D), 3)  # pyright: ignore[reportArgumentType]
    return log


@example("dynamics_of", "bnn", "ensemble", "lagrangian", "gp", "ssgp")
def _() -> Any:
    shape: dict[str, Any] = dict(states=D, controls=U, angles=())
    head = lambda raw: 0.1 * jax.nn.sigmoid(raw)  # noqa: E731
    network: dict[str, Any] = dict(hidden=(4,), dropout=pg.dropouts.log_normal())
    of_network = pg.bnn(**shape, **network, head=head, heteroscedastic=True)
    mechanism = pg.lagrangian(**shape, **network, rates=(1,), dt=0.3, substeps=1, activation="tanh")
    models = (pg.ensemble(of_network, 2), mechanism, pg.gp(**shape, features=4), pg.ssgp(**shape, points=3), DYNAMICS)
    return [predicted(model) for model in models]


def predicted(model: pg.Dynamics) -> pg.Prediction:
    posterior = model.posterior(model.init(key()), experience())
    change = model.apply(posterior, model.sample(key(), posterior), X, CONTROL)
    assert change.mean.shape == change.std.shape == (D,)
    return change


@example("policy_of", "mlp", "linear", "of_pair", "rbf")
def _() -> Any:
    encode, squash = partial(pg.angles.encode, angles=()), jnp.tanh
    shape: dict[str, Any] = dict(encode=encode, controls=U, saturate=squash)
    start = lambda key: jax.random.normal(key, (D,))  # noqa: E731
    policies = (
        POLICY,
        pg.mlp(**shape, features=D, hidden=(3,), dropout=pg.dropouts.binary(0.2), initializer="glorot"),
        pg.linear(**shape, features=D, saturate_moments=None),
        pg.rbf(**shape, start=start, waves=0, num_centers=3, saturate_moments=lambda mean, cov: None),  # type: ignore[arg-type]
        pg.of_pair(lambda key: jax.random.normal(key, (U, D)), lambda gain, features: gain @ features, TASK),
    )
    controls = [policy.apply(policy.init(key()), policy.sample(key()), X) for policy in policies]
    assert all(u.shape == (U,) for u in controls)
    return controls


@example("blocks", "draw", "rollout", *(f"matching.{name}" for name in pg.matching.__all__ if name != "Match"))
def _() -> Any:
    x, z = jax.random.normal(key(), (2, K, D))
    assert pg.matching.keep(x, z) is x
    pieces = {**PIECES, "noise": pg.NoiseUse(state=1.0)}
    matches = (pg.matching.match, pg.matching.keep, pg.matching.narrow(angles=(0,)))
    given = imagined()
    found = [pg.rollout(*given, **{**pieces, "match": match}) for match in matches]
    assert all(one.x.shape == (H + 1, K, D) for one in found)
    assert pg.matching.wide(found[0].x, angles=(0,)).shape == (H + 1,)
    return found


@example("objective")
def _() -> Any:
    return jax.value_and_grad(J)(*imagined())


@example("fit", "minibatches")
def _() -> Any:
    optimizer, params = optax.adam(1e-3), DYNAMICS.init(key())
    learner = pg.TrainState(params, optimizer.init(params))
    how: dict[str, Any] = dict(prepare=DYNAMICS.prepare, loss=DYNAMICS.loss, optimizer=optimizer, batch_size=4)
    by_hand = pg.fit(key(), learner, experience(), steps=3, **how)
    fitter = pg.minibatches(DYNAMICS, optimizer, batch_size=4)
    return by_hand, fitter.run(key(), pg.TrainState(params, fitter.init(params)), experience(), 3)


@example("gradient_search", "sampler")
def _() -> Any:
    params, posterior, _ = imagined()
    optimizer, draws = optax.adam(1e-3), pg.sampler(blocks(), pg.Period())
    learner = pg.TrainState(params, optimizer.init(params))
    how: dict[str, Any] = dict(objective=J, sampler=draws, optimizer=optimizer, steps=2)
    learner, info = pg.gradient_search(key(), learner, posterior, **how)
    assert info.objective.shape == (2,)
    return learner.params, info


@example("search", "searcher", "search_table")
def _() -> Any:
    params, posterior, _ = imagined()
    table = pg.search_table(2, init="better")
    assert isinstance(table, pg.SearchTable)
    of_row = lambda params, posterior, scenarios, row: J(params, posterior, scenarios)  # noqa: E731
    problem = pg.Problem(of_row, pg.sampler(blocks(), pg.Period()), optax.adam(1e-3), table)
    found = pg.searcher(problem)
    learner = pg.TrainState(params, found.init(params))
    assert isinstance(learner.optimizer, pg.SearchState)
    fresh = jax.vmap(POLICY.init)(jax.random.split(jax.random.key(1)))
    by_hand = pg.search(key(), learner, posterior, problem=problem, steps=2, fresh=fresh)
    again = jax.eval_shape(partial(found.run, steps=2), key(), learner, posterior, fresh=fresh)  # the same program
    assert jax.tree.map(jnp.shape, again) == jax.tree.map(jnp.shape, by_hand)
    return by_hand[0].params, by_hand[1]


@example("preset")
def _() -> Any:
    config = pg.preset("cartpole")
    assert isinstance(config, pg.Config)
    assert config.task == "cartpole"


@example(*(f"costs.{name}" for name in pg.costs.__all__))
def _() -> Any:
    cost = pg.costs.saturating(error, 1.0, ())
    x = jax.random.normal(key(), (H, K, D))
    each = pg.costs.of_particles(pg.costs.widened(cost, 2.0))(x)
    stopped = pg.costs.until_stop(each, x, lambda x: x[0] > 1, 1.0)
    assert each.shape == stopped.shape == (H, K)
    assert pg.costs.of_matched(cost)(x).shape == (H, 1)
    assert pg.costs.of_narrow(cost, (0,))(x).shape == (H, K)
    by_nodes, closed = pg.costs.expected_by_nodes(cost.of_state), pg.costs.expectation(cost)
    return by_nodes(X, jnp.eye(D)), closed(X, jnp.eye(D)), pg.costs.mean(stopped), pg.costs.total(each)


def test_the_two_expectations_of_a_cost_agree() -> None:
    costs = TASK.cost, pg.Cost(TASK.cost.of_state)
    closed, by_nodes = (jax.jit(pg.costs.expectation(cost)) for cost in costs)
    mean, cov = X, jnp.array([[0.1, 0.05], [0.05, 0.2]])
    np.testing.assert_allclose(by_nodes(mean, cov), closed(mean, cov), atol=1e-3)


@example(*(f"dropouts.{name}" for name in pg.dropouts.__all__))
def _() -> Any:
    kinds = [getattr(pg.dropouts, name)() for name in pg.dropouts.__all__]
    return [kind.mask(kind.init(key(), 3), kind.sample(key(), 3)) for kind in kinds]


@example(*(f"memory.{name}" for name in pg.memory.__all__))
def _() -> Any:
    past = pg.memory.past_controls(("u",), [0.0], 2, shown=True)
    goal = pg.memory.constant(("goal",), lambda key: jax.random.normal(key, (1,)))
    remembered = pg.memory.combined(past, pg.memory.clock(0.3), goal)
    assert isinstance(remembered, pg.Memory)
    return pg.compose(CONFIG, TASK._replace(memory=remembered)).init(key()).data


@example(*(f"data.{name}" for name in pg.data.__all__))
def _() -> Any:
    rows = pg.data.minibatch(key(), pg.data.grow(experience(), 3 * H), 6)
    assert isinstance(rows, pg.Batch)
    assert rows.y.shape == (6, D)
    return rows


@example(*(f"gaussian.{name}" for name in pg.gaussian.__all__ if name != "Image"))
def _() -> Any:
    features = partial(pg.gaussian.sincos, angles=(0,))
    control = pg.gaussian.chain(partial(pg.gaussian.affine, matrix=jnp.ones((U, D + 1))), pg.gaussian.squash)
    change = partial(pg.gaussian.affine, matrix=jnp.ones((D, D + 1 + U)))
    step = pg.gaussian.residual(pg.gaussian.chain(features, pg.gaussian.joint(control), change))
    after = step(X, 0.1 * jnp.eye(D))
    assert isinstance(after, pg.gaussian.Image)
    assert after.cov.shape == (D, D)
    return after


@example(*(f"angles.{name}" for name in pg.angles.__all__ if name != "feature_names"))
def _() -> Any:
    x = jnp.array([3.5, 1.0])
    return pg.angles.encode(x, (0,)), pg.angles.wrap(x), pg.angles.difference(x, -x, (0,))


@example("angles.feature_names")
def _() -> Any:
    assert len(pg.angles.feature_names(("angle", "rate"), (0,))) == 3


@example("tasks.make", "tasks.of_config")
def _() -> Any:
    made, configured = pg.tasks.make("cartpole"), pg.tasks.of_config(CONFIG)
    assert made.state_names == configured.state_names
    with pytest.raises(pg.ConfigError, match="did you mean 'cartpole'"):
        pg.tasks.make("cartpol")
    return made.cost.of_state(jnp.zeros(4))


def public(module: ModuleType = pg, prefix: str = "") -> dict[str, Any]:
    """Every public name, those of a family with a dot, and what it is."""
    found: dict[str, Any] = {}
    for name in module.__all__:
        value = getattr(module, name)
        family = inspect.ismodule(value) and hasattr(value, "__all__")
        found |= public(value, f"{name}.") if family else {prefix + name: value}
    return found


PUBLIC = public()
FUNCTIONS = {name: value for name, value in PUBLIC.items() if inspect.isfunction(inspect.unwrap(value))}


@pytest.mark.parametrize("name", sorted(FUNCTIONS.keys() - {"controller", "export", "train"}))
def test_an_exported_function_is_called_with_exported_names(name: str) -> None:
    assert name in EXAMPLES, f"{name} is exported and has no example here"
    found = EXAMPLES[name]() if name in IMPURE else _jitted(EXAMPLES[name])
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(found) if leaf.dtype.kind == "f")


_done: dict[Callable[[], Any], Any] = {}


def _jitted(function: Callable[[], Any]) -> Any:
    """What the example returns under jit; of several names that share it, computed once."""
    if function not in _done:
        # JAX's check of keys mistakes vmapped episodes of a plant for a second use.
        _done[function] = (unchecked if function is EXAMPLES["run"] else lambda f: f)(jax.jit(function))()
    return _done[function]


def test_every_example_is_of_an_exported_name() -> None:
    assert EXAMPLES.keys() == FUNCTIONS.keys()


# Types


def named(annotation: Any) -> Iterator[type]:
    """The package's classes in an annotation, inside unions, tuples and callables too."""
    parts = [part for argument in typing.get_args(annotation) for part in _each(argument)]
    if parts:
        for part in parts:
            yield from named(part)
    elif inspect.isclass(annotation) and annotation.__module__.startswith("pegasus"):
        yield annotation


def _each(argument: Any) -> list[Any]:
    return argument if isinstance(argument, list) else [argument]


def missing(value: Any) -> set[str]:
    """The classes in the annotations of a function, or of a class's fields, that are not exported."""
    classes = [c for c in PUBLIC.values() if inspect.isclass(c)]
    classes += [c for c in vars(pg.config).values() if inspect.isclass(c)]
    hints = typing.get_type_hints(inspect.unwrap(value))
    return {c.__qualname__ for hint in hints.values() for c in named(hint) if c not in classes}


@pytest.mark.parametrize("name", sorted(n for n, v in PUBLIC.items() if callable(v)))
def test_what_a_signature_names_is_exported(name: str) -> None:
    assert not missing(PUBLIC[name])


def test_a_private_type_in_a_signature_is_found() -> None:
    from pegasus_jax.models.bnn import Posterior

    def leaks(posterior: Posterior | None, many: Callable[[tuple[Posterior, int]], pg.Batch]) -> pg.Rollout: ...

    assert missing(leaks) == {"Posterior"}


def test_names_are_complete_and_others_are_refused() -> None:
    assert pg.__all__ == sorted(set(pg.__all__))
    assert {*dir(pg)} == {*pg.__all__, "__version__"}
    assert re.match(r"\d+\.\d+\.\d+", pg.__version__)
    with pytest.raises(AttributeError, match="no attribute rolout"):
        pg.rolout  # noqa: B018
    with pytest.raises(AttributeError, match=r"pegasus_jax\.Searcher is now called PolicyOptimizer"):
        pg.Searcher  # noqa: B018


# Shapes at the seams

SCENARIOS = [
    ("start", lambda s: s.start[0], r"scenarios\.start has shape \(2,\); expected \[K, D\]"),
    ("start", lambda s: s.start.astype(int), r"scenarios\.start is of int32; expected floating-point"),
    ("sensor", lambda s: s.sensor[:-1], r"scenarios\.sensor has shape \(3, 5, 2\); expected \[H, K, D\] \(4, 5, 2\)"),
    ("match", lambda s: s.match[:, :-1], r"scenarios\.match has shape \(4, 4, 2\); expected \[H, K, D\] \(4, 5, 2\)"),
    ("dynamics", lambda s: jax.tree.map(lambda leaf: leaf[:-1], s.dynamics), r"scenarios\.dynamics.* K = 5 particles"),
    ("policy", lambda s: jnp.zeros((3, 1)), r"scenarios\.policy has shape \(3, 1\); expected \[K, \.\.\.\] with K = 5"),
]


@pytest.mark.parametrize(("part", "change", "message"), SCENARIOS)
def test_a_rollout_names_the_part_of_the_scenarios_that_is_wrong(part: str, change: Any, message: str) -> None:
    given = drawn()
    wrong = given.scenarios._replace(**{part: change(given.scenarios)})
    with pytest.raises(ValueError, match=f"^{message}"):
        jax.eval_shape(partial(pg.rollout, **PIECES), given.params, given.posterior, wrong)


PIECES_THAT_ARE_WRONG = [
    ("policy", POLICY._replace(apply=lambda params, noise, x: x[0]), r"what policy\.apply returns .*\[K, U\]"),
    (
        "dynamics",
        DYNAMICS._replace(apply=lambda *_: pg.Prediction(jnp.zeros(3), jnp.ones(D))),
        r"mean of what dynamics\.apply returns for K particles has shape \(5, 3\); expected \[K, D\] \(5, 2\)",
    ),
    ("cost", pg.costs.of_particles(pg.Cost(lambda x: x)), r"the cost of one state has shape \(2,\); expected \(\)"),
    (
        "dynamics",
        DYNAMICS._replace(apply=lambda *_: (jnp.zeros(D), jnp.ones(D))),
        r"dynamics\.apply returns a tuple; expected Prediction\(mean \[D\], std \[D\]\)",
    ),
    ("cost", TASK.cost.of_state, r"cost\(x\) of states \(4, 5, 2\) has shape \(\); expected \[H, K\] \(4, 5\): costs"),
    ("cost", lambda x: x[0], r"cost\(x\) .* has shape \(5, 2\); expected \[H, K\] \(4, 5\)"),
    (
        "cost",
        pg.costs.of_particles(pg.Cost(lambda x: x[0] > 1)),
        r"the cost of one state is of bool; expected floating-point",
    ),
]


@pytest.mark.parametrize(("piece", "wrong", "message"), PIECES_THAT_ARE_WRONG)
def test_a_piece_of_your_own_that_answers_wrongly_is_named(piece: str, wrong: Any, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}"):
        jax.eval_shape(partial(J, **{piece: wrong}), *drawn())


def test_a_learner_is_no_parameters() -> None:
    params, *rest = drawn()
    with pytest.raises(ValueError, match=r"policy_params is a TrainState; .*policy_params=learner\.params"):
        jax.eval_shape(partial(pg.rollout, **PIECES), pg.TrainState(params, ()), *rest)


def test_an_episode_names_what_is_wrong_with_it() -> None:
    experiment = pg.compose(CONFIG, TASK)
    state, good = experiment.init(key()), trajectory()
    with pytest.raises(ValueError, match=r"an episode's u has shape \(4, 2\); expected \(4, 1\)"):
        experiment.add_episode(state, good._replace(u=jnp.zeros((H, 2))))
    with pytest.raises(ValueError, match=r"an episode's x is of int32"):
        experiment.add_episode(state, good._replace(x=jnp.zeros((H + 1, D), int)))
    with pytest.raises(ValueError, match=r"an episode's x has shape \(5, 1\); expected \(5, 2\)"):
        experiment.calibrate(state, good._replace(x=jnp.zeros((H + 1, 1))))


def test_an_episode_may_be_of_numpy() -> None:
    task = TASK._replace(angles=(0,), rates=())
    experiment, one = pg.compose(CONFIG, task), jax.device_get(trajectory())
    jax.eval_shape(lambda state: experiment.calibrate(state, one), experiment.init(key()))


def test_one_answer_is_not_that_of_two_controls() -> None:
    limits = dict(control_low=np.full(2, -1.0), control_high=np.ones(2), control_names=("a", "b"))
    for answer, shape in ((jnp.zeros(()), r"\(\)"), (jnp.zeros(1), r"\(1,\)")):
        policy = pg.of_pair(lambda key: (), lambda params, features, u=answer: u, TASK._replace(**limits))
        with pytest.raises(ValueError, match=rf"what apply returns has shape {shape}; expected \[U\] \(2,\)"):
            policy.apply((), (), X)


def wrong_model(**functions: Any) -> dict[str, Any]:
    return dict(dynamics=DYNAMICS._replace(**functions))


def wrong_policy(**functions: Any) -> dict[str, Any]:
    return dict(policy=POLICY._replace(**functions))


WRONG_PIECES: list[tuple[dict[str, Any], str]] = [
    (
        wrong_policy(apply=lambda params, noise, x: x),
        r"what policy\.apply returns has shape \(2,\); expected \[U\] \(1,\)",
    ),
    (wrong_policy(apply=lambda params, noise, x: None), r"what policy\.apply returns is a NoneType; .* array \[U\]"),
    (wrong_policy(apply=lambda params, x: x[:1]), r"policy\.apply: TypeError: .* 2 positional .*\(test_api\.py:\d+\)"),
    (wrong_policy(init=None), r"policy\.init=None is no function"),
    (wrong_policy(init=lambda key: {"gain": 3}), r"what policy\.init returns\['gain'\] is of int32; expected floating"),
    (wrong_model(loss=lambda *_: jnp.zeros(3)), r"what dynamics\.loss returns has shape \(3,\); expected \(\)"),
    (wrong_model(loss=lambda *_: None), r"what dynamics\.loss returns is a NoneType; expected an array \(\)"),
    (wrong_model(loss=lambda *_: 3), r"what dynamics\.loss returns is of int32; expected floating"),
    (wrong_model(init=lambda key: {"w": 3}), r"what dynamics\.init returns\['w'\] is of int32; expected floating"),
    (
        wrong_model(init=lambda key: {"act": jnp.tanh}),
        r"what dynamics\.init returns\['act'\] is a \w+; expected an array",
    ),
    (wrong_model(prepare=None), r"dynamics\.prepare=None is no function"),
    (wrong_model(posterior=lambda params: params), r"dynamics\.posterior: TypeError: .* 1 positional"),
    (wrong_model(apply=lambda *_: jnp.zeros(2)), r"dynamics\.apply returns an array; expected Prediction\("),
    (dict(cost=lambda x: 0.5), r"the cost returns 0\.5 whatever the state is; .*\(test_api\.py:\d+\)"),
    (dict(cost=lambda x: x), r"the cost returns an array of shape \(2,\); expected one number"),
    (dict(cost=lambda x: jnp.abs(x[4])), r"the cost reads entry 4 of an array of 2 at test_api\.py:\d+; x has 2"),
    (
        wrong_model(apply=lambda *_: pg.Prediction(jnp.zeros(3), jnp.ones(2))),
        r"mean of what dynamics\.apply returns has shape \(3,\); expected \[D\] \(2,\)",
    ),
]


@pytest.mark.parametrize(("piece", "message"), WRONG_PIECES)
def test_a_piece_that_answers_wrongly_is_named_before_anything_is_composed(piece: dict[str, Any], message: str) -> None:
    with pytest.raises(pg.ConfigError, match=f"^{message}"):
        pg.compose(CONFIG, TASK, **piece)


def test_a_model_that_is_not_fitted_by_its_loss_needs_none() -> None:
    fitter = pg.minibatches(DYNAMICS, optax.adam(1e-3), batch_size=5)
    known = DYNAMICS._replace(loss=None, prepare=None)  # type: ignore[arg-type]
    assert pg.compose(CONFIG, TASK, dynamics=known, fitter=fitter).dynamics.loss is None


def test_a_model_may_look_at_as_many_rows_as_there_is_room_for() -> None:
    """Nearest neighbours, or inducing rows: more than a few."""
    rows = pg.compose(CONFIG, TASK).init(key()).data.x.shape[0]
    nearest = lambda data: jax.lax.top_k(data.x[:, 0], rows)[1]  # noqa: E731
    near = DYNAMICS._replace(posterior=lambda params, data: (DYNAMICS.posterior(params, data), nearest(data)))
    near = near._replace(apply=lambda posterior, *given: DYNAMICS.apply(posterior[0], *given), deal=None)
    near = near._replace(sample=lambda key, posterior: DYNAMICS.sample(key, posterior[0]))
    assert pg.compose(CONFIG, TASK, dynamics=near).dynamics is near


def test_whole_numbers_are_parameters_where_no_gradient_is_taken() -> None:
    counted = {"n": jnp.zeros((), int)}
    policy = POLICY._replace(init=lambda key: counted, apply=lambda params, noise, x: x[:1])
    searcher = pg.PolicyOptimizer(lambda params: (), lambda key, learner, *_, **__: (learner, None))
    assert pg.compose(CONFIG, TASK, policy=policy, searcher=searcher).init(key()).policy.params == counted
    with pytest.raises(pg.ConfigError, match=r"what policy\.init returns\['n'\] is of int32"):
        pg.compose(CONFIG, TASK, policy=policy)


@pytest.mark.parametrize("entries", [jnp.array([0, 1]), np.array([0, 1])])
def test_a_cost_picks_entries_by_an_array_also_where_compose_is_traced(entries: Any) -> None:
    def begun(scale: jax.Array) -> Any:
        cost = lambda x: 1 - jnp.exp(-scale * jnp.sum(x[entries] ** 2))  # noqa: E731
        return pg.compose(CONFIG, TASK, cost=cost).init(key()).policy.params

    jax.eval_shape(begun, jnp.ones(()))
    with pytest.raises(pg.ConfigError, match="the cost reads entry 2 of an array of 2"):
        jax.eval_shape(lambda scale: pg.compose(CONFIG, TASK, cost=lambda x: scale * x[2] ** 2), jnp.ones(()))


def test_what_is_built_needs_numbers_that_nobody_traces() -> None:
    """One line, in place of an error from NumPy; what only runs may be traced."""

    def improved(scale: jax.Array, **how: Any) -> Any:
        config = replace(CONFIG, search=replace(CONFIG.search, **how))
        experiment = pg.compose(config, TASK, cost=lambda x: 1 - jnp.exp(-jnp.sum(x**2) * scale))
        state = experiment.init(key())
        return experiment.improve(experiment.add_episode(state, experiment.collect(state)))[1][1].objective

    with pytest.raises(pg.ConfigError, match=r"traces, and search\.cost_width_start=null looks at"):
        jax.eval_shape(improved, jnp.ones(()))
    jax.eval_shape(partial(improved, cost_width_start=1.0), jnp.ones(()))
    with pytest.raises(pg.ConfigError, match="the task's control_high is traced by jit, vmap or grad"):
        jax.eval_shape(lambda high: pg.compose(CONFIG, TASK._replace(control_high=high)).init(key()), jnp.ones(1))


def test_the_cost_of_a_task_is_one_of_an_objective() -> None:
    given = drawn()
    assert jax.jit(J)(*given) == jax.jit(partial(J, cost=TASK.cost))(*given)


WRONG_TASKS = [
    (dict(control_low=-2.0), r"the task's control_low has shape \(\); expected \(1,\), of 1 controls"),
    (dict(state_names=("a", "b", "c")), r"the task's start_mean has shape \(2,\); expected \(3,\), of 3 states"),
    (dict(sensor_std=None), r"the task's sensor_std has shape \(\); expected \(2,\)"),
    (dict(angles=(5,)), r"the task's angles=\(5,\) has 5; its 2 states are 0 to 1"),
    (dict(horizon=10.0), r"the task's horizon=10\.0 is not a whole number"),
    (dict(dt=-0.1), r"the task's dt=-0\.1 is no control period; expected a number of seconds above 0"),
    (dict(dt=float("nan")), r"the task's dt=nan is no control period"),
    (dict(dt=None), r"the task's dt=null is no control period"),
    (dict(angles=(0, 0)), r"the task's angles=\[0,0\] names 0 twice; the nearest is \[0\]"),
    (dict(goal=lambda key: 1.0), r"the task's goal is of type function; expected Signal\(value, units\)"),
    (
        dict(goal=Signal(lambda key: jnp.zeros(3), (1.0,))),
        r"the task's goal has values of shape \(3,\); expected \(1,\)",
    ),
    (dict(reference=Signal(lambda t: t, (1.0,))), r"the task's reference has values of shape \(\); expected \(1,\)"),
    (dict(start_mean=[float("nan"), 0.0]), r"the task's start_mean is \[nan, 0\.0\]; expected finite numbers"),
    (dict(control_high=[float("inf")]), r"the task's control_high is \[inf\]; expected finite numbers"),
    (
        dict(control_low=[2.0], control_high=[-2.0]),
        r"the task's limits of force are 2 and -2; expected control_low first",
    ),
    (dict(control_rate=2.0), r"the task's control_rate has shape \(\); expected \(1,\), of 1 controls"),
    (dict(control_rate=[-1.0]), r"the task's control_rate is \[-1\.0\]; expected numbers above 0, or None"),
    (dict(control_rate=[np.nan]), r"the task's control_rate is \[nan\]; expected finite numbers"),
    (dict(rates=(7,)), r"the task's rates=\(7,\) has 7; its 2 states are 0 to 1"),
    (dict(rates=(1, 1)), r"the task's rates=\[1,1\] names 1 twice"),
    (dict(angles=0), r"the task's angles=0 is no tuple of places in the state; for example \(0,\)"),
    (dict(starts=[1.0, 0.0]), r"the task's starts has shape \(2,\); expected \(N, 2\), rows of 2 states"),
    (dict(starts=[[1.0]]), r"the task's starts has shape \(1, 1\); expected \(N, 2\)"),
    (dict(starts_std=[1.0]), r"the task's starts_std has shape \(1,\); expected \(2,\)"),
    (dict(success="low"), r"the task's success=low is no number"),
    (dict(stop_cost=None), r"the task's stop_cost=null is no number; expected a cost a step, as 1\.0"),
    (dict(constraint=lambda x: x[0]), r"the task's constraint is of type function; expected .*Constraint\(of_state, "),
    (
        dict(constraint=Constraint(lambda x: jnp.zeros((2, 2)))),
        r"the task's constraint has values of shape \(2, 2\); expected one number, or a vector",
    ),
    (dict(stop=lambda x: x > 1), r"the task's stop has values of shape \(2,\); expected \(\), the probability"),
    (dict(stop=lambda x: x[0] - 2), r"the task's stop is -2 at start_mean; expected a probability, from 0 to 1"),
    (dict(prior=lambda x, u: x[:1]), r"the task's prior has values of shape \(1,\); expected \(2,\), the state one"),
    (dict(prior=lambda x: x), r"prior=.*TypeError: .*\(test_api\.py:\d+\)"),
    (dict(goal=Signal(lambda key: [0.0], (1.0,))), r"the task's goal has values of type list; expected an array"),
    (dict(goal=Signal(jax.random.normal, 1.0)), r"the task's goal has units=1\.0; expected a tuple of numbers"),  # type: ignore[arg-type]
    (dict(goal=Signal(lambda key: jnp.zeros(1), (0.0,))), r"the task's goal has units=\(0\.0,\); .* above 0"),
]


@pytest.mark.parametrize(("fields", "message"), WRONG_TASKS)
def test_a_task_whose_fields_do_not_agree_is_refused_in_one_line(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(pg.ConfigError, match=f"^{message}"):
        pg.compose(CONFIG, TASK._replace(**fields))


def test_places_in_the_state_may_be_any_whole_numbers_in_a_row() -> None:
    task = pg.compose(CONFIG, TASK._replace(angles=np.array([0]), rates=[np.int64(1)], horizon=np.int64(H))).task  # type: ignore[arg-type]
    assert (task.angles, task.rates, task.horizon) == ((0,), (1,), H)
    assert type(task.horizon) is int


UNTRACEABLE = [
    (
        "cost",
        lambda x: float(x[0]),
        "is not a JAX function: it makes a Python number or a NumPy array of x at test_api.py",
    ),
    ("cost", lambda x, u: np.exp(np.asarray(x)[0]), r"is not a JAX function: .*; use jax\.numpy"),
    ("cost", lambda x: x.nothing, r"AttributeError: .*\(test_api\.py:\d+\)"),
    ("stop", lambda x: 1.0 if x[0] > 1 else 0.0, r"is not a JAX function: .*jnp\.where instead of if"),
]


@pytest.mark.parametrize(("name", "function", "message"), UNTRACEABLE)
def test_a_function_that_jax_cannot_trace_is_named_with_its_line(name: str, function: Any, message: str) -> None:
    given: dict[str, Any] = {name: function}
    with pytest.raises(pg.ConfigError, match=f"^{name}=.*<lambda>.* ?{message}"):
        pg.compose(CONFIG, TASK._replace(**given))
    if name == "cost":
        with pytest.raises(pg.ConfigError, match=message):
            pg.compose(CONFIG, TASK, cost=function)


def test_a_cost_may_be_what_can_be_called_like_a_function() -> None:
    class Far:
        def __call__(self, x: jax.Array) -> jax.Array:
            return jnp.abs(x[0])

    for cost in (partial(lambda x, scale: scale * jnp.abs(x[0]), scale=1.0), Far()):
        made = pg.compose(CONFIG, TASK._replace(cost=cost))
        assert made.task.cost.of_state(X) == pytest.approx(0.3)


MOVING = Plant()
COUNTING: dict[str, Any] = dict(reset=lambda key: {"x": X, "t": 0}, observe=lambda state: state["x"])
WRONG_PLANTS: list[tuple[dict[str, Any], str]] = [
    (
        dict(step=lambda x, u: jnp.round(x).astype(int)),
        r"plant\.step returns a state of int32\[2\]; expected float32\[2\]",
    ),
    (
        dict(step=lambda x, u: x[:1]),
        r"plant\.step returns a state of float32\[1\]; expected float32\[2\], as plant\.reset",
    ),
    (
        dict(reset=lambda key: jnp.array([1, 0])),
        r"plant\.step returns a state of float32\[2\]; expected int32\[2\], as plant\.reset",
    ),
    (dict(step=lambda x, u: None), r"plant\.step returns a state of parts PyTreeDef\(None\); expected PyTreeDef\(\*\)"),
    (dict(reset=lambda key: jnp.zeros(3)), r"what plant\.observe returns has shape \(3,\); expected \[D\] \(2,\)"),
    (
        COUNTING | dict(step=lambda state, u: {"x": X, "t": jnp.zeros(3)}),
        r"plant\.step returns a state\['t'\] of float32\[3\]",
    ),
]


@pytest.mark.parametrize(("parts", "message"), WRONG_PLANTS)
def test_a_plant_whose_state_changes_its_form_is_named_in_one_line(parts: dict[str, Any], message: str) -> None:
    experiment = pg.compose(CONFIG, TASK._replace(plant=MOVING._replace(**parts)))
    with pytest.raises(ValueError, match=f"^{message}"):
        jax.eval_shape(experiment.collect, jax.eval_shape(experiment.init, key()))


def test_a_plant_may_count_in_numbers_of_python() -> None:
    plant = MOVING._replace(**COUNTING, step=lambda state, u: {"x": state["x"], "t": state["t"] + 0.1})
    experiment = pg.compose(CONFIG, TASK._replace(plant=plant))
    assert jax.eval_shape(experiment.collect, jax.eval_shape(experiment.init, key())).x.shape == (H + 1, D)


@pytest.mark.parametrize("size", [0, -5])
def test_a_batch_of_no_rows_is_refused(size: int) -> None:
    message = rf"^batch_size={size} is out of range; .* the nearest is 1$"
    with pytest.raises(pg.ConfigError, match=message):
        pg.minibatches(DYNAMICS, optax.adam(1e-3), batch_size=size)
    how: dict[str, Any] = dict(prepare=DYNAMICS.prepare, loss=DYNAMICS.loss, optimizer=optax.adam(1e-3), steps=1)
    with pytest.raises(pg.ConfigError, match=message):
        pg.fit(key(), pg.TrainState((), ()), experience(), **how, batch_size=size)


def test_a_saturation_that_is_none_is_refused() -> None:
    with pytest.raises(pg.ConfigError, match=r"^squash=sin is not a choice; did you mean 'sine'\? choices: tanh, sine"):
        pg.of_pair(lambda key: (), lambda params, features: features, TASK, squash="sin")


def test_a_task_that_is_none_is_refused_with_all_of_them() -> None:
    with pytest.raises(pg.ConfigError, match=r"^task=carpole is .*did you mean 'cartpole'\? choices: .*, gym, mjcf$"):
        pg.build(pg.Config(task="carpole"))


WRONG_KINDS: list[tuple[dict[str, Any], str]] = [
    (dict(fitter=optax.adamw(1e-3)), r"fitter=\w+ is no ModelLearner; .*\(init, run\); minibatches"),
    (dict(policy=lambda params, noise, x: x), r"policy=function is no Policy; .*; of_pair makes one"),
    (dict(dynamics=DYNAMICS.apply), r"dynamics=\w+ is no Dynamics; expected pegasus_jax\.Dynamics\(init, "),
    (dict(searcher=pg.gradient_search), r"searcher=function is no PolicyOptimizer; expected"),
]


@pytest.mark.parametrize(("piece", "message"), WRONG_KINDS)
def test_what_is_no_piece_is_refused_by_its_name(piece: dict[str, Any], message: str) -> None:
    with pytest.raises(pg.ConfigError, match=f"^{message}"):
        pg.compose(CONFIG, TASK, **piece)


def test_a_task_is_no_config() -> None:
    with pytest.raises(pg.ConfigError, match=r"build takes a Config, not a Task; compose\(config, task\) takes both"):
        pg.build(TASK)  # type: ignore[arg-type]
    with pytest.raises(
        pg.ConfigError, match=r"train takes a Config or .* preset, not a Task; .*compose\(config, task\)"
    ):
        pg.train(TASK)  # type: ignore[arg-type]


MISUSED: list[tuple[Callable[[], Any], str]] = [
    (lambda: pg.train(CONFIG, seeds="2"), r"seeds=2 is not a whole number as written, '2'; write seeds=2"),  # type: ignore[arg-type]
    (lambda: pg.train(CONFIG, seeds=2.0), r"seeds=2 is not a whole number as written, 2\.0; write seeds=2"),  # type: ignore[arg-type]
    (lambda: pg.compose(CONFIG, TASK, mesh=2), r"mesh=2 is no Mesh; pegasus_jax\.sharding\.mesh"),  # type: ignore[arg-type]
    (lambda: pg.dynamics_of("bnn", TASK), r"dynamics_of takes a config's model, not a str; preset\(NAME\)\.model"),  # type: ignore[arg-type]
    (lambda: pg.run(CONFIG, 2), r"run takes an Experiment, not a Config; build\(config\) makes one"),  # type: ignore[arg-type]
    (lambda: pg.trial(None, CONFIG), r"trial takes an Experiment, not a Config"),  # type: ignore[arg-type]
    (
        lambda: pg.config.Search(period=pg.Period()),
        r"search\.period=\[1,.*\] is not a pegasus_jax\.config\.Period; for",
    ),  # type: ignore[arg-type]
]


@pytest.mark.parametrize(("call", "message"), MISUSED)
def test_what_is_of_another_kind_is_told_in_one_line(call: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}"):
        call()


def test_a_policy_for_a_goal_takes_the_composed_task() -> None:
    cost = lambda x, goal: 1 - jnp.exp(-jnp.sum((x[:1] - goal) ** 2))  # noqa: E731
    task = TASK._replace(goal=Signal(lambda key: jax.random.uniform(key, (1,)), (1.0,)), cost=cost)
    policy = pg.policy_of(CONFIG.policy, pg.compose(CONFIG, task).task)
    experiment = pg.compose(CONFIG, task, policy=policy)
    assert jax.eval_shape(experiment.collect, jax.eval_shape(experiment.init, key())).u.shape == (H, U)


def test_a_searcher_that_returns_the_learner_alone_is_named() -> None:
    """A learner is a pair too, of parameters and an optimizer's state."""
    alone = pg.PolicyOptimizer(lambda params: (), lambda key, learner, *_, **__: learner)
    experiment = pg.compose(CONFIG, TASK, searcher=alone)
    with pytest.raises(ValueError, match=r"^searcher\.run returns a dict first; expected \(TrainState, SearchInfo\)"):
        jax.eval_shape(experiment.search, jax.eval_shape(experiment.init, key()))


def test_a_policy_that_remembers_what_its_task_does_not_is_refused() -> None:
    slow = pg.compose(replace(CONFIG, control_rate=(1.0,)), TASK)
    with pytest.raises(pg.ConfigError, match=r"^the policy remembers force 1 before, and the task nothing; expected"):
        pg.compose(CONFIG, TASK, policy=slow.policy)


def test_controls_of_a_policy_of_your_own_are_cut_off_at_the_limits() -> None:
    wild = POLICY._replace(apply=lambda params, noise, x: 100 * x[:1])
    experiment = pg.compose(CONFIG, TASK, policy=wild)
    state = experiment.init(key())
    flight = experiment.episode(key(), state.policy.params, False)
    expected = jnp.clip(100 * flight.x[:-1, :1], -2, 2)
    np.testing.assert_allclose(flight.u, expected)
    assert float(jnp.max(jnp.abs(flight.u))) == 2


def test_a_task_with_a_memory_may_be_composed_again() -> None:
    config = replace(CONFIG, control_rate=(1.0,))
    once = pg.compose(config, TASK).task
    assert pg.compose(config, once).task.memory.names == once.memory.names != ()


def test_a_model_without_parameters_is_fitted() -> None:
    known = DYNAMICS._replace(
        init=lambda key: (),
        loss=lambda params, key, batch, context: jnp.zeros(()),
        posterior=lambda params, data: (),
        sample=lambda key, posterior: (),
        apply=lambda posterior, noise, x, u: pg.Prediction(0.3 * jnp.stack([x[1], u[0]]), jnp.ones(2)),
        deal=None,
    )
    experiment = pg.compose(CONFIG, TASK, dynamics=known)
    state, info = experiment.fit(experiment.add_episode(experiment.init(key()), trajectory()))
    assert state.model.params == ()
    assert info.skipped == 0


def test_an_objective_that_is_not_finite_changes_no_policy() -> None:
    """Its gradient may be finite all the same."""
    experiment = pg.compose(CONFIG, TASK, cost=lambda x: x[0] + jnp.nan)
    state = experiment.add_episode(experiment.init(key()), trajectory())
    found, info = jax.jit(experiment.search)(state)
    assert info.skipped == CONFIG.search.steps
    jax.tree.map(np.testing.assert_array_equal, found.policy.params, state.policy.params)


def test_a_number_is_no_cost() -> None:
    with pytest.raises(pg.ConfigError, match=r"cost=0\.5 is no Cost; .*function of one state"):
        pg.compose(CONFIG, TASK, cost=0.5)  # type: ignore[arg-type]


# What is imported when

APPLICATIONS = {"gymnasium", "imageio", "matplotlib", "mujoco", "orbax", "scipy", "tensorboardX"}


EVERY = "[getattr(pg, n) for n in pg.__all__ if n.lower() not in ('controller', 'export')]"


@pytest.mark.parametrize(
    ("code", "absent", "present"),
    [
        ("", APPLICATIONS | {"jax", "numpy", "omegaconf", "rich"}, set()),
        ("pg.rollout", APPLICATIONS | {"omegaconf", "rich"}, {"jax"}),
        (EVERY, APPLICATIONS | {"omegaconf"}, {"flax"}),
        ("pg.tasks.make('cartpole')", APPLICATIONS - {"gymnasium", "mujoco", "scipy"} | {"omegaconf"}, {"mujoco"}),
        ("import pegasus_jax.viz.run_plots", APPLICATIONS - {"matplotlib"} | {"rich"}, {"matplotlib"}),
        ("import pegasus_jax.runs.checkpoint", APPLICATIONS | {"rich"}, {"jax"}),
        ("import pegasus_jax.runs.train", APPLICATIONS - {"tensorboardX"}, {"rich", "omegaconf"}),
    ],
)
def test_a_name_imports_what_it_needs_and_no_more(code: str, absent: set[str], present: set[str]) -> None:
    found = loaded(f"import pegasus_jax as pg\n{code}")
    assert not absent & found
    assert present <= found


def test_every_name_needs_five_packages_and_what_they_import() -> None:
    needed = loaded("import jax, flax, optax, chex, numpy")
    found = loaded(f"import pegasus_jax as pg\n{EVERY}")
    assert found - needed - sys.stdlib_module_names == {"pegasus_jax"}


def test_a_refused_command_waits_for_no_array_library() -> None:
    refused = "from pegasus_jax.cli import train\ntry: train.train(['serach.steps=5'])\nexcept ValueError: pass"
    found = loaded(refused)
    assert "pegasus_jax" in found
    assert not found & (APPLICATIONS | {"jax", "numpy", "flax", "optax"})


def loaded(code: str) -> set[str]:
    """The top-level modules that a program has imported when it ends."""
    code += "\nimport sys; print(*{name.partition('.')[0] for name in sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


SENSORS = (
    {"sensors.measured": [0, 3], "sensors.velocity": "difference", "sensors.delay": 2},
    {"sensors.measured": [0, 1, 3], "history": 2},
)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            dict(horizon=7),
            r"the Config has horizon=, and the task .* has horizon=5, which .*task\._replace\(horizon=",
        ),
        (dict(dt=0.4), r"the Config has dt="),
        (dict(stop=lambda x: x[0] > 1), r"the Config has stop=, and the task .* has stop=null"),
        (dict(constraint=lambda x: x[0] - 1), r"the Config has constraint="),
        (dict(goal_low=(-1.0,), goal_high=(1.0,)), r"the Config has goals=, and the task .* has goal=null"),
        (dict(reference=lambda t: t), r"the Config has reference="),
        (dict(explore=Explore(policy=lambda x: x)), r"the Config has explore\.policy=, and the task .* has guide=null"),
        (dict(sensors=Sensors(measured=(0,))), r"the Config has sensors\.measured=, and the task .* has state_names="),
        (dict(sensors=Sensors(delay=2)), r"the Config has sensors\.delay=, and the task .* has late=0"),
        (
            dict(sensors=Sensors(velocity="filter")),
            r"the Config has sensors\.velocity=, and the task .* has rates=\[\]",
        ),
        (dict(success=0.7), r"the Config has success=, and the task .* has success=0\.2"),
        (dict(stop_cost=3.0), r"the Config has stop_cost=, and the task .* has stop_cost=1"),
        (dict(circles=((0, 1),)), r"the Config has circles="),
        (dict(rates=(1,)), r"the Config has rates="),
        (dict(state_names=("a", "b")), r"the Config has state_names="),
        (dict(control_names=("a",)), r"the Config has control_names="),
        (dict(data=("a.csv",)), r"the Config has data=\[a\.csv\], and compose reads no files"),
        (dict(init="run"), r"the Config has init=run, and compose reads no files"),
    ],
)
def test_a_setting_that_makes_another_task_is_not_dropped(settings: dict[str, Any], message: str) -> None:
    task = TASK._replace(horizon=5, rates=())
    with pytest.raises(pg.ConfigError, match=f"^{message}"):
        pg.compose(replace(CONFIG, **settings), task)
    pg.compose(replace(CONFIG, horizon=5, dt=task.dt), task)
    pg.compose(replace(CONFIG, sensors=Sensors(delay=2)), task._replace(late=2))
    for words in SENSORS:
        config = pg.preset("cartpole", model="log_normal", settings=words)
        pg.compose(config, pg.tasks.of_config(config))


def test_what_is_no_config_or_no_task_is_one_line() -> None:
    configs = [((TASK, CONFIG), "config=Task is no Config"), ((None, TASK), "config=NoneType is no Config")]
    others = [((CONFIG, "cartpole"), "task=str is no Task"), ((CONFIG, None), "task=NoneType is no Task")]
    for given, says in configs + others:
        with pytest.raises(pg.ConfigError, match=f"^{says}; expected pegasus_jax"):
            pg.compose(*given)  # type: ignore[arg-type]


def test_the_dynamics_of_an_experiment_have_their_own_posterior() -> None:
    """Also where its search starts from visited states, and then knows more of one."""
    config = replace(CONFIG, search=replace(CONFIG.search, visited_starts=0.5, refine_fraction=0.5))
    experiment = pg.compose(config, TASK)
    state = experiment.init(key())
    posterior = experiment.dynamics.posterior(state.model.params, state.data)
    pieces: dict[str, Any] = dict(dynamics=experiment.dynamics, policy=experiment.policy)
    own = pg.blocks(**pieces, start=lambda key: X, particles=K, horizon=H)
    assert pg.draw(key(), 0, posterior, blocks=own).start.shape == (K, D)
    again = pg.compose(config, TASK, dynamics=experiment.dynamics)
    jax.eval_shape(again.improve, again.add_episode(state, again.collect(state)))


@pytest.mark.parametrize("length", [-1, H + 1, 2.5])
def test_an_episode_of_a_length_that_cannot_be_is_refused(length: float) -> None:
    experiment = pg.compose(CONFIG, TASK)
    state = experiment.init(key())
    ran = experiment.collect(state)
    with pytest.raises(ValueError, match=f"an episode's length is {length}; expected a whole number from 0 to"):
        experiment.add_episode(state, ran._replace(length=np.asarray(length)))
    whole = jax.jit(experiment.add_episode)(state, ran._replace(length=jnp.int32(1000)))
    assert whole.data.size == len(ran.u)


def test_an_episode_of_numpy_arrays_is_one() -> None:
    experiment = pg.compose(CONFIG, TASK)
    state = experiment.init(key())
    ran = experiment.collect(state)
    given = ran._replace(**{name: np.asarray(getattr(ran, name)) for name in ("x", "u", "cost")})
    one, other = (experiment.add_episode(state, rows).data for rows in (given, ran))
    assert jax.tree.all(jax.tree.map(np.array_equal, one, other))
