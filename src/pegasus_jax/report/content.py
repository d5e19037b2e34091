"""A run as the sections of a page."""

from __future__ import annotations

import json
import time
from html import escape
from pathlib import Path
from typing import Any

import imageio.v3 as iio

from pegasus_jax.checks import shown
from pegasus_jax.config import label, model_word
from pegasus_jax.report import driven, read
from pegasus_jax.report.curves import calibration, learning, trials
from pegasus_jax.report.findings import findings, said
from pegasus_jax.report.page import Section, data, downloads, facts, fold, table
from pegasus_jax.report.read import Look, model_of
from pegasus_jax.report.tables import trajectories_csv, trials_csv
from pegasus_jax.report.trajectories import fans, summary
from pegasus_jax.runs import restore, store
from pegasus_jax.runs.best import judging
from pegasus_jax.runs.display import duration
from pegasus_jax.shell import typed
from pegasus_jax.tasks import guide

WIDTHS = ("policy.hidden", "policy.num_centers", "model.hidden")  # how large what was learned is


def title(found: Look) -> str:
    """What the page of a run is called."""
    return f"{label(found.config)}, seed {found.config.seed}"


def lead(found: Look) -> str:
    """The lines below the title."""
    when = time.strftime("%Y-%m-%d %H:%M")
    kinds = f"model {model_word(model_of(found))}, policy {found.config.policy.kind}"
    return f'<p class="soft">{escape(kinds)}. Folder <code>{escape(str(found.path))}</code>, read {when}.</p>' + cards(
        found
    )


def sections(found: Look) -> list[Section]:
    """The page of a run, from what matters first to what only a few look up."""
    made = [
        Section("warnings", "Warnings", said(findings(found))),
        Section("learning", "Learning curves", learning(found) if found.rows else NOTHING),
        Section("calibration", "Calibration", calibration(found)),
        Section("trials", "Trials", trials(found) if found.rows else NOTHING),
        Section("trajectories", "Real and imagined trajectories, controls", trajectories(found)),
        Section("driven", "Episodes of pegasus-run", driven.section(found)),
        Section("film", "Film", film(found)),
        Section("policy", "Best policy", policy(found)),
        Section("settings", "Settings", settings(found)),
        Section("versions", "Versions and commands", versions(found)),
        Section("data", "Data", downloads(files(found)) + task(found)),
    ]
    return [part for part in made if part.html]


NOTHING = '<p class="soft">No trial is finished yet.</p>'


def cards(found: Look) -> str:
    """The numbers that a person looks for first."""
    last = found.rows[-1] if found.rows else {}
    spent = sum(sum(store.computing(row)) for row in found.rows)
    pairs = [("trials done", f"{len(found.rows)} <small>of {found.config.trials}</small>")]
    if found.rows:
        pairs.append(("plant time", f"{last['plant_seconds']:g} s <small>trials of {period(found)}</small>"))
        pairs.append(("best policy", best(found)))
    if spent:
        pairs.append(("computing time", f"{duration(spent)}"))
    return facts(pairs)


def period(found: Look) -> str:
    """How long an episode is."""
    return f"{found.task.horizon * found.task.dt:g} s, {found.task.horizon} periods of {found.task.dt:g} s"


def best(found: Look) -> str:
    """The best policy, and how good it is."""
    if found.best is None:
        return "not known"
    row = found.rows[found.best - 1] if found.best else {}
    own = [one["episode_cost"] for one in judging(restore.with_last(found.path, found.rows), found.best)]
    ran = [one for one in found.driven if one.policy == found.best]
    known = []
    if row.get("mean_cost") is not None:
        known.append(f"success {row['success_rate']:.0%}, cost {row['mean_cost']:.3f} in its evaluation")
    elif own:
        known.append(f"cost {sum(own) / len(own):.3f} in {len(own)} of the episodes")
    if ran:
        known.append(driven.worth(ran))
    return f"trial {found.best} <small>{'; '.join(known) or 'not run yet'}</small>"


def trajectories(found: Look) -> str:
    """Each trial's episode over what was imagined of it; the newest, and that of the best policy, are open."""
    newest = [step.number for step in found.steps if step.real][-1:]
    of_best = [step.number for step in found.steps if step.policy == (found.best or None)][:1]
    words = (
        "<p>Red is the episode on the plant. Blue is what the model imagined of it before: the bands hold 90 and 50 %"
        " of the particles, the thin lines are some of them. The dotted lines are the limits of the controls."
        " Particles that fly far away from the episode leave the picture.</p>"
    )
    explored, exploring = found.config.explore.trials, guide.exploring(found.config)
    folds = [
        fold(
            summary(step, found.task, exploring if step.number <= explored else "first policy"),
            fans(step, found.task),
            name=f"trial-{step.number}",
            opened=step.number in (*newest, *of_best),
        )
        for step in reversed(found.steps)
    ]
    return words + "".join(folds) if folds else NOTHING


