"""Figures: every file says something that can be run, a study is run once, and verdicts follow from the numbers."""

import json
import os
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

import forked
from benchmarks import RESULTS, results_page
from benchmarks.paper import claims, comparison
from benchmarks.paper.figures import Claim, Figure, read
from pegasus_jax.assembly.experiments import build
from pegasus_jax.checks import ConfigError
from pegasus_jax.config import BNN, RBF, SSGP, Analytic, Config
from pegasus_jax.math.interquartile import interval, iqm
from pegasus_jax.runs.study import first_solved, rounded, seed_list, study
from probes import unchecked
from test_train import call

ROOT = Path(__file__).parents[1]
FILES = {path.stem: path for path in sorted(results_page.FIGURES.glob("*.toml"))}
FIGURES = {name: read(path) for name, path in FILES.items()}
TINY = """
title = "Two clips"
seeds = "3-4"
trials = 2
common = "model=deterministic policy=linear model.hidden=[4] fit.steps=2 search.steps=2 search.particles=5 \
search.matching=never search.cost_estimator=particles search.cost_width_start=1 \
search.init=previous search.refine_fraction=0"
[variants]
loose = "search.grad_clip=1"
tight = "search.grad_clip=1e-3"
[[claims]]
says = "tight is better"
lower = "tight"
than = "loose"
trials = [1, 2]
"""


def paper(*words: str, cwd: Path, **env: str) -> subprocess.CompletedProcess[str]:
    """`python -m benchmarks.paper` in a folder of a user's."""
    program = "import runpy; runpy.run_module('benchmarks.paper', run_name='__main__', alter_sys=True)"
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    env = {**os.environ, "PYTHONPATH": path, **env}
    return forked.run(program, words, cwd, env)


def write_study(folder: Path, stem: str, cost: np.ndarray, **changes: object) -> None:
    """A study's JSON with these mean costs [S, T]; a seed is solved where they are below .5."""
    cost = np.asarray(cost, float)
    fields = dict(seeds=list(range(len(cost))), plant_seconds=[2.5 * t for t in range(1, cost.shape[1] + 1)])
    fields |= dict(mean_cost=cost.tolist(), success_rate=(cost < 0.5).astype(float).tolist(), config={})
    fields |= dict(about={"command": f"made {stem}"}) | changes
    (folder / f"{stem}.json").write_text(json.dumps(fields))


def figure_of(tmp_path: Path, text: str) -> Figure:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    return read(path)


# The paper's figures


@pytest.mark.parametrize("name", FIGURES)
def test_every_variant_of_a_figure_is_an_experiment(name):
    found = comparison.configs(FIGURES[name])
    assert list(found) == list(FIGURES[name].variants)
    for config in found.values():
        assert build(config).task.name == config.task
        assert config.trials == FIGURES[name].trials
    assert len(set(found.values())) == len(found)  # something varies
    assert len(seed_list(FIGURES[name].seeds)) >= 10


def test_the_figures_vary_what_the_paper_varies():
    crn, clip = comparison.configs(FIGURES["crn"]), comparison.configs(FIGURES["clip"])
    assert {config.search.learning_rate for config in crn.values()} == {1e-4}
    assert vars(crn["fixed"].search.period) == dict(start=1, dynamics=0, policy=0, sensor=0, match=0)
    assert set(vars(crn["fresh"].search.period).values()) == {1}
    assert [config.search.grad_clip for config in clip.values()] == [None, 1000, 100, 10, 1, 0.1, 0.01, 0.001]
    rbf = comparison.configs(FIGURES["rbf"])
    assert all(isinstance(config.policy, RBF) and config.policy.num_centers == 30 for config in rbf.values())
    assert isinstance(rbf["ssgp_pilco"].model, SSGP)
    assert isinstance(rbf["ssgp_pilco"].search, Analytic)
    for name, task in (("nn", "cartpole"), ("double", "double_cartpole")):
        for label, config in comparison.configs(FIGURES[name]).items():
            model, _, policy = label.partition("-")
            assert isinstance(config.model, BNN)
            assert (config.task, config.model.dropout) == (task, model)
            assert (config.policy.dropout > 0) == (policy == "dropout_mlp")


