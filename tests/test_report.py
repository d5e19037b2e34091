"""Reports: a page says what the folder says, needs nothing else, and is drawn by a browser."""

from __future__ import annotations

import base64
import csv
import io
import json
import re
import shlex
import shutil
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import browser
from folders import TINY, a_run, episode, row
from pegasus_jax.checks import ConfigError, RunError
from pegasus_jax.cli import report as command
from pegasus_jax.cli import runs as commands
from pegasus_jax.episode import Episode, verdict
from pegasus_jax.math.window import window
from pegasus_jax.report import build, chart, compare
from pegasus_jax.report.chart import Level, Line
from pegasus_jax.report.findings import findings
from pegasus_jax.report.page import page
from pegasus_jax.report.read import Look, coverage, look, settings
from pegasus_jax.runs import config_io, groups, restore, store
from pegasus_jax.viz import run_plots

STEPS, PARTICLES = 25, 30
KNOWN = dict(calibration=1.1, saturated=0.1, skipped_updates=0, replaced=True, mean_cost=0.5, success_rate=0.6)


def imagined(run: Path, trial: int) -> None:
    """A fan of particles as training leaves it."""
    draw = np.random.default_rng(trial)
    x, u = draw.normal(size=(STEPS + 1, PARTICLES, 4)), draw.uniform(-10, 10, (STEPS, PARTICLES, 1))
    (run / "imagined").mkdir(exist_ok=True)
    np.savez(run / "imagined" / f"{trial:04d}.npz", x=x, u=u, cost=draw.uniform(size=(STEPS, PARTICLES)))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three trials, whose state names are what a careless user may call them."""
    made = a_run(tmp_path_factory.mktemp("report") / "run")
    for trial in (1, 2, 3):
        imagined(made, trial)
    seconds = {"collect": 5.0, "fit": 2.0, "compile": 1.0, "between_episodes": 8.0}
    store.write_trials(made, [row(trial, **KNOWN, seconds=seconds) for trial in (1, 2, 3)])
    return made


@pytest.fixture(scope="module")
def sweep(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two settings of three seeds, one of which has come less far, as folders of a sweep."""
    home, draw = tmp_path_factory.mktemp("sweep"), np.random.default_rng(0)
    for clip in (1.0, 10.0):
        for seed in range(3):
            copy = shutil.copytree(run, home / f"search.grad_clip-{clip:g}" / f"seed{seed}")
            config = config_io.load(run / "config.yaml")
            changed = replace(config, seed=seed, search=replace(config.search, grad_clip=clip))
            config_io.save(changed, copy / "config.yaml")
            costs = draw.uniform(size=2 if (clip, seed) == (10.0, 2) else 3)
            rows = [row(i, **KNOWN | {"mean_cost": float(cost)}) for i, cost in enumerate(costs, 1)]
            store.write_trials(copy, rows)
    return home


