"""Settings of earlier versions: a stored run is read with them, and a command takes them and says the new names."""

import re

import pytest

from pegasus_jax.checks import ConfigError, shown
from pegasus_jax.cli import main
from pegasus_jax.cli import train as cli_train
from pegasus_jax.config import Config
from pegasus_jax.runs import config_io
from pegasus_jax.runs.removed import REMOVED, RENAMED, renamed
from test_settings import parse


@pytest.mark.parametrize("key", REMOVED)
def test_a_removed_setting_is_read_at_its_old_default_and_refused_at_another_value(key, tmp_path):
    """And as a word of a command it is refused with what serves instead."""
    chosen = parse("model=gp") if key == "model.features" else parse("model=ssgp") if key == "model.points" else parse()
    path = tmp_path / "config.yaml"
    config_io.save(chosen, path)
    today, always = path.read_text(), REMOVED[key].always
    path.write_text(f"{today}{key}: {shown(always)}\n", encoding="utf-8")
    assert config_io.load(path) == chosen
    other = {bool: not always, str: "another", type(None): 3}.get(type(always), 0.25)
    path.write_text(f"{today}{key}: {shown(other)}\n", encoding="utf-8")
    with pytest.raises(ConfigError) as refused:
        config_io.load(path)
    assert f"{path}: {key}={shown(other)} was removed, only {shown(always)} is left" in str(refused.value)
    for call in (lambda: parse(f"{key}={shown(always)}"), lambda: config_io.override(chosen, {key: always})):
        with pytest.raises(ConfigError, match=rf"^{key} was removed; instead: ") as refused:
            call()
        assert len(str(refused.value).splitlines()) == 1
        named = re.findall(r"(\w+\.\w+)=", str(refused.value))
        assert {*named} <= {*config_io.leaves(Config())}, "what serves instead is there"
    assert key not in config_io.leaves(chosen)


# A setting's old name -> a value that it had, and today's words for it, the last of which is its own.
COOLED = "search.refine_fraction=0 search.decay=0.1 search.particle_grad_limit=1 search.anneal_trials=9"
OLD = {
    "precision": ("double", "x64=true"),
    "evaluation": (3, "eval_episodes=3"),
    "model.members": (2, "model.ensemble_size=2"),
    "model.low": (-3.0, "model.log_z_min=-3"),
    "model.initialiser": ("orthogonal", "model.initializer=orthogonal"),
    "policy.initialiser": ("orthogonal", "policy.initializer=orthogonal"),
    "policy.units": (7, "policy=rbf policy.num_centers=7"),
    "fit.batch": (9, "fit.batch_size=9"),
    "fit.starts": (4, "model=ssgp fit.num_starts=4"),
    "search.clip": (None, "search.grad_clip=null"),
    "search.match": (False, "search.matching=never"),
    "search.moment_matching": (False, "search.matching=never"),
    "search.balanced": (False, "search.standardized_noise=false"),
    "search.cost": ("particles", "search.cost_estimator=particles"),
    "search.refine": (0.3, "search.refine_fraction=0.3"),
    "search.widen": (3.0, "search.cost_width_start=3"),
    "search.anneal": (9, COOLED),
    "search.limit": (2.0, "search.particle_grad_limit=2"),
    "search.reheat": (0.2, f"{COOLED} search.warm_restart=0.2"),
    "search.loosen": (5.0, f"{COOLED} search.warm_restart=0.2 search.warm_limit_factor=5"),
    "search.reset": (False, "search.reset_optimizer=false"),
    "search.restart": (False, "search.init=previous"),
    "search.anew": (True, "search.init=fresh"),
    "search.starts": (2, "search.num_starts=2"),
    "search.sensors": ("known", "search.observation_noise=plant"),
}


@pytest.mark.parametrize("key", RENAMED)
def test_a_setting_with_another_name_is_read_under_its_old_one(key, tmp_path):
    """And as a word of a command it is refused, in one line with the new name."""
    (value, text), path, now = OLD[key], tmp_path / "config.yaml", RENAMED[key].key
    words = text.split()
    chosen, before = parse(*words), parse(*words[:-1])
    assert now == words[-1].partition("=")[0]
    assert config_io.leaves(chosen)[now] != config_io.leaves(before)[now]
    config_io.save(chosen, path)
    lines = [line for line in path.read_text().splitlines() if not line.startswith(f"{now}:")]
    path.write_text("\n".join([*lines, f"{key}: {shown(value)}"]), encoding="utf-8")
    assert config_io.load(path) == chosen
    for call in (lambda: parse(f"{key}={shown(value)}"), lambda: config_io.override(chosen, {key: value})):
        with pytest.raises(ConfigError, match=rf"^{key} is now called {now}") as refused:
            call()
        assert len(str(refused.value).splitlines()) == 1
    assert key not in config_io.leaves(chosen)


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize(
    ("restart", "anew", "init"), [(True, True, "fresh"), (True, False, "better"), (False, False, "previous")]
)
def test_two_settings_that_became_one_are_read_together(restart, anew, init, order):
    stored = config_io.plain(parse())
    del stored["search.init"]
    both = {"search.restart": restart, "search.anew": anew}
    made = config_io.stored_config(stored | dict([*both.items()][::order]))
    assert made == parse(f"search.init={init}")


@pytest.mark.parametrize(
    ("word", "line"),
    [
        ("search.widen=1", "search.widen is now called search.cost_width_start"),
        ("search.cost=matched", "search.cost is now called search.cost_estimator, where matched is gaussian"),
        ("precision=double", "precision is now called x64, where single is false, double is true"),
        ("search.anew=true", "search.anew is now called search.init, where true is fresh"),
    ],
)
def test_an_old_word_is_answered_with_the_new_one(word, line):
    with pytest.raises(ConfigError) as refused:
        parse(word)
    assert str(refused.value) == line


@pytest.mark.parametrize("key", RENAMED)
def test_a_command_takes_an_old_word_for_todays(key):
    value, text = OLD[key]
    *others, own = text.split()
    words, answers = renamed([*others, f"{key}={shown(value)}"])
    assert parse(*words) == parse(*others, own)
    (answer,) = answers
    assert answer.startswith(f"{key} is now called {RENAMED[key].key}")


def test_an_old_word_that_says_nothing_today_is_left_out():
    assert renamed(["search.restart=false", "search.anew=false", "seed=1"])[0] == ["search.init=previous", "seed=1"]


def test_a_command_says_the_new_name_and_goes_on(capsys):
    words = ["evaluation=0", "precision=double", "trials=0"]
    assert main._code(cli_train.train, words, "") == 2
    note, other, refused = capsys.readouterr().err.splitlines()
    assert note == "note: evaluation is now called eval_episodes"
    assert other == "note: precision is now called x64, where single is false, double is true"
    assert refused.startswith("pegasus: trials=0 ")