@pytest.mark.parametrize("name", FIGURES)
def test_claims_cite_variants_and_trials_that_there_are(name):
    stems = {f"{other}-{label}" for other, figure in FIGURES.items() for label in figure.variants}
    stems |= {path.stem for path in RESULTS.glob("*.json")}
    for claim in FIGURES[name].claims:
        assert claim.trials[1] <= FIGURES[name].trials
        for side in (claim.lower, claim.than):
            assert not isinstance(side, str) or side in FIGURES[name].variants or side in stems


# A file of one's own


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("seeds =", "sedes =", "sedes is not a key of a figure; did you mean 'seeds'"),
        ("trials = 2", "trials = true", "trials=True is not a whole number"),
        ("trials = 2", "trials = 0", "trials is missing"),
        ('title = "Two clips"', "", "title is missing"),
        ('title = "Two clips"', 'title = "Two', "is not TOML"),
        ('title = "Two clips"', 'title = "a"\npicture = "curve"', "did you mean 'curves'"),
        ("loose =", '"a/b" =', "'a/b' cannot be part of a file's name"),
        ('"search.grad_clip=1"', "1", "variant loose is not a text of settings"),
        (
            "search.grad_clip=1e-3",
            "search.clop=1",
            "variant tight: search.clop is not a setting; did you mean 'search.grad_clip'",
        ),
        ("search.grad_clip=1e-3", "search.grad_clip=-1", "variant tight: search.grad_clip=-1 is out of range"),
        ("search.grad_clip=1e-3", "algorithm=pilco", "variant tight: "),
        ("policy=linear", "policy=linea", "policy=linea is unknown; did you mean 'linear'"),
        ('than = "loose"', "", "a claim has says, lower, than, trials"),
        ("trials = [1, 2]", "trials = [2, 1]", "trials=[2, 1] are not first and last"),
    ],
)
def test_a_file_that_is_wrong_is_refused_in_one_line(old, new, message, tmp_path):
    assert old in TINY
    with pytest.raises(ConfigError) as refusal:
        comparison.configs(figure_of(tmp_path, TINY.replace(old, new)))
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["mine.tom"], "mine.tom cannot be read: No such file or directory; did you mean 'mine'"),
        (["mine.toml", "variants=tigt"], "tigt is not a variant of figure mine; did you mean 'tight'"),
        (["mine.toml", "output=there"], "did you mean 'out'"),
        (["a", "b"], "name one file, not 2"),
    ],
)
def test_a_wrong_command_ends_in_one_line(words, message, tmp_path):
    (tmp_path / "mine.toml").write_text(TINY)
    done = paper(*words, cwd=tmp_path)
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["mine.toml"]  # nothing was written


def test_the_command_of_before_names_the_one_of_today(tmp_path):
    done = call("figures", "mine.toml", cwd=tmp_path)
    assert done.returncode == 2
    assert "python -m benchmarks.paper" in done.stderr
    assert done.stderr.count("\n") == 1


def test_an_environment_that_is_one_object_is_refused():
    with pytest.raises(ConfigError, match="task=gym"):
        study(Config(task="gym"), [0])