class Page(HTMLParser):
    """What a page refers to, and what it says."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.links: list[str] = []
        self.tags: list[str] = []
        self.words: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(str(value))
            elif name in ("href", "src", "srcset", "action", "xlink:href"):
                self.links.append(str(value))
            elif name == "clip-path":
                self.links.append(str(value).removeprefix("url(").removesuffix(")"))

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def whole(text: str) -> Page:
    """The page, which refers to nothing outside of itself."""
    found = Page(text)
    assert len(found.ids) == len({*found.ids})
    for link in found.links:
        assert link.startswith("data:") or link.removeprefix("#") in found.ids, link
    assert not re.search(r"@import|url\((?!#)", text)
    return found


def inside(found: Page, kind: str) -> list[str]:
    """The files of a kind that are in a page."""
    begin = f"data:{kind};base64,"
    return [base64.b64decode(link.removeprefix(begin)).decode() for link in found.links if link.startswith(begin)]


def html(*paths: Path) -> str:
    made = build.report(paths)
    return page(made.title, made.lead, made.sections)


def table(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_a_run_is_one_page_with_every_curve(run: Path) -> None:
    found = whole(html(run))
    text = " ".join(found.words)
    for title in ("Warnings", "Learning curves", "Calibration", "Real and imagined", "Film", "Best policy", "Settings"):
        assert title in text
    for name in ("theta' [rad/s]", "force [N]", "plant time [s]", "time [s]", "cost a period"):
        assert name in text
    assert text.count("2 + 1") == 3  # waiting between two episodes is made of the other seconds
    assert "computing time 9 s" in text
    assert {f"trial-{n}" for n in (1, 2, 3, 4)} <= {*found.ids}  # the fourth is imagined and has not been run
    trials, trajectories = map(table, inside(found, "text/csv"))
    assert [float(one["episode_cost"]) for one in trials] == [one["episode_cost"] for one in store.trials(run)]
    assert [one["seconds_compile"] for one in trials] == ["1.0"] * 3
    angles = [one for one in trajectories if (one["trial"], one["name"]) == ("2", "theta [rad]")]
    real = store.arrays(store.episode_path(run, 2))["x"][:, 3]
    fan = store.arrays(run / "imagined" / "0001.npz")["x"][:, :, 3]
    np.testing.assert_allclose([float(one["real"]) for one in angles], real, rtol=1e-5)
    np.testing.assert_allclose([float(one["time [s]"]) for one in angles], 0.1 * np.arange(STEPS + 1), rtol=1e-5)
    np.testing.assert_allclose([float(o["imagined_5_percent"]) for o in angles], np.quantile(fan, 0.05, 1), rtol=1e-5)


def test_an_episode_has_one_cost_on_the_page_and_says_that_it_ended_early(run: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(run, tmp_path / "run")
    task = store.task_of(copy)
    for trial, ended, expected in ((2, "terminated", 1 - 0.9 * 5 / 25), (3, "interrupted", 0.1)):
        ran = episode(task, trial, 5)._replace(cost=np.full(5, 0.1, np.float32))
        store.save_episode(copy, trial, ran, task, policy=trial - 1, ended=ended)
        rows = store.trials(copy)
        rows[trial - 1] |= verdict(Episode(ran, ended), task) | {"ended": ended}
        store.write_trials(copy, rows)
        text = " ".join(whole(html(copy)).words)
        assert f"policy of trial {trial - 1}, cost {expected:.3f}" in text  # the heading of its charts
        assert f"policy of trial {trial - 1}, {ended} {expected:.3f}" in text  # the table


def test_a_picture_reaches_as_far_as_its_episode_needs() -> None:
    time = np.linspace(0, 1, 50)
    real, narrow = np.sin(6 * time), np.sin(6 * time)[:, None] + 0.3 * np.linspace(-1, 1, 100)
    low, high = window(real, narrow) or (0, 0)
    assert -1.45 < low < np.percentile(narrow, 5, axis=1).min() < np.percentile(narrow, 95, axis=1).max() < high < 1.45
    stray = narrow.copy()
    stray[:, :3] = 2000 * time[:, None]
    stray[-1, 3] = np.nan
    assert window(real, stray) == pytest.approx((low, high), abs=0.1)
    flying = narrow + 1e6 * time[:, None] ** 6 * np.linspace(0, 1, 100)
    low, high = window(real, flying) or (0, 0)
    assert (low < real.min(), real.max() < high) == (True, True)
    assert high - low < 10 * np.ptp(real)
    assert window(None, narrow) == pytest.approx(window(real, narrow), abs=0.05)
    assert window(np.array([0.0, np.nan, 1.0]), None) == pytest.approx((-0.06, 1.06))
    assert window(None, None) is None
    assert window(np.zeros(3), np.zeros((3, 4)), -5.0, 5.0) == pytest.approx((-5.6, 5.6))


def test_names_of_a_user_are_text(run: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(run, tmp_path / "<b>&run")
    about = json.loads((copy / "run.json").read_bytes())
    about["task"]["state_names"][0] = "<script>alert(1)</script> [m]"
    (copy / "run.json").write_text(json.dumps(about))
    found = whole(html(copy))
    assert "script" not in found.tags
    assert "<script>alert(1)</script> [m]" in found.words


def test_the_settings_that_were_changed_come_first(run: Path) -> None:
    every = settings(look(run))
    changed = [name for name, _, _, differs in every if differs]
    assert {*changed} == {*TINY, "trials"} - {"task"}
    assert changed == [name for name, *_ in every[: len(changed)]]


def warned(run: Look, **last: Any) -> str:
    """The warnings of a healthy run whose last row is another."""
    rows = [row(n, **KNOWN, objective_incumbent=0.5) for n in (1, 2, 3)]
    healthy = run._replace(rows=[*rows[:2], rows[2] | last], best=3, steps=[])
    return " | ".join(f"{one.level}: {one.what}" for one in findings(healthy))


@pytest.mark.parametrize(
    ("last", "says"),
    [
        ({}, ""),
        ({"calibration": 3.21}, "warning: trial 3: model errors 3.2 times as large as predicted"),
        ({"calibration": 0.3}, "note: trial 3: model errors only 0.30 times"),
        ({"mean_cost": 0.9}, "warning: trial 3: cost 0.90 on the plant, 0.50 imagined"),
        ({"objective_last": 0.3}, "warning: trial 3: imagined cost 0.30 on held scenarios, 0.50 on fresh ones"),
        ({"skipped_updates": 7}, "note: 7 updates skipped"),
        ({"constraint_broken": True}, "warning: constraint broken in the episodes of trial 3"),
        ({"ended": "error"}, "warning: episodes ended early (error): trial 3"),
        ({"ended": "terminated"}, "note: episodes ended early (terminated): trial 3"),
        # Not that the model is wrong: the periods behind the end cost, and no policy changes that.
        ({"ended": "truncated", "mean_cost": 0.9}, "note: episodes ended early (truncated): trial 3"),
    ],
)
def test_a_warning_says_what_is_unusual_and_nothing_else(run: Path, last: dict[str, Any], says: str) -> None:
    found = warned(look(run), **last)
    assert found.startswith(says)
    assert "|" not in found
    assert bool(found) == bool(says)


def test_an_early_end_that_is_not_imagined_is_explained(run: Path) -> None:
    """With stop= there is nothing to explain."""
    healthy = look(run)
    ended = healthy._replace(rows=[{**one, "ended": "terminated"} for one in healthy.rows])
    told = ended._replace(config=replace(ended.config, stop="robot:hit"))
    (means,), (less,) = ([one.means for one in findings(found) if "terminated" in one.what] for found in (ended, told))
    assert means == f"{less} Imagined episodes do not end there: stop= says where."


def test_damaged_files_are_named_and_the_rest_is_shown(run: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(run, tmp_path / "run")
    (copy / "imagined" / "0002.npz").write_bytes(b"no array")
    (copy / "trials.jsonl").write_text((copy / "trials.jsonl").read_text() + "{")
    found = whole(html(copy))
    text = " ".join(found.words)
    assert "0002.npz cannot be read" in text
    assert "line 4 is not JSON" in text
    assert "trial-3" in found.ids


def test_the_share_inside_the_band_is_that_of_the_states(run: Path) -> None:
    found = look(run)
    step = found.steps[1]
    assert step.real is not None
    assert step.fan is not None
    x, fan = np.array(step.real.trajectory.x)[1:], step.fan["x"][1:]
    low, high = np.quantile(fan, 0.05, 1), np.quantile(fan, 0.95, 1)
    assert coverage(step, found.task) == pytest.approx(np.mean((low <= x) & (x <= high)))
    turned = np.array(step.real.trajectory.x)
    turned[:, 3] += 4 * np.pi  # the same angle
    again = step.real._replace(trajectory=step.real.trajectory._replace(x=turned))
    assert coverage(step._replace(real=again), found.task) == coverage(step, found.task)


def drawn_of(rows: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch) -> list[dict[str, list[float]]]:
    """What learning.png has in its upper and in its lower axes: the heights of each line by its label."""
    figures: list[Any] = []
    monkeypatch.setattr(run_plots, "_save", lambda figure, path: figures.append(figure))
    run_plots.learning(rows, Path("learning.png"))
    (figure,) = figures
    return [{str(line.get_label()): list(line.get_ydata()) for line in axis.lines} for axis in figure.axes]


def test_the_learning_curve_of_a_robot_shows_its_own_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without an evaluation: whether each succeeded, and which of them ended early."""
    rows = [row(n, episode_success=n == 3, ended="interrupted" if n == 2 else "horizon") for n in (1, 2, 3)]
    above, below = drawn_of(rows, monkeypatch)
    assert above["plant, the trial's episode"] == [0.9, 0.8, 0.7]
    assert above["plant, an episode that ended early"] == [0.8]
    assert [*below.values()] == [[0, 0, 1], [0]]
    above, below = drawn_of([row(n, **KNOWN) for n in (1, 2)], monkeypatch)
    assert (len(above), [*below.values()]) == (3, [[0.6, 0.6]])
    without = [{name: v for name, v in row(1).items() if name not in ("ended", "episode_success")}]  # of an old version
    assert np.isnan(next(iter(drawn_of(without, monkeypatch)[1].values()))).all()


