"""The presets are what the command line runs; each setting is one that something needs."""

import dataclasses
import itertools
import re
import shlex
import tomllib
from pathlib import Path

import pytest

from pegasus_jax import config_used, preset
from pegasus_jax.checks import ConfigError
from pegasus_jax.config import GYM, KINDS, MJCF, TASKS, Config, uses
from pegasus_jax.presets import ALGORITHMS, DEFAULT, FOR_ANY, MODELS, NETWORKS, POLICIES, PRESETS, WORDS, own
from pegasus_jax.runs import config_io

ROOT = Path(__file__).resolve().parents[1]


def parse(text):
    return config_io.parse(config_io.split(shlex.split(text))[1])


@pytest.mark.parametrize("task", TASKS)
def test_a_tasks_preset_is_what_its_command_runs(task):
    assert preset(task) == parse(f"task={task}") == parse(f"preset={task}") == parse(f"task={task} preset={task}")
    assert preset(task).task == task


def test_the_first_preset_is_the_first_command():
    assert preset() == parse("") == preset("cartpole")


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_one_of_its_own_task_and_says_all(name):
    """Nothing that it leaves to the defaults of a class is changed by a word that names it."""
    assert parse(f"preset={name}") == PRESETS[name] == preset(name)
    assert name in FOR_ANY or name.startswith(PRESETS[name].task)
    begun = config_io.plain(PRESETS[name])
    aloud = {key: value for key, value in begun.items() if not key.endswith("kind") or key == "explore.kind"}
    assert config_io.override(PRESETS[name], aloud) == PRESETS[name]


@pytest.mark.parametrize("task", [task for task in TASKS if task.startswith("swimmer_")])
def test_legs_choose_the_swimmers_preset(task):
    assert parse(f"task={task} legs=2") == preset(task)
    assert parse(f"task={task} legs=6") == preset(own(task, 6))
    assert (preset(task).legs, preset(own(task, 6)).legs) == (2, 6)


@pytest.mark.parametrize("task", TASKS)
def test_any_task_can_begin_with_the_default(task):
    """And keeps it: a word such as model= changes a section of it, and not another preset."""
    begun = parse(f"preset=default task={task}")
    assert begun == dataclasses.replace(DEFAULT, task=task)
    mechanism = parse(f"preset=default task={task} model=lagrangian")
    assert (mechanism.policy, mechanism.search) == (DEFAULT.policy, DEFAULT.search)
    if uses(task, "legs"):
        assert parse(f"preset=default task={task} legs=6") == dataclasses.replace(begun, legs=6)


def test_plants_of_your_own_and_swimmers_begin_with_the_default():
    swimmers = [own(task, legs) for task in TASKS if task.startswith("swimmer_") for legs in (2, 6)]
    assert {dataclasses.replace(preset(name), task="", legs=2, trials=15) for name in (GYM, MJCF, *swimmers)} == {
        dataclasses.replace(DEFAULT, task="")
    }


# What the words of a command change, by section.
SECTIONS = {
    "model": {"model", "fit"},
    "policy": {"policy"},
    "algorithm": {"model", "policy", "fit", "search", "x64"},
    "effort": {"search"},
}


@pytest.mark.parametrize(("word", "name"), [(w, n) for w in SECTIONS for n in WORDS[w]])
@pytest.mark.parametrize("begin", NETWORKS)
def test_a_word_changes_its_own_sections_of_any_preset(begin, word, name):
    """And nothing else, on the command line as in Python."""
    chosen, before = preset(begin, **{word: name}), vars(preset(begin))
    assert chosen == parse(f"preset={begin} {word}={name}")
    assert {f for f in before if vars(chosen)[f] != before[f]} <= SECTIONS[word]


@pytest.mark.parametrize("task", ["cartpole", "double_cartpole", "swimmer_corkscrew"])
def test_a_named_model_and_the_papers_algorithms_begin_with_the_network(task):
    """What was tuned for the task's own model says nothing of another one; with a policy alone it stays."""
    for word in ("model=gp", "algorithm=paper", "model=ensemble algorithm=deep_pilco"):
        assert parse(f"task={task} {word}") == parse(f"preset={task}_network {word}")
    assert preset(task, model="log_normal") == preset(f"{task}_network")
    assert preset(task, policy="linear").model == preset(task, algorithm="pegasus").model == preset(task).model


def test_the_gpus_preset_is_the_double_cartpoles_with_eight_policies():
    named = "task=double_cartpole search.num_starts=8 search.particles=96 search.steps=2000 fit.steps=3000"
    assert preset("double_cartpole_gpu") == parse(named)
    assert parse("preset=double_cartpole_gpu model=log_normal") == preset("double_cartpole_network")


def test_an_effort_is_a_number_of_iterations_or_of_policies_whatever_the_plant():
    for task in ("gym", "mjcf", "cartpole", "double_cartpole", "swimmer_corkscrew"):
        usual = preset(task).search
        assert preset(task, effort="laptop").search == usual
        assert preset(task, effort="workstation").search == dataclasses.replace(usual, steps=2 * usual.steps)
        assert preset(task, effort="gpu").search == dataclasses.replace(usual, num_starts=4)
    assert preset("double_cartpole_gpu", effort="gpu") == preset("double_cartpole_gpu")  # it has more
    of_gaussians = dict(model="gp", policy="rbf", algorithm="pilco")
    assert preset("cartpole", **of_gaussians, effort="workstation").search.steps == 600


