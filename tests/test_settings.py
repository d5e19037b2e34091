"""The command line's words: every public spelling means what it says, and a wrong one ends in one useful line."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import pegasus_jax as pg
from pegasus_jax import config_used
from pegasus_jax.assembly.experiments import compose
from pegasus_jax.checks import ConfigError, shown
from pegasus_jax.config import BNN, KINDS, MLP, RBF, Analytic, Config, Lagrangian, Period, Search
from pegasus_jax.runs import config_io
from probes import cart


def parse(*words):
    """The config of these words, with the general model where they name none."""
    _, rest = config_io.split(words, ("out", "resume"))
    return config_io.parse({"model": "log_normal", **rest}, options=("out", "resume"))


# What the cart-pole's words begin with: all defaults but those of its search.
CARTPOLE = Config(search=Search(standardized_noise=True, refine_fraction=0.5))


def value(chosen, key):
    return config_io.leaves(chosen)[key]


# The spellings of the issue and of the help text


SPELLINGS = [
    ("task=cartpole", "task", "cartpole"),
    ("policy.hidden=[50,50]", "policy.hidden", (50, 50)),
    ("policy.hidden=[ 50, 60 ]", "policy.hidden", (50, 60)),
    ("policy.hidden=[7]", "policy.hidden", (7,)),
    ("legs=2", "legs", 2),  # six change more, see below
    ("env=Pendulum-v1", "env", "Pendulum-v1"),
    ("cost=mymodule:cost", "cost", "mymodule:cost"),
    ("angles=[0,2]", "angles", (0, 2)),
    ("horizon=40", "horizon", 40),
    ("seed=3", "seed", 3),
    ("seed=4294967295", "seed", 2**32 - 1),
    ("trials=10", "trials", 10),
    ("model.dropout=log_normal", "model.dropout", "log_normal"),
    ("model.dropout=binary", "model.dropout", "binary"),
    ("model.dropout=none", "model.dropout", "none"),
    ("model.kl_weight=.2", "model.kl_weight", 0.2),
    ("model.log_z_min=-4", "model.log_z_min", -4.0),
    ("model.heteroscedastic=false", "model.heteroscedastic", False),
    ("policy.dropout=.1", "policy.dropout", 0.1),
    ("policy.dropout=0", "policy.dropout", 0.0),
    ("policy.squash=sine", "policy.squash", "sine"),
    ("fit.steps=500", "fit.steps", 500),
    ("fit.batch_size=64", "fit.batch_size", 64),
    ("fit.learning_rate=1e-3", "fit.learning_rate", 1e-3),
    ("search.steps=200", "search.steps", 200),
    ("search.particles=50", "search.particles", 50),
    ("search.learning_rate=.001", "search.learning_rate", 1e-3),
    ("search.grad_clip=1", "search.grad_clip", 1.0),
    ("search.grad_clip=0.5", "search.grad_clip", 0.5),
    ("search.grad_clip=null", "search.grad_clip", None),
    ("search.matching=never", "search.matching", "never"),
    ("search.cost_width_start=2", "search.cost_width_start", 2.0),
    ("search.cost_width_start=null", "search.cost_width_start", None),
    ("search.standardized_noise=true", "search.standardized_noise", True),
    ("search.cost_estimator=particles", "search.cost_estimator", "particles"),
    ("search.init=fresh", "search.init", "fresh"),
    ("search.observation_noise=plant", "search.observation_noise", "plant"),
    ("x64=true", "x64", True),
    ("search.period.start=5", "search.period.start", 5),
    ("search.period.dynamics=1", "search.period.dynamics", 1),
    ("search.period.policy=2", "search.period.policy", 2),
    ("search.period.sensor=3", "search.period.sensor", 3),
    ("search.period.match=500", "search.period.match", 500),
    ("explore.trials=2", "explore.trials", 2),
    ("explore.kind=walk", "explore.kind", "walk"),
]


@pytest.mark.parametrize(("word", "key", "expected"), SPELLINGS)
def test_a_setting_changes_itself_and_nothing_else(word, key, expected):
    users = config_used.used_by().get(key, ("cartpole",))
    chosen, default = (config_io.leaves(parse(f"task={users[0]}", *words)) for words in ([word], []))
    assert chosen[key] == expected
    assert type(chosen[key]) is type(expected)
    assert {k: v for k, v in chosen.items() if k != key} == {k: v for k, v in default.items() if k != key}


def test_no_word_gives_the_defaults():
    assert parse() == parse("task=cartpole", "algorithm=pegasus") == CARTPOLE


def test_a_tasks_own_model_gives_way_to_a_named_model_and_to_the_papers_algorithms():
    own = config_io.parse({})
    assert own.model == Lagrangian(ensemble_size=1, substeps=1)
    named = config_io.parse({"task": "cartpole", "model": "lagrangian", "algorithm": "pegasus"})
    assert own == named
    network = config_io.parse({"task": "cartpole", "model": "log_normal"})
    assert network.model == BNN()
    assert network.search == CARTPOLE.search
    assert own.search == dataclasses.replace(CARTPOLE.search, particles=50, learning_rate=3e-3, init="raced")
    assert (own.policy, network.policy) == (MLP(hidden=(64, 64)), MLP())
    for words in ({"algorithm": "paper"}, {"algorithm": "deep_pilco"}):
        assert config_io.parse(words) == config_io.parse({"model": "log_normal", **words})


def test_what_suits_a_task_best_is_the_least_of_what_is_said():
    """Where another model is named settings chosen for the task do not count; a policy's own and words do."""
    own, named = (config_io.parse({"task": "double_cartpole"} | model) for model in ({}, {"model": "log_normal"}))
    assert own == config_io.parse({"task": "double_cartpole", "model": "lagrangian"})
    assert (own.model.substeps, own.search.anneal_trials, own.search.observation_noise, own.explore.trials) == (
        4,
        14,
        "plant",
        4,
    )
    assert (own.model.hidden, own.policy.hidden, own.policy.dropout) == ((32, 32), (50,) * 4, 0)
    assert (named.model.hidden, named.search.anneal_trials, named.explore.trials) == ((200,) * 4, 1, 2)
    changed = config_io.parse({"task": "double_cartpole", "policy": "dropout_mlp", "search.anneal_trials": "3"})
    assert (changed.policy.dropout, changed.search.anneal_trials, changed.model) == (0.1, 3, own.model)
    assert config_io.parse({"task": "double_cartpole", "policy": "rbf"}).policy == RBF()