def film(found: Look) -> str:
    """RUN/play.mp4, where pegasus-play has made one."""
    path = found.path / "play.mp4"
    if not path.is_file():
        command = typed(["pegasus-report", str(found.path), "film=true"])
        return f'<p class="soft">None yet. <code>{escape(command)}</code> films the best policy on its plant.</p>'
    address, still = data("video/mp4", path.read_bytes()), picture(path)
    poster = f' poster="{data("image/png", still)}"' if still else ""
    return (
        f'<video controls loop muted playsinline{poster} src="{address}"></video>'
        '<p class="soft">As pegasus-play made it, in real time. Its title names the trial of the policy; cost and'
        " command are drawn below the plant.</p>"
    )


def picture(path: Path) -> bytes:
    """The last picture of a film as PNG, for paper and until it plays; empty where the file is no film."""
    try:
        return iio.imwrite("<bytes>", list(iio.imiter(path))[-1], extension=".png")
    except Exception:  # whatever a reader of films raises of a damaged one
        return b""


def policy(found: Look) -> str:
    """What the best policy is, and how to use it."""
    if found.best is None or not found.rows:
        return ""
    use = lambda command: escape(typed([f"pegasus-{command}", str(found.path)]), quote=False)  # noqa: E731
    plain = read.config_io.plain(found.config)
    sizes = ", ".join(f"{name}={shown(plain[name])}" for name in WIDTHS if name in plain)
    names = f"sees {', '.join(found.task.state_names)}; sends {', '.join(found.task.control_names)}"
    return (
        f"<p>The policy after {best(found).replace('<small>', '(').replace('</small>', ')')}. {escape(sizes)}. It"
        f" {escape(names)}, every {found.task.dt:g} s.</p>"
        f"<pre>{use('eval')}                 # its cost and success in new episodes\n"
        f"{use('play')}                 # a film\n"
        f"{use('export')}               # one file that needs no JAX</pre>"
    )


def settings(found: Look) -> str:
    """The settings that differ from the preset, and in a fold all of them."""
    words, preset = read.began_with(found)
    every = read.settings(found)
    changed = [row for row in every if row[3]]
    head = ["setting", "value", "in the preset"]

    def cells(rows: list[tuple[str, Any, Any, bool]]) -> list[list[str]]:
        return [
            [f"<code>{escape(name)}</code>", escape(_short(value)), escape(_short(before))]
            for name, value, before, _ in rows
        ]

    if preset is None:
        first = '<p class="soft">The preset of this run is not known to this version.</p>'
    elif changed:
        first = f"<p>Changed from <code>{escape(words)}</code>:</p>" + table(head, cells(changed), "words")
    else:
        first = f"<p>Those of <code>{escape(words)}</code>, none changed.</p>"
    return first + fold(f"All {len(every)} settings", table(head, cells(every), "words"), name="all-settings")


def _short(value: Any) -> str:
    text = shown(value)
    return text if len(text) <= 120 else f"{text[:117]}..."


def versions(found: Look) -> str:
    """What the run was made with."""
    about = found.about
    listed = {name: about.get(name) for name in ("python", "platform", "processor", "devices")}
    rows = [
        [escape(k), escape(v if isinstance(v, str) else ", ".join(map(str, v or [])))] for k, v in listed.items() if v
    ]
    versions = about.get("versions")
    rows += [[escape(k), escape(str(v))] for k, v in (versions.items() if isinstance(versions, dict) else ())]
    commands = [one for one in about.get("commands", []) if isinstance(one, dict)]
    told = "\n".join(f"{one.get('command', '')}      # after {one.get('done', 0)} trials" for one in commands)
    return f"<pre>{escape(told)}</pre>" + fold("Versions and machine", table(["", ""], rows, "words"), name="machine")


def task(found: Look) -> str:
    """The facts of the task, as run.json has them."""
    return fold("The task", f"<pre>{escape(json.dumps(found.about.get('task'), indent=1))}</pre>", name="task")


def files(found: Look) -> dict[str, str]:
    """Name -> CSV of the curves of a run."""
    return {"trials.csv": trials_csv(found), "trajectories.csv": trajectories_csv(found)}
