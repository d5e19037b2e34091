"""From a simulator to the plant: prior= is the mean of a model, init= begins with another run."""

import shutil
from dataclasses import replace
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pegasus_jax as pg
from benchmarks.robot import cartpole_by_hand
from folders import TINY, a_run
from pegasus_envs.cartpole import cartpole
from pegasus_jax import build, compose, memory, tasks
from pegasus_jax.checks import ConfigError, RunError
from pegasus_jax.config import begins_with, first_search
from pegasus_jax.learn import data as dataset
from pegasus_jax.logs.read import read
from pegasus_jax.models.ensemble import ensemble
from pegasus_jax.models.residual import FURTHEST, differences, on_differences, residual
from pegasus_jax.runs import begin, check, checkpoint, config_io, logged, restore, store
from pegasus_jax.runs.train import train
from pegasus_jax.tasks import priors
from pegasus_jax.tasks.remembered import remembering
from pegasus_jax.types import Batch, ModelLearner
from pegasus_jax.vectorized import for_particles
from probes import PLAIN, cart, experience, network, regression, same, tiny

NETWORK = {"preset": "cartpole_network", "search__particles": "20"}
SMALL = {"fit.steps": "2", "eval_episodes": "0", "trials": "1"}
PLAIN_SEARCH = {name: str(value) for name, value in PLAIN.items()}


def simulate(x, u):
    """A made-up simulator of the rig's shapes: three states, the last an angle, and two controls."""
    return jnp.stack([x[0] + 0.1 * x[1], 0.9 * x[1] + u[0], x[2] + 12.0 * u[1]])


def parse(**words):
    return config_io.parse(TINY | SMALL | {name.replace("__", "."): value for name, value in words.items()})


# prior=


@pytest.mark.parametrize("off", ["exact", "mixed"])
def test_equations_by_hand_are_the_cart_poles(off):
    c = cartpole_by_hand.constants(off)
    plant = cartpole(pole_length=c["length"], pole_mass=c["pole"], cart_mass=c["cart"], friction=c["friction"])
    x = jax.random.normal(jax.random.key(0), (20, 4)) * jnp.array([1, 2, 4, 2])
    u = jax.random.uniform(jax.random.key(1), (20, 1), minval=-10, maxval=10)
    theirs = jax.jit(jax.vmap(lambda x, u: plant.observe(plant.step(plant.state_from_observation(x), u))))(x, u)
    np.testing.assert_allclose(jax.vmap(getattr(cartpole_by_hand, off))(x, u), theirs, atol=2e-3)


def model(kind):
    told = {"controls": 2 + 3}
    return {
        "bnn": lambda: network(**told),
        "ensemble": lambda: ensemble(network(**told), 3),
        "regression": lambda: regression(3, 5),
    }[kind]()


@pytest.mark.parametrize("kind", ["bnn", pytest.param("ensemble", marks=pytest.mark.campaign)])
def test_a_residual_is_the_simulator_and_what_was_learned_within_what_was_seen(kind):
    """For one particle and for many, with an independent sum; its loss is that of the differences, which wrap."""
    learned, data = model(kind), experience()
    whole = residual(learned, simulate, angles=(2,))
    params = jax.jit(whole.init)(jax.random.key(0))
    given = jax.jit(whole.posterior)(params, data)
    x, u, keys = data.x[:7] * 1.1, data.u[:7], jax.random.split(jax.random.key(1), 7)
    draws = jax.jit(whole.deal or jax.vmap(whole.sample, (0, None)))(keys, given)
    found = jax.jit(for_particles(whole.apply))(given, draws, x, u)
    stepped = jax.jit(jax.vmap(simulate))  # operation by operation it takes seconds
    change = np.array(stepped(x, u)) - np.array(x)
    change[:, 2] = np.angle(np.exp(1j * change[:, 2]))
    added = jax.jit(for_particles(learned.apply))(given.learned, draws, x, np.concatenate([u, change], 1))
    rows = np.array(stepped(data.x, data.u) - data.x)
    left = np.array(data.y) - rows
    left[:, 2] = np.angle(np.exp(1j * left[:, 2]))
    limit = FURTHEST * np.abs(left[: int(data.size)]).max(0)
    np.testing.assert_allclose(found.mean, change + limit * np.tanh(added.mean / limit), rtol=2e-4, atol=2e-5)
    np.testing.assert_array_equal(found.std, added.std)
    np.testing.assert_allclose(differences(data, simulate, (2,)).y, left, atol=1e-5)
    assert np.abs(left[:, 2]).max() < np.pi + 1e-5 < np.abs(rows[:, 2]).max()
    slope = jax.jit(jax.grad(lambda u: for_particles(whole.apply)(given, draws, x, u).mean[:, 2].sum()))(u)
    assert np.isfinite(slope).all()
    assert np.all(slope[:, 1] != 0)
    batch = Batch(data.x[:5], data.u[:5], data.y[:5])
    context = whole.prepare(data)
    raw = jax.jit(whole.loss)(params, jax.random.key(2), batch, context)
    of_rows = jax.jit(lambda *given: learned.loss(*given[:2], differences(given[2], simulate, (2,)), given[3]))(
        params, jax.random.key(2), batch, context
    )
    assert float(raw) == float(of_rows)


