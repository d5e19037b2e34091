"""The benchmarks' own arithmetic: what is compared, what counts as slower, and that peers do the same work.

And the stored results: a page shows each of them, and README's table says what its presets learned.
"""

import dataclasses
import importlib.util
import json
import os
import re
import runpy
import shlex
import sys
from pathlib import Path

import imageio.v2 as imageio
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import benchmarks
from benchmarks import RESULTS, pictures, readme_table, results_page, searches, study
from benchmarks.paper import comparison, figures
from benchmarks.plants_suite import batched
from benchmarks.robot import costs, prior_cost
from benchmarks.speed import compare, scaling, timing
from benchmarks.speed.workloads import SIZES, flop, products, workload
from folders import a_run
from pegasus_jax import tasks
from pegasus_jax.checks import ConfigError, RunError
from pegasus_jax.cli.train import understood
from pegasus_jax.runs import config_io, machine
from pegasus_jax.runs.study import SOLVED, first_solved
from probes import unchecked

TINY = {
    "task": "cartpole",
    "model": "log_normal",
    "policy": "dropout_mlp",
    "search.particles": "20",
    "model.hidden": "[8,8]",
    "policy.hidden": "[7]",
}


@pytest.fixture(scope="module")
def work():
    return workload(TINY, horizon=3)


def run(path, about=None, **times):
    """A file of a run with these times, relative to its matrix product."""
    rows = {name: {"of_matmul": value} for name, value in times.items()}
    path.write_text(json.dumps({"rows": rows, "about": about or {}}))
    return str(path)


@pytest.mark.parametrize(
    ("new", "fails"),
    [({"a": 10, "b": 2}, 0), ({"a": 12.9, "b": 2}, 0), ({"a": 13.1, "b": 2}, 1), ({"a": 1}, 0), ({"c": 1}, 1)],
)
def test_a_run_fails_when_a_shared_row_is_slower_by_the_limit(new, fails, tmp_path, capsys):
    code = compare.main([run(tmp_path / "new.json", **new), run(tmp_path / "stored.json", a=10, b=2)])
    assert code == fails
    assert ("slower" in capsys.readouterr().out) == (new.get("a") == 13.1)


def test_runs_on_two_processors_are_compared_and_that_is_said(tmp_path, capsys):
    here = machine.about("make bench")
    assert here["processor"]
    there = {**here, "processor": "another"}
    new = run(tmp_path / "new.json", here, a=10)
    for about, said in ((here, False), (there, True), ({}, False)):
        assert compare.main([new, run(tmp_path / "stored.json", about, a=10)]) == 0
        assert (f"made on {here['processor']}" in capsys.readouterr().out) == said


def test_a_row_without_a_ratio_is_not_compared():
    assert compare.ratios({"a": {"compile_s": 9.0}}, {"a": {"compile_s": 1.0, "of_matmul": 1.0}}) == {}


def test_programs_run_in_turn_and_the_first_run_does_not_count():
    order = []
    times = timing.in_turn({name: lambda name=name: order.append(name) for name in "ab"}, repeats=3)
    assert order == list("abababab")
    assert [len(runs) for runs in times.values()] == [3, 3]
    assert timing.summary([4.0, 2.0, 9.0], per=2) == {"min_ms": 1.0, "median_ms": 2.0}


@pytest.mark.parametrize(("kind", "shape"), [("forward", (5, 3)), ("back", (5, 4)), ("weights", (4, 3))])
def test_timed_products_have_the_shapes_they_say(kind, shape):
    assert timing.product(kind, 5, 4, 3, times=2)().shape == shape


def test_the_products_of_a_step_are_those_of_its_networks(work):
    """Model 6-8-8-8, policy 5-7-1 of 20 particles over 3 steps: forward and back, and the policy's weights."""
    model, policy = 6 * 8 + 8 * 8 + 8 * 8, 5 * 7 + 7 * 1
    assert flop(work) == 2 * 20 * 3 * (2 * model + 3 * policy)
    assert products(work)["forward", 20, 8, 8] == 2 * 3


def test_a_workload_is_well_conditioned(work):
    """Objective away from saturation, gradient that float32 can compute: else neither time nor error says much."""
    value, gradient = jax.jit(jax.value_and_grad(work.objective))(
        work.state.policy.params, work.posterior, work.scenarios
    )
    assert 0.05 < value < 0.95
    assert np.isfinite(jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(gradient)])).all()
    assert set(SIZES) >= {"cart-pole", "double cart-pole"}


