"""The episodes that pegasus-run drove, on the page of their run."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from pegasus_jax.episode import CUT, verdict
from pegasus_jax.report.page import fold, table
from pegasus_jax.report.read import Look, Step
from pegasus_jax.report.trajectories import fans
from pegasus_jax.runs import driven
from pegasus_jax.runs.driven import Driven

HEAD = ("log", "policy", "time [s]", "cost", "success", "ended by", "late controls")
DRAWN = 5  # the newest ones


def section(found: Look) -> str:
    """A row for each episode, and charts of the newest over what was imagined of their policy."""
    if not found.driven:
        return ""
    words = (
        "<p>They are no data. The cost is the mean of a step, and success that of the last five steps, as of the run's"
        " own episodes.</p>"
    )
    folds = [
        fold(_title(one), fans(_step(found, one), one.task), name=f"driven-{one.number}") for one in _newest(found)
    ]
    return words + table(HEAD, [_row(one) for one in found.driven]) + "".join(folds)


def worth(episodes: Sequence[Driven]) -> str:
    """What driven episodes say of their policy, in words; those that a fault or a person cut short are only counted."""
    whole = [verdict(one.episode, one.task) for one in episodes if one.episode.ended not in CUT]
    times = "once" if len(episodes) == 1 else f"{len(episodes)} times"
    cut = f", {len(episodes) - len(whole)} of them cut short" if len(whole) < len(episodes) else ""
    cost, good = (np.array([one[name] for one in whole]) for name in ("episode_cost", "episode_success"))
    how = f": cost {cost.mean():.3f}, {good.sum()} of {len(whole)} succeeded" if whole else ""
    return f"driven {times} by pegasus-run{cut}{how}"


def _newest(found: Look) -> list[Driven]:
    return found.driven[: -DRAWN - 1 : -1]


def _step(found: Look, one: Driven) -> Step:
    return Step(one.number, one.policy, one.episode, found.fans.get(one.policy))


def _title(one: Driven) -> str:
    said = verdict(one.episode, one.task)
    return f'Log {one.number} <span class="soft">policy of trial {one.policy}, cost {said["episode_cost"]:.3f}</span>'


def _row(one: Driven) -> list[str]:
    said = verdict(one.episode, one.task)
    return [
        f"<code>{driven.FOLDER}/{one.number:04d}.npz</code>",
        f"trial {one.policy}",
        f"{len(one.episode.trajectory.u) * one.task.dt:g}",
        f"{said['episode_cost']:.3f}",
        "yes" if said["episode_success"] else "no",
        escape(one.episode.ended),
        str(one.overruns),
    ]