def test_before_there_are_data_a_residual_is_its_simulator():
    whole = residual(model("bnn"), simulate, angles=(2,))
    nothing = dataset.empty(8, 3, 2)
    given = jax.jit(whole.posterior)(whole.init(jax.random.key(0)), nothing)
    x, u = jnp.array([0.3, -0.2, 3.0]), jnp.array([0.5, 0.1])
    predicted = whole.apply(given, whole.sample(jax.random.key(1), given), x, u)
    np.testing.assert_allclose(predicted.mean, [-0.02, 0.52, 1.2], atol=1e-5)
    assert np.isfinite(predicted.std).all()


def test_what_fits_a_residual_is_given_the_differences():
    seen = []
    fitter = ModelLearner(lambda params: None, lambda key, learner, data, steps: (learner, seen.append(data)))
    on_differences(fitter, simulate, (2,)).run(None, None, experience(), 3)
    assert same(seen[0], differences(experience(), simulate, (2,)))
    assert seen[0].u.shape == (40, 5)


def test_a_policy_is_searched_in_the_simulator_before_the_first_episode():
    """And later searches go on from it: nothing of what it learned is taken for that of a policy that knows nothing."""
    plant = cart()
    task = plant._replace(prior=plant.plant.step)
    quick = dict(fit__steps=3, model__hidden=(4,), policy__hidden=(4,), search__particles=8)
    exp = compose(tiny(trials=2, search__steps=30, explore__trials=0, **quick), task)
    state = jax.jit(exp.init)(jax.random.key(0))
    searched = jax.jit(exp.search)(state)[0]
    imagine = jax.jit(exp.imagine)
    assert imagine(searched)[1].mean() < imagine(state)[1].mean() - 0.02
    collect = jax.jit(exp.collect)
    assert collect(searched).cost.mean() < collect(state).cost.mean()


def told(error):
    text = str(error.value)
    assert len(text.splitlines()) == 1
    return text


@pytest.mark.parametrize(
    ("function", "part"),
    [
        (lambda x, u: x[:2], "returns (2,) of a state (4,) and a control (1,); expected the state"),
        (lambda x, u: x / 0, "of the start [0.0, 0.0, 0.0, 0.0]; expected finite numbers"),
        (lambda x, u: jnp.sqrt(jnp.abs(x)), "has a gradient that is not finite at the start"),
        (lambda x: x, "TypeError"),
    ],
)
def test_a_prior_that_is_none_is_one_line(function, part, monkeypatch):
    module = ModuleType("theirs")
    module.step = function
    monkeypatch.setitem(__import__("sys").modules, "theirs", module)
    with pytest.raises(ConfigError) as error:
        tasks.of_config(parse(prior="theirs:step", model="log_normal"))
    assert part in told(error)
    assert told(error).startswith("prior=theirs:step")


def test_a_prior_of_another_kind_of_model_or_size_is_one_line(tmp_path):
    by_hand = "benchmarks.robot.cartpole_by_hand:low"
    with pytest.raises(ConfigError, match=r"model=lagrangian is a mechanism.*the nearest is model=log_normal"):
        compose(parse(prior=by_hand), tasks.of_config(parse(prior=by_hand)))
    link = "<mujoco><worldbody><body><joint/><geom size='1'/></body></worldbody><actuator><motor joint='j'/></actuator>"
    (tmp_path / "link.xml").write_text(f"{link}</mujoco>".replace("<joint/>", "<joint name='j' type='hinge'/>"))
    with pytest.raises(ConfigError) as error:
        tasks.of_config(parse(prior=str(tmp_path / "link.xml"), model="log_normal"))
    assert "has the state j [rad], j' [rad/s], and cartpole has x [m]" in told(error)
    with pytest.raises(ConfigError, match="there is no such file"):
        tasks.of_config(parse(prior="nowhere.xml", model="log_normal"))