@pytest.mark.parametrize("name", SIZES)
def test_every_size_can_be_asked_for(name):
    """By `sizes=A,B`, and with the tasks' settings as they now are."""
    assert "," not in name
    assert config_io.parse(SIZES[name]).search.refine_fraction == 0


def test_two_processors_of_one_name_are_told_apart(monkeypatch):
    for family, said in (("25", "AMD EPYC, family 25, model 17"), ("26", "AMD EPYC, family 26, model 17")):
        known = {"flags": "sse", "model": "17", "cpu family": family, "model name": "AMD EPYC"}
        monkeypatch.setattr(machine, "cpu", lambda known=known: known)
        assert machine.about("")["processor"] == said


def test_searches_under_a_runs_model_end_with_a_cost_for_each_policy(tmp_path, capsys):
    run, out = str(a_run(tmp_path / "run", trials=2, search__refine_fraction="0.5")), tmp_path / "found.json"
    unchecked(searches.main)([run, "trial=1", "policies=2", "search.steps=2", f"out={out}"])
    first, second = json.loads(out.read_text())["imagined_cost"]
    assert 0 < first < 1
    assert 0 < second < 1
    assert first != second
    assert f"2 policies after trial 1, imagined cost: mean {(first + second) / 2:.3f}" in capsys.readouterr().out
    plain = a_run(tmp_path / "plain", trials=1, search__refine_fraction="0", search__init="previous")
    for words, said in [
        ([], "the first word is missing"),
        ([run, "policies=two"], "policies=two is not a whole number"),
        ([run, "policies=0"], "policies=0 is out of range"),
        ([run, "trial=3"], "no checkpoint of trial=3; choose from 1, 2"),
        ([run, "model.hidden=[9]"], "model.hidden is the run's own; expected settings of a search"),
        ([run, "search.stepps=2"], "did you mean 'search.steps'"),
        ([str(plain)], "expected search.refine_fraction=0.5"),
    ]:
        with pytest.raises((ConfigError, RunError), match=re.escape(said)):
            searches.main(words)


@pytest.mark.slow
def test_latency_is_measured_of_every_file(tmp_path, monkeypatch):
    """As its command does it."""
    monkeypatch.setattr(benchmarks, "RESULTS", tmp_path)
    words = ["trials=1", "horizon=20", "fit.steps=1", "search.steps=2", "policy.hidden=[4]", "eval_episodes=0"]
    monkeypatch.setattr("sys.argv", ["latency", *words])
    runpy.run_module("benchmarks.speed.latency", run_name="__main__")
    found = {path.stem: json.loads(path.read_text())["rows"] for path in tmp_path.glob("*.json")}
    assert {name: {*rows} for name, rows in found.items()} == {
        "latency": {"between steps", "controller"},
        "latency_exports": {"c", "numpy", "onnx", "stablehlo"},
    }
    assert all(0 < row["median_us"] < row["most_us"] for rows in found.values() for row in rows.values())


@pytest.mark.parametrize(
    ("line", "count"),
    [
        ("  %all-reduce.1 = f32[4,4]{1,0} all-reduce(%dot), to_apply=%add", 1),
        ("  ROOT %r = (f32[4]{0}, f32[8]{0}) all-gather-start(%a, %b), channel_id=1", 1),
        ("  %done = f32[4] all-reduce-done(%all-reduce-start.1)", 0),
        ('  %f = f32[4] fusion(%all-reduce.1), kind=kLoop, metadata={op_name="a = b all-reduce"}', 0),
    ],
)
def test_operations_between_devices_are_counted(line, count):
    assert len(scaling.COLLECTIVE.findall(line)) == count


@pytest.mark.parametrize("match", ["always", "never"])
@pytest.mark.parametrize("activation", ["silu", "relu"])
def test_plain_torch_does_the_same_work(match, activation):
    pytest.importorskip("torch", reason="the extra `peers` is not installed")
    from benchmarks.peers import plain_torch
    from benchmarks.peers.compare import disagreement, problem_of

    given = workload({**TINY, "search.matching": match, "model.activation": activation}, horizon=3)
    found = disagreement(given, problem_of(given), plain_torch.step)
    assert found["objective"] < 1e-5
    assert found["gradient"] < 1e-3