def test_every_setting_has_a_spelling():
    """Its own default, written as the help text writes it, changes nothing; and the help names each."""
    spelled = {shown for shown, _ in config_io.described(CARTPOLE).values()}
    for key, default in config_io.leaves(CARTPOLE).items():
        if key not in config_used.used_by():
            assert parse(f"{key}={shown(default)}") == CARTPOLE
        if key not in ("task", *(f"{section}.kind" for section in KINDS)):
            assert f"{key}={shown(default)}" in spelled


def test_the_task_changes_only_what_the_chosen_variant_has():
    """The double cart-pole's networks are deeper; so are an ensemble's, and its members stay."""
    chosen = parse("task=double_cartpole", "model=ensemble")
    assert (chosen.model.hidden, chosen.model.ensemble_size, chosen.model.dropout) == ((200,) * 4, 5, "none")


def test_the_iterations_of_lbfgs_are_not_those_a_task_gives_its_minibatches():
    assert parse("task=swimmer_knife_edge", "legs=6", "model=log_normal").fit.steps == 4000
    assert parse("task=swimmer_knife_edge", "legs=6", "model=ssgp").fit.steps == 300


@pytest.mark.parametrize("section", KINDS)
def test_the_kind_of_a_section_is_not_a_setting(section):
    with pytest.raises(ConfigError, match=rf"{section}\.kind=other.*(model|policy|algorithm)="):
        parse(f"{section}.kind=other")


