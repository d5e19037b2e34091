"""Composition: every named choice builds, and what a config says reaches the piece it is about."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pegasus_jax import config, config_models, config_plant, config_policies, tasks
from pegasus_jax.assembly.experiments import EXPLORATIONS, build, compose, set_precision
from pegasus_jax.assembly.pieces import dropout_of, policy_of
from pegasus_jax.assembly.searchers import search_of, start
from pegasus_jax.checks import ConfigError
from pegasus_jax.config import Config, Period
from pegasus_jax.config_models import DROPOUTS
from pegasus_jax.learn import data as dataset
from pegasus_jax.math.gaussian import affine
from pegasus_jax.models.networks import INITIALIZERS
from pegasus_jax.pilco.gp import gp
from pegasus_jax.pilco.ssgp import ssgp
from pegasus_jax.policies.squash import SQUASHES
from pegasus_jax.presets import ALGORITHMS, MODELS, POLICIES
from pegasus_jax.runs import config_io
from pegasus_jax.tasks.remembered import remembering
from pegasus_jax.types import Cost, Dataset, TrainState
from probes import PENDULUM, SCALAR, cart, dial, known, linear_policy, same, tiny


def test_the_choices_of_a_config_are_the_pieces_there_are():
    """config.py cannot import the pieces; it lists their names, and this keeps the lists true."""
    assert tuple(INITIALIZERS) == config_models.INITIALIZERS
    assert tuple(SQUASHES) == config_policies.SQUASHES
    assert tuple(EXPLORATIONS) == config_plant.EXPLORATIONS


@pytest.mark.parametrize("kind", DROPOUTS)
def test_every_dropout_is_the_one_of_its_name(kind):
    """By its parameters and its mean; an unknown name must not fall through to no noise."""
    noise = dropout_of(config.BNN(dropout=kind, log_z_min=-4.0))
    params = noise.init(jax.random.key(0), 5)
    names = dict(log_normal={"location", "scale"}, concrete={"logit"}, gaussian={"logit"}, sparse={"position"})
    assert set(params) == names.get(kind, set())
    mean = np.asarray(noise.retain(params))
    if kind in ("binary", "concrete"):
        np.testing.assert_allclose(mean, 0.9, atol=0.01)
    if kind == "log_normal":
        short = noise.mask({name: jnp.full(5, -50.0) for name in params}, jnp.full(5, 1e-6))
        np.testing.assert_allclose(short, np.exp(-4), rtol=1e-2)  # the interval is the one given


# Of make test: each model once, each policy twice. The other pairs say no more of a piece that is in these.
VARIANTS = [
    pytest.param(model, policy, marks=() if (i - j) % len(POLICIES) == 0 else pytest.mark.campaign)
    for i, model in enumerate(MODELS)
    for j, policy in enumerate(POLICIES)
]


@pytest.mark.parametrize(("model", "policy"), VARIANTS)
def test_every_variant_has_the_shapes_of_the_loop(model, policy):
    """eval_shape traces the loop without compiling it."""
    task = cart() if model == "lagrangian" else dial()  # which has no rates
    exp = compose(config_io.parse({"model": model, "policy": policy}), task)
    state = jax.eval_shape(exp.init, jax.random.key(0))
    state = jax.eval_shape(exp.add_episode, state, jax.eval_shape(exp.collect, state))
    improved, _ = jax.eval_shape(exp.improve, state)
    assert jax.tree.structure(improved) == jax.tree.structure(state)
    shapes = [[(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(tree)] for tree in (improved, state)]
    assert shapes[0] == shapes[1]


def test_a_mechanism_needs_coordinates_and_their_rates():
    with pytest.raises(ConfigError, match=r"model=lagrangian needs .*task=dial.*the nearest is model=log_normal"):
        compose(config_io.parse({"model": "lagrangian"}), dial())


def test_the_rates_of_a_gym_are_named_and_checked():
    words = {
        "task": "gym",
        "env": "InvertedPendulum-v5",
        "cost": "jax.numpy:sum",
        "model": "lagrangian",
        "angles": "[1]",
    }
    compose(known := config_io.parse(words | {"rates": "[2,3]"}), tasks.of_config(known))
    for rates, expected in (
        ("[2,9]", "rates=9 is not an entry"),
        ("[1,2]", "model=lagrangian needs"),
        ("[2]", "needs"),
    ):
        wrong = config_io.parse(words | {"rates": rates})
        with pytest.raises(ConfigError, match=expected):
            compose(wrong, tasks.of_config(wrong))


def test_a_policy_counts_in_the_units_it_is_given():
    """Speeds in units of 2 m/s: the control is that of the plain policy at half the speed; angles have none."""
    task = tasks.make("cartpole")
    plain, counting = (policy_of(config.MLP(hidden=(5,), input_units=units), task) for units in ((), (1.0, 2.0, 4.0)))
    params = plain.init(jax.random.key(0))
    at = lambda policy, x: policy.apply(params, None, jnp.array(x))  # noqa: E731
    np.testing.assert_allclose(at(counting, [0.3, 1, -2, 2.5]), at(plain, [0.3, 0.5, -0.5, 2.5]), rtol=1e-5)
    with pytest.raises(
        ConfigError, match=r"policy.input_units=\[1.0\] must be 3 numbers, of x \[m\], x' \[m/s\], theta'"
    ):
        policy_of(config.MLP(input_units=(1.0,)), task)
    with pytest.raises(ConfigError, match=r"policy.input_units=0 is out of range"):
        config.MLP(input_units=(1.0, 0.0, 1.0))


def test_a_policy_counts_earlier_controls_in_their_own_range():
    """Told in N or in mN, forces of before move a fresh policy alike; what was learned with another input keeps it."""
    words = {"task": "cartpole", "sensors.measured": "[0,3]", "sensors.velocity": "difference", "sensors.delay": "1"}
    given = config_io.parse(words)

    def policy(factor):
        task = tasks.of_config(given)
        task = task._replace(control_low=task.control_low * factor, control_high=task.control_high * factor)
        return policy_of(given.policy, remembering(given, task))

    def seen(factor, rows=20):
        """[x, theta, two earlier forces, their rates]"""
        x = jax.random.normal(jax.random.key(1), (rows, 6))
        return x.at[:, 2:4].multiply(5.0 * factor)

    newtons, small = policy(1.0), policy(1000.0)
    params, of_small = newtons.init(jax.random.key(0)), small.init(jax.random.key(0))
    act = lambda policy, params, x: jax.vmap(lambda x: policy.apply(params, None, x))(x)  # noqa: E731
    expected = act(newtons, params, seen(1.0))
    np.testing.assert_allclose(act(small, of_small, seen(1000.0)) / 1000, expected, rtol=1e-4, atol=1e-5)
    data = Dataset(seen(1000.0), jnp.zeros((20, 1)), jnp.zeros((20, 4)), jnp.int32(20))
    adapted = small.adapt(of_small, data)
    np.testing.assert_allclose(act(small, adapted, seen(1000.0)) / 1000, expected, rtol=1e-4, atol=1e-5)
    plain = of_small | {"input": of_small["input"]._replace(scale=jnp.ones(7))}
    np.testing.assert_allclose(
        act(small, plain, seen(1.0)) / 1000, act(newtons, plain, seen(1.0)), rtol=1e-4, atol=1e-5
    )


@pytest.mark.parametrize(
    ("words", "shape"),
    [
        ({"model": "gp"}, (2, 200)),
        ({"model": "ssgp"}, (2, 200)),
    ],
)
def test_the_size_of_a_gaussian_process_is_the_authors(words, shape):
    dynamics = compose(config_io.parse(words), cart()).dynamics
    data = jax.eval_shape(lambda: dataset.empty(9, 2, 1))
    posterior = jax.eval_shape(dynamics.posterior, jax.eval_shape(dynamics.init, jax.random.key(0)), data)
    draw = jax.eval_shape(dynamics.sample, jax.random.key(0), posterior)
    assert shape in [leaf.shape for leaf in jax.tree.leaves(draw)]


@pytest.mark.parametrize("algorithm", sorted({*ALGORITHMS} - {"pilco"}))
def test_every_algorithm_is_a_matter_of_periods_particles_and_clipping(algorithm):
    chosen = config_io.parse({"algorithm": algorithm})
    periods, particles, clip = {
        "pegasus": (
            Period(start=1, dynamics=100, policy=1, sensor=1, match=1),
            50,
            1.0,
        ),  # docs/decisions.md 0001 and 0029
        "paper": (Period(start=1, dynamics=0, policy=0, sensor=0, match=0), 100, 1.0),  # Alg. 3
        "deep_pilco": (Period(1, 1, 1, 1, 1), 10, None),  # Alg. 2
    }[algorithm]
    assert chosen.search.period == periods
    assert (chosen.search.particles, chosen.search.grad_clip) == (particles, clip)
    jax.eval_shape(compose(dataclasses.replace(tiny(), search=chosen.search), cart()).init, jax.random.key(0))


def test_a_config_is_built_once():
    """A tuple of functions hashes by identity: built twice, everything would compile twice."""
    one, two = build(Config()), build(Config())
    assert one is two
    assert build(Config(seed=1)) is one
    assert build(Config(trials=1)) is not one


def test_the_data_set_has_room_for_the_whole_run():
    def rows(trials: int, **changes: object) -> int:
        experiment = compose(dataclasses.replace(tiny(trials=trials), **changes), cart(horizon=5))
        return jax.eval_shape(experiment.init, jax.random.key(0)).data.x.shape[0]

    assert rows(7) == rows(200) == 1024  # one program for both
    assert rows(300) == 2048
    assert rows(7, model=config.GP()) == 35  # where each row costs time


def test_your_own_model_and_policy_take_the_place_of_the_configured_ones():
    dynamics, policy = known(SCALAR), linear_policy(1, 1)
    exp = compose(tiny(), dial(), dynamics=dynamics, policy=policy)
    assert exp.dynamics is dynamics
    assert exp.policy.init is policy.init  # its `apply` is cut off at the limits


@pytest.mark.parametrize(
    ("search", "part"),
    [
        (dict(particles=2, matching="always"), "search.particles=2"),
        (dict(particles=2, matching="never", standardized_noise=True), "search.particles=2"),
    ],
)
def test_too_few_particles_for_a_covariance_are_refused(search, part):
    """Two particles span a line; matching, or balancing, in the two dimensions of the cart would divide by zero."""
    chosen = dataclasses.replace(tiny(), search=config.Search(**search))
    with pytest.raises(ConfigError, match=part):
        compose(chosen, cart())


# What reaches the search, seen on pieces that compile in no time: a linear model, noisy, and a linear policy


def test_first_states_are_those_of_the_task():
    x = np.asarray(jax.vmap(partial(start, task=cart()))(jax.random.split(jax.random.key(0), 2000)))
    np.testing.assert_allclose(x.mean(0), [1.0, 0.0], atol=0.02)
    np.testing.assert_allclose(x.std(0), [0.1, 0.1], atol=0.02)


# PILCO

ANALYTIC = config.Analytic(steps=3, particles=5, init="previous")


def small_pilco(model, policy, task, **search):
    """An experiment of PILCO with the real pieces, small."""
    size = dict(states=len(task.state_names), controls=len(task.control_names), angles=task.angles)
    dynamics = {"gp": partial(gp, features=8), "ssgp": partial(ssgp, points=5)}[model](**size)
    sections = dict(policy=policy, search=dataclasses.replace(ANALYTIC, **search))
    return compose(dataclasses.replace(tiny(trials=2), **sections), task, dynamics=dynamics)


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("model", "policy", "task"),
    [
        ("gp", config.Linear(), cart),
        ("ssgp", config.RBF(num_centers=4), dial),
    ],
    ids=["gp-linear", "ssgp-rbf"],
)
def test_pilco_improves_a_policy_under_a_model(model, policy, task):
    """Jitted, deterministic, in whatever precision; the objective falls, and the policy is all that changes."""
    exp = small_pilco(model, policy, task(horizon=4))

    @jax.jit
    def start(key):
        state = exp.init(key)
        return exp.add_episode(state, exp.collect(state))

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


@pytest.fixture
def usual():
    """JAX's own precision, then and afterwards."""
    before = jax.config.jax_default_matmul_precision
    jax.config.update("jax_default_matmul_precision", None)
    yield
    jax.config.update("jax_default_matmul_precision", before)