@pytest.mark.skipif("PROB_MBRL" not in os.environ, reason="PROB_MBRL names no checkout of prob_mbrl")
@pytest.mark.parametrize("match", ["always", "never"])
def test_prob_mbrl_does_the_same_work(match):
    from benchmarks.peers import of_prob_mbrl
    from benchmarks.peers.compare import layers_of, tensor

    given = workload({**TINY, "search.matching": match}, horizon=3)
    package = of_prob_mbrl.load(Path(os.environ["PROB_MBRL"]))
    found = of_prob_mbrl.disagreement(package, given, layers_of, tensor)
    assert found["objective"] < 1e-5
    assert found["gradient"] < 1e-3
    for program in of_prob_mbrl.programs(package, given, layers_of, tensor, steps=2, fit_steps=2).values():
        program()


@pytest.mark.skipif("MC_PILCO" not in os.environ, reason="MC_PILCO names no checkout of MC-PILCO")
def test_mc_pilco_does_the_same_work():
    from benchmarks.peers import of_mc_pilco

    package = of_mc_pilco.load(Path(os.environ["MC_PILCO"]))
    words = {"task": "cartpole", **of_mc_pilco.SETTINGS, "search.particles": "20", "policy.num_centers": "7"}
    given = of_mc_pilco.comparable(words, horizon=3)
    with jax.enable_x64(True):
        double = of_mc_pilco.in_double(given)
        found = of_mc_pilco.disagreement(package, double)
        program = of_mc_pilco.search(package, double, steps=2)
    assert found["objective"] < 1e-12
    assert found["gradient"] < 1e-9
    assert found["std"] < 1e-6
    program()


@pytest.mark.parametrize("found", [{"objective": 2e-5}, {"objective": 0.0, "gradient": 2e-3}, {"objective": np.nan}])
def test_a_peer_that_does_other_work_is_refused(found):
    pytest.importorskip("torch", reason="the extra `peers` is not installed")
    from benchmarks.peers.compare import agreed

    assert agreed("peer", {"gradient": 1e-4}) == {"peer_gradient_difference": 1e-4}
    with pytest.raises(RuntimeError, match=f"peer: the {list(found)[-1]} differs"):
        agreed("peer", found)


COMMANDS = sorted(
    ".".join(file.relative_to(RESULTS.parents[1]).with_suffix("").parts).removesuffix(".__main__")
    for file in RESULTS.parent.rglob("*.py")
    if "    command(" in file.read_text()
)


@pytest.mark.filterwarnings("ignore:.*found in sys.modules")
@pytest.mark.parametrize("module", COMMANDS)
def test_a_benchmark_that_is_asked_what_it_does_says_so_and_does_nothing(module, monkeypatch, capsys):
    """The first words of a stranger: `python -m benchmarks.study --help` once learned a study of that name."""
    if module == "benchmarks.peers.compare":
        pytest.importorskip("torch")
    file = (importlib.util.find_spec(module) or pytest.fail(module)).origin
    monkeypatch.setattr(sys, "argv", [str(file), "--help"])
    monkeypatch.setattr(tasks, "of_plant", tasks.of_plant)  # own_cost replaces it
    stored = {path: path.stat().st_mtime_ns for path in RESULTS.iterdir()}
    runpy.run_module(module, run_name="__main__", alter_sys=False)
    assert f"python -m {module}" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in RESULTS.iterdir()} == stored


@pytest.mark.parametrize(
    ("main", "words"),
    [
        (study.main, []),
        (study.main, ["seeds=0-3"]),
        (costs.main, []),
        (batched.main, ["reacher"]),
        (scaling.main, []),
        (scaling.main, ["counts=10"]),
    ],
)
def test_a_benchmark_without_its_first_word_says_what_that_is(main, words):
    with pytest.raises(ConfigError, match="the first word is missing; expected "):
        main(words)


def test_a_benchmark_refuses_a_word_that_it_does_not_know():
    with pytest.raises(ConfigError, match=r"seds is unknown; did you mean 'seeds'"):
        scaling.main(["seds"])
    with pytest.raises(ConfigError, match=r"foo is one word too many; expected none"):
        prior_cost.main(["foo"])


# Stored results

PAGES = [results_page.README, *results_page.PAGE.parent.glob("*.md")]


def test_a_page_shows_each_stored_file():
    """A figure or a row of a table shows it, or a page names it with its folder."""
    named = {name for page in PAGES for name in re.findall(r"benchmarks/results/([\w.-]+\w)", page.read_text())}
    kept = {path.name for path in RESULTS.iterdir() if path.name != "README.md"}
    assert named <= kept, "a page names a file that is not stored"
    assert not kept - named - results_page.shown(results_page.FIGURES, RESULTS)