@pytest.mark.parametrize("section", KINDS)
def test_a_stored_kind_that_is_unknown_is_named(section, tmp_path):
    path = tmp_path / "config.yaml"
    config_io.save(Config(), path)
    path.write_text(path.read_text().replace(f"{section}.kind: ", f"{section}.kind: un"), encoding="utf-8")
    with pytest.raises(ConfigError, match=rf"{section}\.kind=un.*is unknown"):
        config_io.load(path)


def test_a_variant_brings_defaults_that_single_settings_change():
    """In any order on the line."""
    words = (
        "model=binary",
        "algorithm=deep_pilco",
        "search.grad_clip=1",
        "model.weight_decay=.3",
        "search.period.match=0",
    )
    for order in (words, words[::-1]):
        chosen = parse(*order)
        assert chosen.model == BNN(dropout="binary", weight_decay=0.3, activation="relu", kl_weight=1.0)
        plain = Search(cost_estimator="particles", cost_width_start=1.0, particles=10, grad_clip=1.0, init="previous")
        assert chosen.search == dataclasses.replace(plain, period=Period(1, 1, 1, 1, 0))


@pytest.mark.parametrize("words", [("task=gym", "env=Pendulum-v1"), ("task=mjcf", "mjcf=arm.xml")])
def test_a_cost_of_ones_own_is_matched_and_as_wide_as_its_starts_need(words):
    """docs/decisions.md 0018 and 0033; the paper's search follows each particle's, on every task."""
    chosen = parse(*words, "cost=mine:cost", "dt=0.1", "horizon=9").search
    assert (chosen.cost_estimator, chosen.cost_width_start, chosen.standardized_noise, chosen.refine_fraction) == (
        "gaussian",
        None,
        True,
        0.5,
    )
    assert (chosen.matching, chosen.visited_starts) == ("narrow", 0.5)  # docs/decisions.md 0023 and 0024
    assert (
        parse(*words, "cost=mine:cost", "dt=0.1", "horizon=9", "algorithm=paper").search.cost_estimator == "particles"
    )
    assert parse(*words, "cost=mine:cost", "dt=0.1", "horizon=9", "algorithm=paper").search.matching == "always"


def test_the_paper_is_a_variant():
    """Alg. 3 and docs/reference.md 1.2, 4.7, 5.2, 5.5: all draws but the start held for the whole search."""
    chosen = parse("algorithm=paper")
    assert chosen.search.period == Period(start=1, dynamics=0, policy=0, sensor=0, match=0)
    assert (chosen.model.activation, chosen.model.kl_weight, chosen.fit.learning_rate) == ("relu", 1.0, 1e-4)
    assert (chosen.search.grad_clip, chosen.search.particles) == (1, 100)
    assert (chosen.search.cost_estimator, chosen.search.cost_width_start) == ("particles", 1)
    assert not chosen.search.reset_optimizer
    assert chosen.search.init == "previous"


def test_pilco_brings_its_own_search_and_precision():
    """Whatever the task says of another algorithm's search, and in any order on the line."""
    for words in (("algorithm=pilco", "task=swimmer_belly_up"), ("task=swimmer_belly_up", "algorithm=pilco")):
        chosen = parse(*words)
        assert isinstance(chosen.search, Analytic)
        assert chosen.search.steps == Analytic.steps
        assert chosen.x64
    assert parse("policy=rbf").policy == RBF(num_centers=30, squash="sine")
    assert parse("policy=rbf100").policy == RBF(num_centers=100)


def test_options_are_kept_from_the_settings():
    known, rest = config_io.split(["out=runs/a=b", "seed=3", "resume="], ("out", "resume"))
    assert known == {"out": "runs/a=b", "resume": ""}
    assert rest == {"seed": "3"}


# What cannot be. (words, parts of the message)