def test_a_chart_puts_numbers_where_they_belong() -> None:
    axes = chart.Axes((0.0, 10.0), (1.0, 100.0), True, False, 330, 205)
    left, right, top, bottom = chart.LEFT, 330 - chart.RIGHT, chart.TOP, 205 - chart.BOTTOM
    assert [axes.across(x) for x in (0, 5, 10)] == [left, (left + right) / 2, right]
    assert [axes.down(y) for y in (1, 10, 100)] == pytest.approx([bottom, (top + bottom) / 2, top])
    drawn = chart.chart("a", "t [s]", "v [m]", [Line([0, 1, 2, 3], [1, None, float("nan"), 2], "real"), Level(5.0)])
    assert drawn.count("<polyline") == 0  # two points with a gap between
    whole_line = chart.chart("a", "t [s]", "v [m]", [Line([0, 1], [1, 2], "real", "it", ["x", "<y>"])])
    assert whole_line.count("<polyline") == 1
    assert "&lt;y&gt;" in whole_line


def test_runs_that_differ_in_the_seed_alone_are_one_group(sweep: Path) -> None:
    runs, problems = groups.readable(groups.found([sweep]))
    made = groups.grouped(runs)
    assert not problems
    assert [(one.label, len(one.runs), one.shared) for one in made] == [
        ("search.grad_clip=1", 3, 3),
        ("search.grad_clip=10", 3, 2),
    ]
    assert groups.measured(made) == groups.EVALUATED
    center, low, high = groups.middle(made[0].curves("mean_cost"))
    costs = np.array([[one["mean_cost"] for one in run.rows] for run in made[0].runs])
    np.testing.assert_allclose(center, costs.mean(0))  # of three seeds none is cut off
    assert (low <= center).all() and (center <= high).all()  # noqa: PT018
    assert np.isnan(groups.middle(costs[:1])[1:]).all()


