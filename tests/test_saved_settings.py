"""A run's config on disk: what is saved is loaded to the last bit, and a file that is no config says so."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pegasus_jax import config, config_models, config_plant, config_policies
from pegasus_jax.checks import ConfigError
from pegasus_jax.config import BNN, MATCHINGS, MLP, Config, Explore, Fit, Period, Search
from pegasus_jax.presets import ALGORITHMS
from pegasus_jax.runs import config_io
from pegasus_jax.tasks import TASKS
from test_settings import parse

positive = st.floats(1e-6, 1e3)
whole = partial(st.integers, max_value=10**6)
layers = st.lists(st.integers(1, 500), max_size=4).map(tuple)
configs = st.builds(
    Config,
    task=st.sampled_from(sorted(TASKS)),
    seed=st.integers(0, 2**32 - 1),
    trials=st.integers(1, 10_000),
    model=st.builds(
        BNN,
        log_z_min=st.floats(-20, -0.1),
        hidden=layers,
        dropout=st.sampled_from(config_models.DROPOUTS),
        heteroscedastic=st.booleans(),
        weight_decay=st.floats(0, 10),
        initializer=st.sampled_from(config_models.INITIALIZERS),
    ),
    policy=st.builds(
        MLP,
        hidden=layers,
        dropout=st.floats(0, 0.99),
        squash=st.sampled_from(config_policies.SQUASHES),
        initializer=st.sampled_from(config_models.INITIALIZERS),
    ),
    fit=st.builds(Fit, steps=whole(1), batch_size=whole(1), learning_rate=positive),
    search=st.builds(
        Search,
        steps=whole(1),
        particles=whole(2),
        learning_rate=positive,
        grad_clip=st.none() | positive,
        matching=st.sampled_from(MATCHINGS),
        standardized_noise=st.booleans(),
        cost_estimator=st.sampled_from(config.COST_ESTIMATORS),
        observation_noise=st.sampled_from(config.OBSERVATION_NOISES),
        init=st.sampled_from(config.INITS[:2]),
        reset_optimizer=st.booleans(),
        policy_noise=st.floats(0, 10),
        state_noise=st.floats(0, 10),
        period=st.builds(Period, *[whole(0)] * 5),
    ),
    explore=st.builds(Explore, trials=st.integers(0, 10**4), kind=st.sampled_from(config_plant.EXPLORATIONS)),
)


@given(chosen=configs)
def test_a_saved_config_is_loaded_to_the_last_bit(chosen, tmp_path_factory):
    path = tmp_path_factory.mktemp("config") / "config.yaml"
    config_io.save(chosen, path)
    assert config_io.load(path) == chosen


NO_CONFIGS = {
    "prose": "no config",
    "list": "[1, 2]",
    "broken": "seed: [",
    "unknown": "color: red",
    "wrong type": "seed: many",
    "impossible": "trials: 0",
    "nested": "policy.hidden: {a: 1}",
    "empty": "",  # a machine that lost power while writing
}


@pytest.mark.parametrize("name", NO_CONFIGS)
def test_a_file_that_is_no_config_says_so(name, tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(NO_CONFIGS[name], encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        config_io.load(path)
    assert len(str(caught.value).splitlines()) == 1


def test_a_missing_config_says_so(tmp_path):
    with pytest.raises(ConfigError, match=r"config\.yaml"):
        config_io.load(tmp_path / "config.yaml")


def test_a_run_from_before_a_setting_existed_goes_on_with_its_default(tmp_path):
    chosen = parse("search.steps=70", "seed=7")
    config_io.save(chosen, tmp_path / "config.yaml")
    lines = (tmp_path / "config.yaml").read_text().splitlines()
    older = [line for line in lines if "search.warm_restart" not in line and "fit.decay" not in line]
    assert len(older) == len(lines) - 2
    (tmp_path / "config.yaml").write_text("\n".join(older), encoding="utf-8")
    assert config_io.load(tmp_path / "config.yaml") == chosen


@pytest.mark.parametrize("nth", range(max(map(len, config.KINDS.values()))))
def test_a_value_that_is_a_settings_own_has_the_type_of_the_setting(nth, monkeypatch):
    """As OmegaConf would make it, which is not asked; each kind of every section has its turn."""
    kinds = {section: [*kinds.values()] for section, kinds in config.KINDS.items()}
    chosen = Config(**{section: each[nth % len(each)] for section, each in kinds.items()})
    stored = config_io.plain(chosen)
    monkeypatch.setattr(config_io, "_same", lambda value, current: False)
    converted = config_io.override(chosen, stored)
    monkeypatch.undo()
    assert repr(config_io.override(chosen, stored)) == repr(converted) == repr(chosen)


@pytest.mark.parametrize(
    ("value", "current", "expected"),
    [(1, 1, True), (1, 1.0, False), (True, 1, False), ([1], (1,), True), ([1.0], (1,), False), ([1], (1, 2), False)],
)
def test_a_number_of_another_type_is_not_the_settings_own(value, current, expected):
    assert config_io._same(value, current) is expected


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_what_was_parsed_survives_the_file(algorithm, tmp_path):
    chosen = parse(f"algorithm={algorithm}", "model=sparse", "policy=mlp", "policy.hidden=[3]", "seed=7")
    config_io.save(chosen, tmp_path / "config.yaml")
    loaded = config_io.load(tmp_path / "config.yaml")
    assert loaded == chosen
    assert hash(loaded) == hash(chosen)
    assert jax.tree.leaves(config_io.override(loaded, {"trials": 20}).trials) == [20]


def test_settings_of_numpy_are_numbers_and_lists():
    """As a sweep over an array gives them."""
    words = {
        "trials": np.int64(3),
        "search.steps": np.array(5),
        "control_rate": [np.float32(0.5)],
        "seed": jnp.int32(2),
    }
    config = config_io.override(Config(), config_io.values(words))
    assert (config.trials, config.search.steps, config.control_rate, config.seed) == (3, 5, (0.5,), 2)
    assert {type(number) for number in (config.trials, config.search.steps, config.seed)} == {int}