def test_a_prior_of_entries_in_another_order_is_one_line(tmp_path):
    """As far as units tell it: a unit that is not said, or that is spelled in another way, may be the same."""
    joint, part = "<joint name='{0}' type='{0}'/><geom size='1'/>", "<body>{}</body>"
    links = part.format(joint.format("slide") + part.format(joint.format("hinge")))
    motor = "<actuator><motor joint='slide'/></actuator>"
    (tmp_path / "cart.xml").write_text(f"<mujoco><worldbody>{links}</worldbody>{motor}</mujoco>")
    config = parse(prior=str(tmp_path / "cart.xml"), model="log_normal")
    task = tasks.of_config(parse())

    def refused(**words):
        priors.of_file("prior=cart.xml", replace(config, **words), task)

    with pytest.raises(ConfigError, match=r"cart.xml has hinge \[rad\] where cartpole has .* \[m/s\]: expected the"):
        refused()
    refused(observe=("qpos.0", "qvel.0", "qvel.1", "qpos.1"))
    task = task._replace(state_names=("x", "v", "rate [deg/s]", "angle"))
    refused()


@pytest.mark.slow
def test_an_mjcf_prior_has_mujocos_slopes(tmp_path):
    """With a joint's limit, which MJX computes in a loop that has no way back."""
    file = tmp_path / "cart.xml"
    file.write_text(
        "<mujoco><option timestep='0.05' gravity='0 0 0'/><worldbody><body><joint name='s' type='slide' axis='1 0 0'"
        " limited='true' range='-1 1'/><geom size='1' mass='2'/></body></worldbody><actuator><motor joint='s'"
        " ctrlrange='-1 1'/></actuator></mujoco>"
    )
    words = dict(task="mjcf", mjcf=str(file), prior=str(file), dt="0.1", horizon="4", cost="tests.probes:cart")
    task = tasks.of_config(config_io.parse(words))
    x, u = jnp.array([0.1, 0.2]), jnp.array([0.5])
    own = lambda x, u: task.plant.observe(task.plant.step(task.plant.state_from_observation(x), u))  # noqa: E731
    np.testing.assert_allclose(task.prior(x, u), own(x, u), rtol=1e-6)
    slopes = jax.jit(jax.jacrev(task.prior, (0, 1)))(x, u)
    np.testing.assert_allclose(slopes[0], [[1, 0.1], [0, 1]], atol=1e-5)
    np.testing.assert_allclose(slopes[1], [[0.5 * 0.05**2 * 3], [0.05]], atol=1e-5)


# env_args


def test_a_cart_pole_of_other_constants():
    mine, theirs = tasks.of_config(parse(env_args__pole_mass="0.35")), cartpole(pole_mass=0.35)
    assert mine.plant.model.body_mass.tolist() == theirs.model.body_mass.tolist()
    with pytest.raises(ConfigError, match=r"env_args.pole_mas is no constant of the plant; did you mean 'pole_mass'"):
        tasks.of_config(parse(env_args__pole_mas="0.35"))
    with pytest.raises(ConfigError, match=r"env_args.pole_mass=light is not a number"):
        tasks.of_config(parse(env_args__pole_mass="light"))


# init=


@pytest.fixture(scope="module")
def simulator(tmp_path_factory):
    """A run in the simulator, of three trials, of which the third is best."""
    return a_run(tmp_path_factory.mktemp("runs") / "simulator", trials=3)


def test_words_of_a_beginning_leave_out_random_episodes(simulator):
    assert parse().explore.trials == 1
    assert (first_search(parse()), begins_with(parse(), "policy")) == (1, False)
    config = parse(init=str(simulator))
    assert (config.explore.trials, first_search(config), begins_with(config, "policy")) == (0, 1, True)
    assert parse(init=str(simulator), explore__trials="2").explore.trials == 2
    only = parse(init=str(simulator), init_parts="[model]")
    assert (only.explore.trials, begins_with(only, "policy")) == (1, False)
    simulated = parse(prior="benchmarks.robot.cartpole_by_hand:low")
    assert (simulated.explore.trials, first_search(simulated)) == (0, 0)


