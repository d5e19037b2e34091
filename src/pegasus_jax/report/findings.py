"""What a person should know of a run before its numbers are believed, and what it means."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from html import escape
from importlib import metadata
from typing import Any, NamedTuple

from pegasus_jax.checks import some
from pegasus_jax.config_models import BNN, Lagrangian, several
from pegasus_jax.report.read import Look, coverage, model_of
from pegasus_jax.runs.store import cost_since
from pegasus_jax.runs.stuck import AT_LIMITS, stuck
from pegasus_jax.shell import typed

TOO_SURE, TOO_UNSURE = 2.0, 0.5  # errors of a model, in what it predicts for them
COVERED = 0.6  # of a real episode's states lie among the imagined ones; 0.9 would be right
GAP = 0.2  # between an imagined cost and the plant's
HELD = 0.1  # between the imagined cost of fresh scenarios and of those that the search held
LATEST = 3  # trials without a better policy


class Finding(NamedTuple):
    """A warning, or a note, about a run."""

    level: str  # warning, or note
    what: str
    means: str


def findings(found: Look) -> list[Finding]:
    """The warnings of a run, then its notes."""
    every = [finding for look_for in CHECKS for finding in look_for(found)]
    return sorted(every, key=lambda finding: finding.level != "warning")


def _files(found: Look) -> Iterator[Finding]:
    for problem in found.problems:
        yield Finding("warning", problem, "The report shows the rest. The file was damaged after it was written.")
    missing = found.config.trials - len(found.rows)
    if missing > 0:
        done = f"{len(found.rows)} of {found.config.trials} trials are done"
        command = typed(["pegasus-train", f"resume={found.path}"])
        yield Finding("note", done, f"The run goes on, or was stopped: {command} continues it.")
    now, then = metadata.version("pegasus-jax"), (found.about.get("versions") or {}).get("pegasus-jax")
    if then != now:
        yield Finding("note", f"made by version {then}, reported by {now}", "Settings may have other defaults now.")


def _measured(found: Look) -> Iterator[Finding]:
    if found.rows and all(row.get("mean_cost") is None for row in found.rows):
        means = "Cost and success are of each trial's own episode, one sample of the policy of the trial before."
        yield Finding("note", "policies were not evaluated (eval_episodes=0)", means)
    if found.rows and (since := cost_since(found.rows[-1])) > 1:
        means = "Costs before it are of another function: curves jump there, and no earlier policy can be the best one."
        yield Finding("note", f"the cost was changed before trial {since}", means)
    if found.rows and all(row.get("objective_fresh") is None for row in found.rows):
        yield Finding("note", "no policy was learned yet", "Every episode so far explored.")


def _model(found: Look) -> Iterator[Finding]:
    known = [(row["trial"], row["calibration"]) for row in found.rows if row.get("calibration") is not None]
    if known and known[-1][1] > TOO_SURE:
        trial, ratio = known[-1]
        alone = isinstance(model := model_of(found), BNN | Lagrangian) and several(model) == 1
        then = ", then model.ensemble_size=5" if alone else ""
        means = (
            "The model claims to know more than it does, so imagined costs are too good. This is usual in the first"
            f" trials. If it stays after five, give more trials{then}."
        )
        yield Finding("warning", f"trial {trial}: model errors {ratio:.1f} times as large as predicted", means)
    elif known and known[-1][1] < TOO_UNSURE:
        trial, ratio = known[-1]
        means = "The model expects larger errors than it makes. The policy is learned for more noise than there is."
        yield Finding("note", f"trial {trial}: model errors only {ratio:.2f} times as large as predicted", means)
    covered = [(step.number, share) for step in found.steps if (share := coverage(step, found.task)) is not None]
    if covered and covered[-1][1] < COVERED:
        trial, share = covered[-1]
        means = "Long predictions leave the real trajectory. What the search optimizes is not what the plant does yet."
        yield Finding("warning", f"trial {trial}: {share:.0%} of the states within the imagined 90 % band", means)


def _costs(found: Look) -> Iterator[Finding]:
    last = found.rows[-1] if found.rows else {}
    real, fresh, held = (last.get(name) for name in ("mean_cost", "objective_fresh", "objective_last"))
    whole = last.get("ended") != "truncated"  # what a time limit cuts off costs, and is not imagined
    if whole and real is not None and fresh is not None and abs(real - fresh) > GAP:
        means = (
            "The plant costs more than was imagined: the model is wrong where this policy goes. More episodes teach it."
            if real > fresh
            else "The plant costs less than was imagined: the model is unsure there, and the next episodes teach it."
        )
        yield Finding("warning", f"trial {last['trial']}: cost {real:.2f} on the plant, {fresh:.2f} imagined", means)
    if fresh is not None and held is not None and fresh - held > HELD:
        means = "The policy fits the random numbers of its search. More search.particles help."
        what = f"trial {last['trial']}: imagined cost {held:.2f} on held scenarios, {fresh:.2f} on fresh ones"
        yield Finding("warning", what, means)


def _policy(found: Look) -> Iterator[Finding]:
    for before, now in reversed(list(zip(found.rows, found.rows[1:], strict=False))):
        if {"saturated", "episode_cost", "objective_fresh"} <= {*before} & {*now} and (lines := stuck([before], [now])):
            what, _, why = lines[0].removeprefix("note: ").partition("; ")
            yield Finding("warning", what, f"{why[:1].upper()}{why[1:]}.")
            break
    last = found.rows[-1] if found.rows else {}
    if (last.get("saturated") or 0) >= AT_LIMITS and (last.get("episode_cost") or 0) < 0.5:
        means = "Right for a race or a swing-up of little force. Otherwise the limits are narrow for the task."
        yield Finding(
            "note", f"trial {last['trial']}: controls at their limits {last['saturated']:.0%} of the time", means
        )
    if found.best is not None and found.rows and 0 < found.best < len(found.rows):
        what = f"the best policy is of trial {found.best}, not of the last one"
        yield Finding("note", what, "Every command takes the best one, unless trial= names another.")
    kept = [row.get("replaced") is False for row in found.rows[-LATEST:]]
    if len(kept) == LATEST and all(kept):
        means = "No search found a policy that is imagined to be better: the run has converged, or is stuck."
        yield Finding("note", f"the last {LATEST} trials kept their policy", means)
    skipped = sum(row.get("skipped_updates") or 0 for row in found.rows)
    if skipped:
        means = "Gradients were not finite there. A few do no harm. Many: a smaller search.grad_clip or learning rate."
        yield Finding("note", f"{skipped} updates skipped", means)


def _episodes(found: Look) -> Iterator[Finding]:
    broken = [row["trial"] for row in found.rows if row.get("constraint_broken")]
    if broken:
        means = "The episode was outside of what the constraint allows. docs/limits.md says how to make it rarer."
        yield Finding("warning", f"constraint broken in the episodes of {_listed(broken)}", means)
    meaning: dict[str, tuple[str, str]] = {
        "terminated": (
            "note",
            "The plant says that an episode is over, for example after a fall. The rest is charged."
            + (" Imagined episodes do not end there: stop= says where." if found.config.stop is None else ""),
        ),
        "truncated": ("note", "The environment's own time limit came before the horizon."),
        "error": ("warning", "The environment raised an error. The rows until then are data."),
        "interrupted": ("note", "A person stopped the episode. The rows until then are data."),
    }
    ends = Counter(str(row.get("ended")) for row in found.rows)
    for kind, (level, means) in meaning.items():
        if ends[kind]:
            trials = _listed([row["trial"] for row in found.rows if row.get("ended") == kind])
            yield Finding(level, f"episodes ended early ({kind}): {trials}", means)


def _listed(trials: list[Any]) -> str:
    return f"trial{'s' if len(trials) > 1 else ''} {some(trials)}"


def said(every: list[Finding]) -> str:
    """Warnings and notes with what they mean."""
    if not every:
        return '<p class="soft">None: files, model, costs, policy and episodes were looked at.</p>'
    return "".join(
        f'<div class="finding {one.level}"><b>{one.level.capitalize()}: {escape(one.what)}</b>'
        f"<p>{escape(one.means)}</p></div>"
        for one in every
    )


CHECKS = (_files, _measured, _model, _costs, _policy, _episodes)