@pytest.mark.parametrize(
    ("platform", "told", "expected"),
    [("gpu", None, "float32"), ("gpu", "tensorfloat32", "tensorfloat32"), ("cpu", None, None)],
)
def test_a_gpus_products_have_single_precision_unless_it_was_told(monkeypatch, usual, platform, told, expected):
    monkeypatch.setattr(jax, "default_backend", lambda: platform)
    jax.config.update("jax_default_matmul_precision", told)
    set_precision(Config())
    assert jax.config.jax_default_matmul_precision == expected


@pytest.mark.parametrize(
    ("policy", "pieces", "part"),
    [
        (config.RBF(), {}, "model=ssgp"),
        (config.MLP(), {"dynamics": True}, "policy=rbf, policy=linear"),
        (config.RBF(squash="tanh"), {"dynamics": True}, "policy=rbf"),
    ],
)
def test_pilco_without_moments_is_refused(policy, pieces, part):
    """Naming what has them."""
    model = gp(states=2, controls=1, angles=()) if "dynamics" in pieces else None
    with pytest.raises(ConfigError, match=part) as caught:
        compose(dataclasses.replace(tiny(), policy=policy, search=ANALYTIC), cart(), dynamics=model)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_the_settings_of_pilcos_search_reach_its_objective():
    change = jnp.asarray(np.hstack([PENDULUM.a - np.eye(2), PENDULUM.b]), jnp.float32)
    dynamics = known(PENDULUM, noise_std=0.2)._replace(moments=lambda _, mean, cov: affine(mean, cov, change))
    policy = linear_policy(2, 1)._replace(moments=lambda gain, mean, cov: affine(mean, cov, gain))

    def value(task, **search):
        chosen = dataclasses.replace(ANALYTIC, **{"policy_noise": 0.0, "state_noise": 0.0, **search})
        searcher = search_of(chosen, task, dynamics, policy).searcher
        params = jnp.full((1, 2), -0.5)
        run = jax.jit(partial(searcher.run, first=0, steps=1, fresh=jnp.stack([params] * 2)))
        return float(run(jax.random.key(0), TrainState(params, searcher.init(params)), None)[1].objective[0])

    of_cart = partial(value, cart(horizon=3))
    plain = of_cart()
    values = [of_cart(**{f"{name}_noise": 1.0}) for name in ("policy", "state")]
    assert all(abs(value - plain) > 1e-4 for value in values), (plain, values)
    assert values[0] != values[1]
    # And so does a cost that is only a function.
    own = value(cart(horizon=3)._replace(cost=Cost(lambda x: -jnp.expm1(-x @ x / 2))))
    assert own != plain
    assert own == pytest.approx(plain, rel=0.01)


WITHIN = {
    "cart-pole": {},
    "positions": {"sensors": config.Sensors(measured=(0, 3), velocity="difference", delay=1)},
    "constraint": {"constraint": lambda x: jnp.abs(x[0]) - 2},
    "reference": {"reference": lambda t: jnp.sin(t), "cost": lambda x, reference: (x[0] - reference[0]) ** 2},
}


@pytest.mark.parametrize("what", WITHIN)
def test_an_experiment_that_was_built_inside_a_program_is_of_use_in_others(what):
    """`build` keeps what it makes: nothing of it may belong to the program that was traced around the first call."""
    own = tiny(trials=1, task="cartpole", **WITHIN[what])

    def cost(key: jax.Array) -> jax.Array:
        experiment = build(own)
        return experiment.collect(experiment.init(key)).cost

    assert jax.eval_shape(cost, jax.random.key(0)).shape == (25,)
    assert np.isfinite(cost(jax.random.key(0))).all()