WRONG = [
    # not of the form
    (["cartpole"], ["'cartpole' is not of the form key=value; did you mean 'task=cartpole'? --help=all"]),
    (["cartpol"], ["'cartpol' is not of the form key=value; did you mean 'task=cartpole'?"]),
    (["gp"], ["'gp' is not of the form key=value; did you mean 'model=gp'?"]),
    (["--halp"], ["'--halp' is not of the form key=value; did you mean 'help'?"]),
    (["--trials"], ["'--trials' is not of the form key=value", "did you mean 'trials'?"]),
    (["=3"], ["'=3' is not of the form"]),
    # unknown variants
    (["task=cartpol"], ["task=cartpol is unknown", "did you mean 'cartpole'?"]),
    (["model=lognormal"], ["model=lognormal is unknown", "did you mean 'log_normal'?"]),
    (["policy=drop_mlp"], ["did you mean 'dropout_mlp'?", "choices: mlp, dropout_mlp"]),
    (["algorithm=pilko"], ["algorithm=pilko is unknown", "did you mean 'pilco'?"]),
    (["task="], ["task= is unknown", "cartpole"]),
    # unknown keys
    (["polcy=mlp"], ["polcy is not a setting", "did you mean 'policy'?"]),
    (["policy.hiden=[50]"], ["did you mean 'policy.hidden'?"]),
    (["search.perod.start=1"], ["did you mean 'search.period.start'?"]),
    (["seeds=3"], ["did you mean 'seed'?"]),
    (["search.period=1"], ["search.period is not a setting"]),
    (["model.hidden.x=1"], ["model.hidden.x is not a setting", "did you mean 'model.hidden'?"]),
    (["ouut=runs/a"], ["did you mean 'out'?"]),
    (["zzzzzz=1"], ["zzzzzz is not a setting", "--help=all lists all settings"]),
    # wrong types
    (["trials=many"], ["trials=many is not a whole number", "for example trials=15"]),
    (["trials=2.5"], ["trials=2.5 is not a whole number"]),
    (["trials="], ["trials=", "is not a whole number"]),
    (["trials=[3]"], ["is not a whole number"]),
    (["trials=true"], ["trials=true is not a whole number"]),
    (["fit.learning_rate=fast"], ["fit.learning_rate=fast is not a number"]),
    (["model.kl_weight={a: 1}"], ["model.kl_weight=", "is not a number"]),
    (["search.grad_clip=none"], ["search.grad_clip=none is not a number or null"]),
    (["search.reset_optimizer=maybe"], ["search.reset_optimizer=maybe is not true or false"]),
    (["policy.hidden=50"], ["policy.hidden=50 is not a list of whole numbers", "for example policy.hidden=[50]"]),
    (["policy.hidden=[50,wide]"], ["is not a list of whole numbers", "for example policy.hidden=[200,200]"]),
    (["task=gym", "angles=2"], ["angles=2 is not a list of whole numbers", "for example angles=[2]"]),
    (["task=gym", "angles=[pitch]"], ["places in the observation counted from 0; for example angles=[0]"]),
    (["task=gym", "start_mean=0.3"], ["start_mean=0.3 is not a list of numbers; for example start_mean=[0.3]"]),
    (["task=gym", "start_std=[0.5]"], ["start_std=[0.5] needs start_mean="]),
    (["task=gym", "start_std=[0.1]"], ["start_std=[0.1] needs start_mean="]),  # the default, said
    (["policy.hidden=[50.5]"], ["is not a list of whole numbers"]),
    (["policy.hidden=[50,"], ["policy.hidden=[50, cannot be read"]),
    (["policy.hidden={a: 1}"], ["policy.hidden=", "is not a list of whole numbers"]),
    (["policy.hidden=null"], ["is not a list of whole numbers"]),
    (["model.dropout=[1]"], ["model.dropout=[1] is not a word"]),
    (["model.dropout=null"], ["model.dropout=null is not a word"]),
    (["seed=${trials}"], ["seed=", "is not a value but a reference"]),
    (["task=gym", "angles=[[1]]"], ["angles=[[1]] is not a list of whole numbers"]),
    (["task=mjcf", "observe=[[qpos.0]]"], ["observe=[[qpos.0]] is not a list of words"]),
    (["policy.input_units=[[1]]"], ["policy.input_units=[[1]] is not a list of numbers or null"]),
    # words that the task does not use
    (["horizon=40"], ["horizon=40 is of no use with task=cartpole", "task=gym"]),
    (["task=cartpole", "legs=2"], ["legs=2 is of no use with task=cartpole", "task=swimmer_"]),
    (["task=gym", "mjcf=arm.xml"], ["mjcf=arm.xml is of no use with task=gym", "is task=mjcf"]),
    (["task=mjcf", "env=Pendulum-v1"], ["env=Pendulum-v1 is of no use with task=mjcf", "is task=gym"]),
    (["task=swimmer_corkscrew", "start_mean=[1]"], ["start_mean=[1] is of no use with task=swimmer_corkscrew"]),
    # absurd sizes
    (["fit.steps=100000000000000000000"], ["fit.steps=100000000000000000000 is out of range", "nearest is 10000000"]),
    (["search.steps=100000000000000000000"], ["the nearest is 10000000"]),
    (["search.particles=100000000000000000000"], ["the nearest is 1000000"]),
    (["eval_episodes=100000000000000000000"], ["the nearest is 100000"]),
    (["model.ensemble_size=100000000000000000000"], ["the nearest is 1000"]),
    (["model.hidden=[100000000000000000000]"], ["the nearest is 100000"]),
    (["policy=rbf", "policy.num_centers=100000000000000000000"], ["the nearest is 100000"]),
    (["explore.trials=100000000000000000000"], ["the nearest is 10000"]),
    (["task=gym", "horizon=100000", "trials=9999"], ["trials=9999 of horizon=100000", "the nearest is trials=100"]),
    # lists
    (["task=gym", "angles=[0,0]"], ["angles=[0,0] names 0 twice", "the nearest is [0]"]),
    (["task=gym", "rates=[1,0,1]"], ["rates=[1,0,1] names 1 twice", "the nearest is [1,0]"]),
    (["task=mjcf", "observe=[qpos.0,qpos.0]"], ["names qpos.0 twice"]),
    (["task=gym", "start_mean=[.nan,0]"], ["start_mean=nan is not a finite number"]),
    (["task=gym", "start_std=[.inf]"], ["start_std=inf is out of range"]),
    (["task=gym", "control_low=[-.inf]"], ["control_low=-inf is not a finite number"]),
    # impossible values
    (["task=swimmer_corkscrew", "legs=4"], ["legs=4 is not a choice", "choices: 2, 6"]),
    (["task=swimmer_belly_up", "legs=many"], ["legs=many is not a whole number", "for example legs=2"]),
    (["task=swimmer_knifeedge"], ["did you mean 'swimmer_knife_edge'?"]),
    (["task=gym", "horizon=0"], ["horizon=0 is out of range", "the nearest is 1"]),
    (["task=gym", "horizon=long"], ["horizon=long is not a whole number or null"]),
    (["trials=0"], ["trials=0 is out of range", "the nearest is 1"]),
    (["seed=-1"], ["seed=-1", "the nearest is 0"]),
    (["seed=99999999999"], ["seed=99999999999 ", "the nearest is 4294967295"]),
    (["policy.dropout=1.5"], ["policy.dropout=1.5 is out of range", "the nearest is 0.99"]),
    (["policy.hidden=[50,0]"], ["policy.hidden", "the nearest is 1"]),
    (["search.particles=1"], ["search.particles=1", "the nearest is 2"]),
    (["search.grad_clip=0"], ["search.grad_clip=0 is out of range", "(0, inf)"]),
    (["search.grad_clip=.inf"], ["search.grad_clip=inf is out of range"]),
    (["search.period.match=-1"], ["search.period.match=-1", "the nearest is 0"]),
    (
        ["search.cost_estimator=mached"],
        ["search.cost_estimator=mached is not a choice", "choices: gaussian, particles"],
    ),
    (["policy=rbf", "policy.num_centers=0"], ["policy.num_centers=0 is out of range", "the nearest is 1"]),
    (["policy=linear", "policy.num_centers=9"], ["policy.num_centers is not a setting here, but of policy.kind=rbf; "]),
    (["algorithm=pilco", "search.grad_clip=1"], ["search.grad_clip is not a setting"]),
    (["model.dropout=lognormal"], ["model.dropout=lognormal is not a choice", "did you mean 'log_normal'?"]),
    (["policy.squash=tan"], ["did you mean 'tanh'?", "choices: tanh, sine"]),
    (["model.log_z_min=1"], ["model.log_z_min=1 is out of range; expected a number in (-inf, 0)"]),
    (["model.log_z_min=-.inf"], ["model.log_z_min=-inf"]),
    (["fit.learning_rate=.nan"], ["fit.learning_rate=nan is out of range"]),
]