def test_a_folder_of_runs_is_compared(sweep: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = whole(html(sweep))
    text = " ".join(found.words)
    assert "6 runs, 2 settings" in text
    assert "some runs have more trials than others" in text
    raw, means = map(table, inside(found, "text/csv"))
    assert len(raw) == 3 * 3 + 3 + 3 + 2
    assert {one["name"] for one in means} >= {"mean_cost", "success_rate"}
    command.handle([str(sweep), f"out={tmp_path / 'a.html'}", f"csv={tmp_path / 'csv'}"])
    commands.plot([str(sweep)])
    written = capsys.readouterr().out.split()
    assert written == [*map(str, (tmp_path / "a.html", *(tmp_path / "csv" / n for n in ("curves.csv", "means.csv")))),
                       str(sweep / "learning.png")]  # fmt: skip
    assert all(Path(name).stat().st_size > 500 for name in written)


def test_the_best_policy_is_that_of_every_other_command(tmp_path: Path) -> None:
    """Of the newest policy there is an episode, and no trial, after final=true."""
    run = a_run(tmp_path / "run", trials=3)
    task = store.task_of(run)
    assert compare.best_of(groups.readable([run])[0][0]) == restore.best(run) == 2
    store.save_episode(run, 4, episode(task, 4), task, policy=3, ended="horizon")
    assert compare.best_of(groups.readable([run])[0][0]) == restore.best(run) == 3


def test_a_run_that_cannot_be_read_is_left_out_and_named(sweep: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(sweep, tmp_path / "sweep")
    (copy / "search.grad_clip-1" / "seed1" / "trials.jsonl").write_text("{")
    made = build.report([copy])
    assert len(made.problems) == 1
    assert "seed1/trials.jsonl line 1 is not JSON" in made.problems[0]
    assert made.title == "5 runs, 2 settings"


def test_nothing_of_a_user_is_replaced(run: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine.html"
    mine.write_text("<p>my notes</p>")
    with pytest.raises(ConfigError, match="is no report of pegasus-report, so it is not replaced"):
        command.handle([str(run), f"out={mine}"])
    assert mine.read_text() == "<p>my notes</p>"
    for _ in range(2):  # an earlier report may be
        command.handle([str(run), f"out={tmp_path / 'report.html'}", f"csv={tmp_path}"])


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ([], "no run is named"),
        (["nowhere"], "nowhere is not a run"),
        (["RUN", "--film"], "'--film' is not an option here, key=value; did you mean 'film'"),
        (["RUN", "otu=a.html"], "otu is not an option here; did you mean 'out'"),
        (["RUN", "film=maybe"], "film=maybe is neither true nor false"),
        (["SWEEP", "film=true"], "film=true is for one run, not 6"),
        (["RUN", "out=RUN"], "is a folder; name a file"),
    ],
)
def test_bad_words_are_one_line(run: Path, sweep: Path, words: list[str], says: str) -> None:
    with pytest.raises((ConfigError, RunError)) as caught:
        command.handle([word.replace("RUN", str(run)).replace("SWEEP", str(sweep)) for word in words])
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_film_of_the_best_policy_is_in_the_page(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def film(run: Path, episodes: int, seed: int, trial: str) -> None:
        (run / "play.mp4").write_bytes(f"a film of {episodes}, {trial}".encode())

    monkeypatch.setattr("pegasus_jax.viz.video.film", film)
    copy = shutil.copytree(run, tmp_path / "run")
    command.handle([str(copy), "film=true"])
    found = whole((copy / "report.html").read_text())
    assert "video" in found.tags
    assert inside(found, "video/mp4") == ["a film of 1, best"]


SEEN = """(() => {
    const charts = [...document.querySelectorAll('figure > svg')].filter(one => !one.closest('details:not([open])'))
    return {lines: document.querySelectorAll('figure polyline').length,
            heights: charts.map(one => one.getBoundingClientRect().height),
            fits: document.documentElement.scrollWidth <= innerWidth,
            back: getComputedStyle(document.body).backgroundColor}
})()"""


@pytest.mark.parametrize("dark", [False, True])
def test_a_browser_draws_the_page_and_asks_for_nothing_else(run: Path, sweep: Path, tmp_path: Path, dark: bool) -> None:
    address = tmp_path / "report.html"
    address.write_text(html(sweep if dark else run))
    seen = browser.opened(address.as_uri(), SEEN, dark=dark)
    found = seen["found"]
    assert found["lines"] > 20
    assert len(found["heights"]) >= 5
    assert min(found["heights"]) > 100
    assert found["fits"]
    assert found["back"] == ("rgb(15, 19, 24)" if dark else "rgb(255, 255, 255)")
    assert seen["console"] == []
    assert [one for one in seen["asked"] if not one.startswith("data:")] == [address.as_uri()]


def test_a_command_can_be_copied_where_a_folder_has_a_space(run: Path, tmp_path: Path) -> None:
    """The words of a shell are split at spaces."""
    spaced = shutil.copytree(run, tmp_path / "my runs" / "a b")
    store.write_trials(spaced, [row(trial, **KNOWN) for trial in (1, 2)])  # of three
    (made,) = build.write(build.report([spaced]), tmp_path / "report.html")
    text = unescape(made.read_text(encoding="utf-8"))
    for name, word in (("train", f"resume={spaced}"), *((one, str(spaced)) for one in ("eval", "play", "export"))):
        assert f"pegasus-{name} {shlex.quote(word)} " in text
    assert f"pegasus-report {shlex.quote(str(spaced))} film=true" in text