@pytest.mark.parametrize("page", ["readme", "page"])
def test_a_page_has_what_the_program_prints(page):
    path = {"readme": results_page.README, "page": results_page.PAGE}[page]
    text = path.read_text()
    assert text.count(results_page.BEGIN) == text.count(results_page.END) == 1
    made = {
        "readme": lambda: results_page.readme(RESULTS),
        "page": lambda: results_page.page(results_page.FIGURES, RESULTS),
    }
    assert text.split(results_page.BEGIN)[1].split(results_page.END)[0] == made[page]()


@pytest.mark.parametrize("path", results_page.FIGURES.glob("*.toml"), ids=lambda path: path.stem)
def test_a_figure_without_claims_has_no_table_of_them(path):
    figure = figures.read(path)
    assert ("| claim" in results_page.section(figure, RESULTS)) == bool(figure.claims)


@pytest.mark.parametrize("row", readme_table.ROWS + readme_table.MORE, ids=lambda row: row.studies[0])
def test_a_row_is_its_preset_with_the_settings_that_the_row_says(row):
    """By the command line's parser: preset= and the changed words are the config that was measured."""
    for stem in row.studies:
        result = json.loads((RESULTS / f"{stem}.json").read_text())
        words = shlex.split(f"preset={row.preset} {readme_table.changes(row, result)}")
        label, made = config_io.parse(config_io.split(words)[1]), comparison.measured(result)
        free = {name: getattr(made, name) for name in readme_table.FREE}
        assert made == comparison.numbered(dataclasses.replace(label, **free))


def test_readme_reports_what_the_first_commands_learn_with():
    """The rows whose preset was measured as it is; a new one is welcome, none may go."""
    rows = {(row.preset, readme_table.changes(row, readme_table.pooled(row, RESULTS))) for row in readme_table.ROWS}
    assert rows >= {("cartpole_network", ""), ("double_cartpole_gpu", ""), ("cartpole", "")}


def test_the_paper_has_the_numbers_that_are_stored():
    """Those of README.md's tables: its own were once of seeds that are no longer stored."""
    text = (results_page.README.parent / "paper.md").read_text()
    result = readme_table.pooled(readme_table.ROWS[0], RESULTS)
    seeds, rates = len(result["seeds"]), result["success_rate"]
    solved = sum(rate[-1] >= SOLVED for rate in rates)
    assert f"{solved} of {seeds} seeds of the cart-pole swing-up end" in text
    first = sorted(first_solved(rate) for rate in rates)[seeds // 2]
    seconds = result["plant_seconds"][first - 1]
    assert f"in the median after {['', 'one', 'two', 'three'][first]} episodes, {seconds:g} s of plant time" in text
    step = json.loads((RESULTS / "peers.json").read_text())["rows"]["cart-pole"]["ours_of_compiled"]
    assert f"{step:.2f} of the time of the same step in compiled PyTorch" in text


def test_studies_of_two_configs_are_not_one_row():
    row = readme_table.ROWS[0]._replace(studies=("cartpole-50", "cartpole_network-50"))
    with pytest.raises(ValueError, match="not of one config"):
        readme_table.pooled(row, RESULTS)


def test_a_setting_is_a_word_of_the_command_line():
    values = {"false": False, "null": None, "1": 1.0, "0.001": 1e-3, "[1,2.5]": (1, 2.5), "sine": "sine"}
    assert [readme_table.word(value) for value in values.values()] == list(values)
    assert readme_table.spans([0, 1, 2, 5, 9, 10]) == "0-2, 5, 9-10"


@pytest.mark.parametrize("name", pictures.RUNS)
def test_each_plant_has_a_small_film_whose_run_can_be_made_again(name: str) -> None:
    words, _ = pictures.RUNS[name]
    task = tasks.of_config(understood(words.split())[0].config)
    film = pictures.PICTURES / f"{name}.mp4"
    assert film.stat().st_size <= 60 * 1024
    with imageio.get_reader(film) as reader:
        assert reader.get_meta_data()["duration"] == pytest.approx(task.horizon * task.dt, abs=0.1)
    assert f'<video src="pictures/{film.name}"' in (pictures.PICTURES.parent / "plants.md").read_text()