@pytest.mark.parametrize(("words", "parts"), WRONG, ids=[" ".join(words) for words, _ in WRONG])
def test_a_wrong_word_ends_in_one_line_that_helps(words, parts):
    with pytest.raises(ConfigError) as caught:
        parse(*words)
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 300
    for part in parts:
        assert part in message, message


def fate(word):
    """What a word ends in: a config, or the lines of a refusal."""
    try:
        return parse(word)
    except ConfigError as error:
        return str(error).splitlines()


@given(st.sampled_from(sorted(config_io.leaves(Config()))), st.text(max_size=12))
def test_any_text_ends_in_a_config_or_in_one_line(key, text):
    end = fate(f"{key}={text}")
    assert isinstance(end, Config) or len(end) == 1


NESTED = ["[1,[2]]", "{a: {b: 1}}", "{a: 1}", "[]", "{}", "[null]", "[true]", "???", "${x}", "!!python/none", "&a [*a]"]
NESTED += ["2026-01-01", "0x10", "1_0", "first\nsecond"]


@pytest.mark.parametrize(
    "key", ["seed", "model.hidden", "model.dropout", "model.kl_weight", "search.grad_clip", "search.reset_optimizer"]
)
@pytest.mark.parametrize("text", NESTED)
def test_any_yaml_ends_in_a_config_or_in_one_line(key, text):
    end = fate(f"{key}={text}")
    assert isinstance(end, Config) or len(end) == 1