def test_what_a_run_begins_with_is_said_and_copied(simulator, tmp_path):
    config = parse(init=f"{simulator}@2", trials="3")
    task = tasks.of_config(config)
    (note,) = begin.checked(config, task)
    assert "begins with the policy of trial 2 of cartpole; no episode is random (explore.trials=0)" in note
    (tmp_path / "new").mkdir()
    begin.copy(config, tmp_path / "new")
    begin.copy(config, tmp_path / "new")  # of a command that was killed before it began
    old = restore.restored(simulator, 2)[2]
    fresh = jax.tree.map(lambda leaf: leaf[None], jax.jit(build(config).init)(jax.random.key(5)))
    for run in (tmp_path / "new", None):
        states = begin.begun(fresh, config, run)
        assert same(states.policy.params, jax.tree.map(lambda leaf: leaf[None], old.policy.params))
        assert same(
            (states.model, states.data, states.policy.optimizer), (fresh.model, fresh.data, fresh.policy.optimizer)
        )
    both = begin.taken_over(fresh, old, ("policy", "model"))
    assert same(both.model.params, jax.tree.map(lambda leaf: leaf[None], old.model.params))
    assert begin.source(str(simulator)) == (simulator, restore.best(simulator))


def test_a_policy_that_sees_something_else_is_no_beginning(tmp_path):
    """Also where it is as many numbers: a force of before is no goal. What a user calls his states is of no matter."""
    limited = a_run(tmp_path / "limited", control_rate="50", **NETWORK)
    words = dict(cost=lambda x, goal: x[0] ** 2 + goal[0], goal_low="[-1]", goal_high="[1]", **NETWORK)
    with pytest.raises(
        ConfigError,
        match=r"sees .*force \[N\] 1 before, and here .*goal 0; that run has control_rate=\[50\]"
        r" and goal_low=\[\] and goal_high=\[\]: give",
    ):
        check.report(parse(init=str(limited), **words))
    for given in (
        dict(control_rate="50"),
        dict(history="3"),
        {"sensors.measured": "[0,3]", "sensors.velocity": "filter"},
    ):
        task = build(parse(**NETWORK, **given)).task
        names = {name: f"{name} renamed" for name in (*task.state_names, *task.control_names)}
        renamed = tasks.of_config(parse(**NETWORK, **given))._replace(
            state_names=tuple(map(names.get, task.state_names)), control_names=tuple(map(names.get, task.control_names))
        )
        other = remembering(parse(**NETWORK, **given), renamed)
        assert other.memory.shown != task.memory.shown
        assert memory.seen_kinds(other) == memory.seen_kinds(task)
        assert len({*memory.seen_kinds(task)}) == len(memory.seen_names(task))


def test_a_model_of_a_number_that_nobody_said_begins_with_one_of_that_number(tmp_path):
    null = {"model.ensemble_size": "null", "model.kl_weight": "null"} | NETWORK
    old = a_run(tmp_path / "old", trials=1, **null)
    number = null | {"model.ensemble_size": "1", "model.kl_weight": "0.1"}

    def notes(words):
        config = parse(init=str(old), init_parts="[model]", **words)
        return begin.checked(config, tasks.of_config(config))

    for words in (null, number):
        assert "begins with the model of trial 1" in notes(words)[0]
    with pytest.raises(ConfigError, match=r"has model.ensemble_size=1, and this run 2; give model.ensemble_size=1"):
        notes(number | {"model.ensemble_size": "2"})