@pytest.mark.campaign
def test_the_command_runs_what_is_missing_once_and_draws(tmp_path):
    (tmp_path / "mine.toml").write_text(TINY)
    first = paper("mine.toml", "out=there", "variants=loose", cwd=tmp_path)
    assert first.returncode == 0, first.stderr
    loose, out = (tmp_path / "there" / "mine-loose.json").read_bytes(), tmp_path / "there"
    assert sorted(path.name for path in out.iterdir()) == ["mine-loose.json", "mine.png"]
    assert "not run yet" in first.stdout

    cut_short = json.loads(loose)
    del cut_short["about"]  # as a kill leaves it: written after each trial, without the last word
    (out / "mine-tight.json").write_text(json.dumps(cut_short))
    second = paper("mine.toml", "out=there", cwd=tmp_path)
    assert second.returncode == 0, second.stderr
    assert (out / "mine-loose.json").read_bytes() == loose
    tight = json.loads((out / "mine-tight.json").read_text())
    assert np.shape(tight["mean_cost"]) == np.shape(tight["objective_fresh"]) == (2, 2)
    assert tight["seeds"] == [3, 4]
    assert tight["config"]["search.grad_clip"] == 1e-3
    assert [row[0] for row in tight["calibration"]] == [None, None]  # nothing was known before the first trial
    assert all(row[1] > 0 for row in tight["calibration"])
    assert "python -m benchmarks.paper mine.toml" in tight["about"]["command"]
    assert tight["episode_cost"][0][0] == json.loads(loose)["episode_cost"][0][0]  # the same random first episode
    assert "tight is better" in second.stdout

    both = {path: path.read_bytes() for path in out.glob("*.json")}
    third = paper("mine.toml", "out=there", "search.grad_clip=7", cwd=tmp_path)
    assert third.returncode == 0, third.stderr
    assert {path: path.read_bytes() for path in out.glob("*.json")} == both
    assert "mine-loose.json was made with search.grad_clip=1.0, not 7.0" in third.stderr
    assert (out / "mine.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.campaign
def test_the_cores_of_a_processor_share_the_seeds_of_a_study(tmp_path):
    """The command makes a device of each of two cores; here there is one. The numbers are those of one program."""
    figure = figure_of(tmp_path, TINY)
    command = paper("mine.toml", "out=there", "variants=loose", cwd=tmp_path, JAX_NUM_CPU_DEVICES="2")
    assert command.returncode == 0, command.stderr
    shared = json.loads((tmp_path / "there" / "mine-loose.json").read_text())
    assert len(shared["about"]["devices"]) == 2
    alone = unchecked(study)(comparison.configs(figure)["loose"], [3, 4])
    for name in ("mean_cost", "episode_cost"):
        np.testing.assert_allclose(shared[name], alone[name], atol=5e-3)


# What comes out


def test_a_stored_study_can_be_read():
    shown = results_page.shown(results_page.FIGURES, RESULTS)
    for stem in (Path(name).stem for name in shown if name.endswith(".json")):
        result = comparison.stored(RESULTS, stem)
        assert result is not None
        assert claims.row(stem, result)[1] == str(len(result["seeds"]))


@pytest.mark.parametrize("picture", ["curves", "area"])
def test_studies_of_different_lengths_are_drawn_together(picture, tmp_path):
    figure = figure_of(tmp_path, TINY.replace("trials = 2", f'trials = 2\npicture = "{picture}"'))
    noise = np.random.default_rng(0).uniform(size=(10, 6))
    write_study(tmp_path, "mine-loose", noise)
    write_study(tmp_path, "mine-tight", noise[:3, :4])
    path = comparison.draw(figure, comparison.results(figure, tmp_path), tmp_path)
    assert path.read_bytes().startswith(b"\x89PNG")
    assert path.stat().st_size > 5000


def test_verdicts_follow_from_the_numbers(tmp_path):
    figure = figure_of(tmp_path, TINY)
    noise = 0.02 * np.random.default_rng(1).normal(size=(10, 4))
    write_study(tmp_path, "mine-tight", np.array([0.9, 0.4, 0.4, 0.4]) + noise)
    write_study(tmp_path, "mine-loose", np.array([0.9, 0.6, 0.6, 0.4]) + noise[::-1])

    def verdict(lower, than, *trials):
        return claims.test_claim(Claim("", lower, than, trials), figure, tmp_path).verdict

    assert verdict("tight", "loose", 1, 1) == "no difference"
    assert verdict("tight", "loose", 2, 3) == verdict("tight", "mine-loose", 1, 4) == "agrees"
    assert verdict("loose", "tight", 2, 2) == "contradicts"
    assert [verdict("tight", number, 2, 2) for number in (0.6, 0.4, 0.2)] == ["beats", "reaches", "misses"]
    assert verdict("tight", "loose", 2, 5) == verdict("tight", "other-one", 1, 1) == "not run yet"


def test_the_same_seeds_are_compared_in_pairs(tmp_path):
    """What is too small among seeds that differ so much shows from seed to seed; with other seeds it does not."""
    figure = figure_of(tmp_path, TINY)
    wide = np.linspace(0.2, 0.9, 12)[:, None] + np.zeros((12, 2))
    write_study(tmp_path, "mine-tight", wide)
    write_study(tmp_path, "mine-loose", wide + 0.02)
    assert claims.test_claim(figure.claims[0], figure, tmp_path).verdict == "agrees"
    path = tmp_path / "mine-loose.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"seeds": [*range(50, 62)]}))
    assert claims.test_claim(figure.claims[0], figure, tmp_path).verdict == "undecided"


def test_one_seed_decides_nothing(tmp_path):
    figure = figure_of(tmp_path, TINY)
    write_study(tmp_path, "mine-tight", np.full((1, 2), 0.1))
    write_study(tmp_path, "mine-loose", np.full((1, 2), 0.9))
    assert claims.test_claim(figure.claims[0], figure, tmp_path).verdict == "undecided"


def test_the_interval_covers_the_middle_and_that_of_a_difference_is_antisymmetric():
    samples = np.random.default_rng(2).normal(size=(2, 12))
    low, high = interval(samples[0])
    assert low < iqm(samples[0]) < high
    low, high = interval(*samples)
    assert low < iqm(samples[0]) - iqm(samples[1]) < high
    np.testing.assert_allclose(interval(samples[1], samples[0]), (-high, -low), atol=0.15)
    many = np.random.default_rng(3).normal(size=(12, 3))
    np.testing.assert_allclose(iqm(many), [np.sort(column)[3:-3].mean() for column in many.T])


def test_when_seeds_were_solved():
    assert claims.when([[0, 1, 1], [0, 0, 1], [0, 0.95, 0]]) == "2, from 2 to 3"
    assert claims.when([[0, 1], [0, 0], [0, 0], [0, 0]]) == "from 2 to 2, 3 never"
    assert claims.when([[0, 0]]) == "never"
    assert first_solved([0.0, 0.89, 0.9]) == 3


def test_the_page_tells_what_was_run_from_what_was_not(tmp_path):
    (tmp_path / "mine.toml").write_text(TINY)
    write_study(tmp_path, "mine-loose", np.random.default_rng(0).uniform(size=(5, 2)))
    page = results_page.figures(tmp_path, tmp_path)
    assert re.search(r"\| loose +\| 5 +\| 2 ", page)
    assert re.search(r"\| tight +\| not run yet ", page)
    for table in re.findall(r"(?:^\|.*\n)+", page, re.MULTILINE):
        assert len({line.count("|") for line in table.splitlines()}) == 1


def test_refreshing_a_page_keeps_what_a_person_wrote(tmp_path):
    page = tmp_path / "results.md"
    page.write_text(f"before\n{results_page.BEGIN}old{results_page.END}after\n")
    for _ in range(2):
        results_page.write(page, "new\n")
        assert page.read_text() == f"before\n{results_page.BEGIN}new\n{results_page.END}after\n"


def test_a_figure_that_was_drawn_is_shown(tmp_path, monkeypatch):
    figure = figure_of(tmp_path, TINY)
    write_study(tmp_path, "mine-loose", np.random.default_rng(0).uniform(size=(5, 2)))
    monkeypatch.setattr(results_page, "PAGE", tmp_path / "results.md")
    assert "![" not in results_page.section(figure, tmp_path)
    comparison.draw(figure, comparison.results(figure, tmp_path), tmp_path)
    assert "](mine.png)" in results_page.section(figure, tmp_path)


def test_unknown_numbers_are_null_and_seeds_are_lists_or_ranges():
    assert rounded([[0.123456, np.nan]]) == [[0.1235, None]]
    assert seed_list("0-3") == [0, 1, 2, 3]
    assert seed_list("5,2") == [5, 2]
    assert seed_list("7") == [7]
    with pytest.raises(ConfigError, match=r"names 0 twice; the nearest is \[0,1\]"):  # one curve would count as two
        seed_list("0,0,1")
    for text in ("9-3", "one", "", "-1", "0-99999999999999999999"):
        with pytest.raises(ConfigError, match="names no seeds"):
            seed_list(text)