# Settings that are each possible and not together with what the pieces can do: before anything is written, one line

TOGETHER = [
    ["model.log_z_min=-.01"],  # narrower than the least scale of its noise
    ["search.particles=2"],
    ["search.particles=2", "search.matching=never", "search.standardized_noise=true"],
    ["policy=rbf", "algorithm=pilco"],
]


@pytest.mark.parametrize("words", TOGETHER, ids=" ".join)
def test_settings_that_no_piece_can_obey_end_in_one_line_too(words):
    with pytest.raises(ConfigError) as caught:
        compose(parse(*words), cart())
    assert "\n" not in str(caught.value)
    assert words[-1].partition("=")[0].split(".")[-1] in str(caught.value) or "particles" in str(caught.value)


@pytest.mark.parametrize(
    "words", [["search.init=fresh", "search.refine_fraction=1"], ["search.refine_fraction=1", "search.init=fresh"]]
)
def test_settings_that_need_each_other_are_changed_together(words):
    """In either order; the first alone is impossible beside the paper's defaults."""
    chosen = parse("algorithm=paper", "search.init=better", *words)
    assert (chosen.search.init, chosen.search.refine_fraction) == ("fresh", 1)


@pytest.mark.parametrize("changed", [{"horizon": 8}, {"dt": 0.02}, {"success": 0.5}, {"env": "Pendulum-v1"}])
def test_a_config_from_python_is_refused_what_a_word_is(changed: dict[str, Any], tmp_path: Path) -> None:
    for use in (pg.build, lambda config: pg.train(config, out=tmp_path / "run")):
        with pytest.raises(ConfigError, match=rf"{next(iter(changed))}=.* is of no use with task=cartpole"):
            use(Config(task="cartpole", **changed))
    assert not any(tmp_path.iterdir())