def said(words):
    config = config_io.parse(words)
    return begin.checked(config, tasks.of_config(config))


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (dict(init="better"), "init=better is no run; search.init=better is what a search starts from"),
        (dict(init="nowhere"), "init=nowhere: nowhere is not a run"),
        (dict(init="RUN@first"), "names no trial: expected a number, best or last after @"),
        (dict(init="RUN@9"), "has no checkpoint of trial=9; choose from 1, 2, 3"),
        (dict(init="RUN", init_parts="[cost]"), "init_parts=cost is not a choice; choices: policy, model, data"),
        (dict(init="RUN", policy__hidden="[4]"), "has policy.hidden=[3], and this run [4]; give policy.hidden=[3]"),
        (dict(init="RUN", policy="rbf"), "has policy.kind=mlp, and this run rbf; give policy=mlp"),
        (dict(init="RUN", init_parts="[model]", model="log_normal"), "has model.kind=lagrangian, and this run bnn"),
        (dict(init="RUN", task="double_cartpole"), "is of cartpole with 4 states, and double_cartpole has 6"),
    ],
)
def test_a_beginning_that_does_not_suit_is_one_line(words, part, simulator):
    words = words | {"init": words["init"].replace("RUN", str(simulator))}
    given = {name: value for name, value in TINY.items() if name not in ("policy.hidden",) or "policy" not in words}
    words = given | SMALL | {name.replace("__", "."): value for name, value in words.items()}
    with pytest.raises(ConfigError) as error:
        said(words)
    assert part in told(error)


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (dict(init="nowhere"), "init=nowhere: nowhere is not a run"),
        (dict(init="RUN", policy__hidden="[4]"), "has policy.hidden=[3], and this run [4]; give policy.hidden=[3]"),
        (dict(init="RUN", sensors__delay="1"), "before; that run has sensors.delay=0: give both runs the same"),
        (
            dict(init="RUN", control_rate="100", sensors__delay="1"),
            "; that run has sensors.delay=0 and control_rate=[]: give both runs the same",
        ),
        (dict(init="RUN", history="2", search__particles="12"), "; that run has history=1: give both runs the same"),
        (dict(prior="nowhere.xml", model="log_normal"), "there is no such file"),
        (dict(prior="arm.xm", model="log_normal"), "prior=arm.xm is no simulator: expected module:function, as sim"),
        (dict(observe="[qpos.0]"), "observe=[qpos.0] is of an MJCF file: it needs task=mjcf, or prior=FILE.xml"),
        (dict(init="RUN"), ""),
    ],
)
def test_a_check_says_of_a_beginning_what_training_does(words, part, simulator):
    config = parse(**{name: text.replace("RUN", str(simulator)) for name, text in words.items()})
    if part:
        with pytest.raises(ConfigError) as error:
            check.report(config)
        assert part in told(error)
    else:
        assert any("begins with the policy of trial" in line for line in check.report(config))


def test_angles_and_periods_of_another_task_are_told(simulator):
    config = parse(init=str(simulator))
    task = tasks.of_config(config)
    with pytest.raises(ConfigError, match=r"of cartpole with angles=\[3\], and cartpole has angles=\[\]"):
        begin.checked(config, task._replace(angles=()))
    notes = begin.checked(config, task._replace(dt=0.2, control_high=task.control_high / 2))
    assert any("dt of cartpole is 0.1, here 0.2" in note for note in notes)
    assert any("control_high of cartpole is [10], here [5]" in note or "[10.0], here [5.0]" in note for note in notes)


def test_a_beginning_has_states_in_the_same_order(simulator):
    """Numbers and angles are the same where position and speed are exchanged, and a policy takes one for the other."""
    config = parse(init=str(simulator))
    task = tasks.of_config(config)
    x, v, *others = task.state_names
    for exchanged in ((v, x, *others), tuple(name.partition(" [")[0] for name in (v, x, *others))):
        with pytest.raises(ConfigError, match=r"is of cartpole with x \[m\], .*, and cartpole has .*the same order"):
            begin.checked(config, task._replace(state_names=exchanged))
    renamed = begin.checked(config, task._replace(control_names=("push",)))
    assert renamed[-1] == f"cartpole has {task.control_names[0]}, here that is push"
    for nameless in (("x0", "rate of x0", "x2", "atan2(x4, x3)"), ("qpos.0", "qvel.0", "qpos.1", "qvel.1")):
        assert len(begin.checked(config, task._replace(state_names=nameless, control_names=("u0",)))) == 1


@pytest.mark.parametrize(
    ("parts", "said"),
    [
        ("[policy,data]", "begins with the policy of trial 3 and all episodes of cartpole; no episode is random"),
        ("[data]", "begins with all episodes of cartpole; no episode is random (explore.trials=1)"),
        ("[policy]", "begins with the policy of trial 3 of cartpole; no episode is random"),
    ],
)
def test_a_check_counts_the_episodes_that_are_taken_over(parts, said, simulator):
    """Where the policy is not taken over another one may see other things."""
    wider = {"policy__hidden": "[4]"} if "policy" not in parts else {}
    told = "\n".join(check.report(parse(init=f"{simulator}@3", init_parts=parts, **wider)))
    assert said in told
    assert ("logs of 7.5 s from 3 files are the first data" in told) == ("data" in parts)