def test_single_settings_come_after_an_effort():
    assert parse("task=gym effort=workstation search.steps=30").search.steps == 30
    assert preset("cartpole", effort="gpu", settings={"search.num_starts": 3}).search.num_starts == 3


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("effort=laptops", "effort=laptops is unknown; did you mean 'laptop'?"),
        ("effort=gpu model=gp policy=rbf algorithm=pilco", "effort=gpu is policies side by side"),
        ("effort=gpu algorithm=paper", "search.num_starts=4 begins every search with fresh policies"),
        ("preset=cartpol", "preset=cartpol is unknown; did you mean 'cartpole'?"),
        ("preset=cartpole task=gym", "preset=cartpole is for task=cartpole, not task=gym; the nearest is preset=gym"),
        ("preset=swimmer_belly_up legs=6", "preset=swimmer_belly_up is for legs=2; with legs=6 leave out preset="),
        ("preset=cartpole legs=2", "legs=2 is of no use with task=cartpole"),
    ],
)
def test_words_that_contradict_a_preset_end_in_one_line(text, part):
    with pytest.raises(ConfigError) as refused:
        parse(text)
    assert part in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


def test_an_unknown_word_in_python_is_named():
    with pytest.raises(ConfigError, match=r"model=lognormal is unknown; did you mean 'log_normal'"):
        preset("cartpole", model="lognormal")


# Every setting has something that needs it


def settings():
    """Every leaf of `Config`, with those of each kind of a section: one for each name, a section's kind not counted."""
    kinds = [config_io.leaves(kind, f"{section}.") for section, of in KINDS.items() for kind in of.values()]
    every = {name: value for found in [config_io.leaves(Config()), *kinds] for name, value in found.items()}
    return {name for name in every if name == "explore.kind" or not name.endswith(".kind")}


def changed(chosen):
    """The settings of a config that are not the defaults of its kinds."""
    plain = config_io.leaves(Config(**{section: KINDS[section][getattr(chosen, section).kind] for section in KINDS}))
    return {name for name, value in config_io.leaves(chosen).items() if value != plain[name]}


def needs():
    """The settings that a preset or a word sets, a figure's file says, or a page explains by its name."""
    words = itertools.product(MODELS, POLICIES, ALGORITHMS)
    found = set().union(*map(changed, PRESETS.values()))
    found |= set().union(*(changed(preset(model=m, policy=p, algorithm=a)) for m, p, a in words))
    for path in (ROOT / "benchmarks").rglob("*.toml"):
        figure = tomllib.loads(path.read_text(encoding="utf-8"))
        found |= set(re.findall(r"([\w.]+)=", " ".join([figure.get("common", ""), *figure["variants"].values()])))
    pages = [ROOT / "README.md", *(page for page in (ROOT / "docs").glob("*.md") if page.name != "results.md")]
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    return (
        found
        | set(re.findall(r"(?<![\w./-])([a-z_]+(?:\.[a-z_]+){1,2})\b", text))
        | set(re.findall(r"(?<![\w./-])([a-z_]+)(?:=|\.\w+=)", text))
    )


def test_every_setting_is_needed_by_a_preset_a_figure_or_a_page():
    assert not settings() - needs()


def test_the_method_has_few_settings():
    """Beside those that describe a plant of your own, which `Config` has as a group and --help=all in groups."""
    plant = {*config_used.used_by()}
    assert len(settings() - plant) <= 55
    assert plant == {
        "control_rate",
        "sensors.measured",
        "sensors.delay",
        "sensors.velocity",
        "sensors.cutoff",
        "history",
        "legs",
        "env",
        "mjcf",
        "cost",
        "reference",
        "goal_low",
        "goal_high",
        "goals",
        "angles",
        "circles",
        "rates",
        "horizon",
        "dt",
        "env_args",
        "state_names",
        "control_names",
        "stop",
        "stop_cost",
        "explore.amplitude",
        "explore.policy",
        "constraint",
        "constraint_bound",
        "observe",
        "control_low",
        "control_high",
        "start_mean",
        "start_std",
        "starts",
        "success",
        "data",
        "data_columns",
        "data_control",
        "prior",
        "init",
        "init_parts",
    }
    own = [*dict.fromkeys(name.partition(".")[0] for name in config_used.used_by())]
    own = [name for name in own if name != "explore"]
    assert [field.name for field in dataclasses.fields(Config)][-len(own) :] == own


def test_a_setting_of_another_kind_of_network_is_refused():
    # It would be accepted, and change nothing.
    known = parse("task=cartpole model=log_normal model.log_z_min=-4 model.kl_weight=0.2").model
    assert (known.log_z_min, known.kl_weight) == (-4.0, 0.2)
    assert parse("task=cartpole model=concrete model.kl_weight=0.2").model.kl_weight == 0.2
    for kind, dropout, word in (
        ("binary", "binary", "model.log_z_min=-4"),
        ("ensemble", "none", "model.kl_weight=0.2"),
    ):
        told = f"{word} changes nothing with model.dropout={dropout}; it needs model.dropout=log_normal"
        with pytest.raises(ConfigError, match=re.escape(told)):
            parse(f"task=cartpole model={kind} {word}")


def test_a_need_is_told_from_none():
    assert "search.discount" not in needs() | settings()
    assert {"search.grad_clip", "fit.num_starts", "search.period.start", "model.hidden"} <= settings() & needs()