@pytest.mark.slow
def test_a_run_learns_from_the_episodes_that_it_takes_over(simulator, tmp_path):
    """They are copied: its data do not need the other run."""
    config = parse(init=str(simulator), init_parts="[policy,data]", preset="cartpole_network", trials="1")
    state = train(config, tmp_path / "run")
    (trial,) = store.trials(tmp_path / "run")
    assert (trial["logs"], trial["plant_seconds"], trial["random"]) == (3, 0.0, False)
    theirs = [store.load_episode(simulator, number).trajectory for number in (1, 2, 3)]
    np.testing.assert_array_equal(state.data.x[:75], np.concatenate([one.x[:-1] for one in theirs]))
    assert len(store.numbered(tmp_path / "run" / logged.FOLDER, ".npz")) == 3


@pytest.mark.campaign
def test_a_run_that_began_with_another_goes_on_without_it(simulator, tmp_path):
    """Its first episode is by the old policy, which is trial 0 of it; killed after that, it ends as in one piece."""
    old = shutil.copytree(simulator, tmp_path / "old")
    config = parse(init=str(old), preset="cartpole_network", trials="1")
    whole = train(config, tmp_path / "whole")
    row = store.trials(tmp_path / "whole")[0]
    assert (row["random"], row["policy"]) == (False, 0)
    assert restore.best(tmp_path / "whole") in (0, 1)
    first = restore.restored(tmp_path / "whole", 0)[2]
    assert same(first.policy.params, restore.restored(simulator, "best")[2].policy.params)
    cut = shutil.copytree(tmp_path / "whole", tmp_path / "cut")
    shutil.rmtree(cut / "checkpoints")
    (cut / "trials.jsonl").unlink()
    shutil.rmtree(old)
    assert checkpoint.fingerprint(train(config, cut, resume=True)) == checkpoint.fingerprint(whole)


def test_a_run_with_a_simulator_is_used_without_it(tmp_path, monkeypatch):
    """The controller and a file need its policy alone; what would imagine says that the simulator is missing."""
    module = ModuleType("theirs")
    module.step = lambda x, u: x
    monkeypatch.setitem(__import__("sys").modules, "theirs", module)
    words = dict(prior="theirs:step", model="log_normal", model__hidden="[4]", trials="1", eval_episodes="0")
    train(parse(**words, **PLAIN_SEARCH), tmp_path / "run")
    monkeypatch.delitem(__import__("sys").modules, "theirs")
    assert np.isfinite(pg.controller(tmp_path / "run")(np.zeros(4))).all()
    _, experiment, state = restore.restored(tmp_path / "run")
    with pytest.raises(RunError, match="imagines with its prior=theirs:step, which is opened with its plant"):
        experiment.imagine(state)


def test_the_goals_of_episodes_that_are_taken_over_are_kept(tmp_path):
    """For those of logs, which do not tell theirs, one is drawn, and a note says so."""
    config = replace(parse(trials="3"), cost=lambda x, goal: jnp.abs(x[0] - goal[0]))
    experiment = build(replace(config, goal_low=(-0.3,), goal_high=(0.3,)))
    params = jax.jit(lambda key: experiment.init(key).policy.params)(jax.random.key(0))  # and no model
    task, goal = experiment.task, experiment.task.memory.names.index("goal 0")
    for number in (1, 2):
        ran = jax.jit(experiment.episode)(jax.random.key(number), params, False)
        arrays = store.arrays_of("cartpole", number, ran, task, policy=0, ended="horizon")
        np.savez(tmp_path / f"{number}.npz", **arrays)
        ((again, *_),), notes = read([str(tmp_path / f"{number}.npz")], task)
        assert not [note for note in notes if "goals" in note]
        np.testing.assert_allclose(again.memory[goal], ran.memory[goal])
        np.testing.assert_allclose(again.cost, ran.cost, atol=0.1)  # of measured states, and of true ones
    np.savez(tmp_path / "log.npz", **{name: arrays[name] for name in ("x", "u", "dt")})
    ((other, *_),), notes = read([str(tmp_path / "log.npz")], task)
    assert other.memory[goal] != pytest.approx(float(ran.memory[goal]))
    assert [note for note in notes if "it does not tell the goals of its episodes" in note]
