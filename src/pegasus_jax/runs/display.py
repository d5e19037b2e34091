"""What a person reads while a command runs: what it will do, where it is, and how each trial went."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn

from pegasus_jax.config import Config, label, model_word
from pegasus_jax.runs.best import judging
from pegasus_jax.runs.trials_table import BLOCKS, PLAIN, best, count_solved, curves, solved, table
from pegasus_jax.shell import typed

# A phase, and what it is called. A trial that begins with `read` finds its episode on disk, for example after a kill.
PHASES = {
    "read": "reading its episode from disk",
    "collect": "running its episode",
    "fit": "fitting the model",
    "search": "searching a policy",
    "evaluate": "evaluating the policy",
}
# A compiled part of an experiment, and what it is called.
PARTS = {
    "init": "the start",
    "episode": "the episode",
    "add_episode": "the data set",
    "fit": "the fit",
    "search": "the search",
    "succeed": "the imagined rollouts",
    "calibrate": "the test of the model",
    "evaluate": "the evaluation",
}
BRIEF = 1.0  # [s] a phase that is shorter has no line in a log
SILENCE = 10.0  # [s] after so long a log has a line again
LATEST = 3  # so many trials say how long the next one takes
AROUND = 8  # lines of a terminal that the table leaves free
COMPILING = 0.1  # a trial that waits for the compiler for more than this part of its time says nothing of the next


class Display:
    """Shows where a run is: a live table on a terminal, elsewhere a line for every phase that takes a while.

    `phase` and `compiling` say what is being done, `trial` how one went, `line` prints a line that stays.
    """

    def __init__(self, trials: int, console: Console | None = None, quiet: bool = False) -> None:
        self.console = console or Console(file=sys.stderr, highlight=False, quiet=quiet)
        self.trials = trials
        self.exploring = "random controls"  # what drives the first episodes
        self.asks = False  # whether an episode may speak with a person, as a robot's reset does: the table makes room
        self.done: list[Sequence[dict[str, Any]]] = []  # the rows of each finished trial, one a seed
        self.first = 1  # the trial of the first policy that is kept: 0 where one is before the first episode
        self.what, self.stage, self.since = "preparing", "preparing", time.monotonic()
        self.said, self.spoke = "", self.since  # the last line of a log, and when
        self.clock = Clock()
        self.live: Live | None = None
        columns = (TextColumn("{task.description}"), BarColumn(bar_width=20), TextColumn("{task.fields[left]}"))
        self.progress = Progress(*columns, console=self.console, auto_refresh=False)
        self.task = self.progress.add_task(self.what, total=1.0, left="")

    @contextmanager
    def running(self) -> Iterator[Display]:
        """Keep the display up until the block ends."""
        if self.console.is_terminal:
            self._show_live()
            try:
                yield self
            finally:
                self._hide()
                if self.done:
                    self.console.print(table(self.done, self.trials))
            return
        over = threading.Event()
        speaker = threading.Thread(target=self._log, args=(over,), daemon=True)
        speaker.start()
        try:
            yield self
        finally:
            over.set()
            speaker.join(timeout=1.0)  # so that nothing follows what is said of the end

    def phase(self, trial: int, what: str, fraction: float = 0.0, note: str = "") -> None:
        """Trial `trial` is doing `what`; `fraction` of it is done, and `note` says how that goes."""
        self.clock.phase(trial, what)
        words = f"trial {trial}/{self.trials}  {PHASES.get(what, what)}{note}"
        self._show(words, fraction, stage=f"{trial} {what}")
        if self.asks and self.console.is_terminal:
            if what == "collect":
                self._hide()
                self.line(words)
            else:
                self._show_live()

    @contextmanager
    def compiling(self, part: str) -> Iterator[None]:
        """Say so while the caller waits for a part's compiled program, which happens once."""
        before, stage, said, began = self.what, self.stage, self.said, time.monotonic()
        self._show(f"compiling {PARTS.get(part, part)} (once)")
        try:
            yield
        finally:
            self.clock.compiled += time.monotonic() - began
            self._show(before, stage=stage)
            if said == stage:  # it had its line before, and has no second one
                self.said = said

    def trial(self, rows: Sequence[dict[str, Any]]) -> None:
        """A trial is done, with these rows, one a seed: a row of the table, or a line of a log."""
        self.done.append(rows)
        if not self.console.is_terminal:
            number = best(self.done, self.first) if len(rows) == 1 else None
            self.line(summary(rows, self.trials, number, self.exploring))
        elif note := "  ".join(filter(None, (limits(rows), skipped(rows)))):
            self.line(f"trial {rows[0]['trial']}: {note}")

    def line(self, text: str) -> None:
        """Print a line that stays."""
        self.spoke = time.monotonic()
        self.console.print(text, markup=False, soft_wrap=True)

    def _show(self, what: str, fraction: float | None = None, stage: str = "") -> None:
        stage = stage or what
        if stage != self.stage:
            self.stage, self.since = stage, time.monotonic()
        self.what = what
        self.progress.update(self.task, description=what, completed=fraction)

    def _show_live(self) -> None:
        if self.live is None:
            self.live = Live(get_renderable=self._now, console=self.console, transient=True)
            self.live.start()

    def _hide(self) -> None:
        """Take the table off the terminal; a Live that was stopped cannot go on, so the next one is another."""
        if self.live is not None:
            self.live.stop()
            self.live = None

    def _now(self) -> Group:
        """What a terminal shows: the trials that have room, their curves, the best so far, what is happening."""
        left = self.clock.left(self.trials)
        self.progress.update(self.task, left="" if left is None else f"about {duration(left)} left")
        parts: list[Any] = []
        if done := self.done:
            room = max(self.console.height - AROUND, 3)
            parts += [table(done[-room:], self.trials, max(len(done) - room, 0))]
            parts += [curves(done, BLOCKS if "utf" in self.console.encoding.lower() else PLAIN)]
            number = best(done, self.first) if len(done[0]) == 1 else None
            of_one = (
                "" if number is None else best_line([rows[0] for rows in done], number).replace("policy", "so far", 1)
            )
            parts += [of_one if len(done[0]) == 1 else solved(done[-1])]
        return Group(*parts, self.progress.get_renderable())

    def _log(self, over: threading.Event) -> None:
        """The lines of a log, printed by a thread because the phases themselves are at work."""
        while not over.wait(BRIEF / 4):
            now = time.monotonic()
            again, judging = self.stage == self.said, self.clock.trial > len(self.done) + 1
            # A trial that is still evaluated has its line before the next one does, if that takes no age.
            fresh = not (again or judging) and now - self.since > BRIEF and now - self.spoke > BRIEF
            if fresh or now - self.spoke > SILENCE:
                self.said = self.stage
                parts = [self.what, f"{duration(now - self.since)} so far" if again else ""]
                if (left := self.clock.left(self.trials)) is not None:
                    parts.append(f"about {duration(left)} left")
                self.line("  ".join(part for part in parts if part))


class Clock:
    """How long the trials take that say something of the next ones: no compiling, no episode from disk, a search."""

    def __init__(self) -> None:
        self.trial, self.began, self.phases = 0, time.monotonic(), set()
        self.compiled = 0.0  # [s] of this trial spent waiting for the compiler
        self.steady: list[float] = []  # [s] what such trials took, the newest last

    def phase(self, trial: int, what: str) -> None:
        """Trial `trial` is doing `what`."""
        if trial != self.trial:
            spent = time.monotonic() - self.began
            if "search" in self.phases and "read" not in self.phases and self.compiled <= COMPILING * spent:
                self.steady.append(spent)
            self.trial, self.began, self.compiled, self.phases = trial, time.monotonic(), 0.0, set()
        self.phases.add(what)

    def left(self, trials: int) -> float | None:
        """Seconds until the last of `trials` is done; None as long as no trial has shown it."""
        if not self.steady:
            return None
        one = float(np.mean(self.steady[-LATEST:]))
        return one * (trials - self.trial) + max(0.0, one - (time.monotonic() - self.began))


def duration(seconds: float) -> str:
    """A time that a person waits: "40 s", "5 min", "2.5 h"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 100 * 60 else f"{seconds / 3600:.1f} h"


def announcement(config: Config, home: Path, seeds: int = 1, done: int | None = None) -> str:
    """What a command will do, before it does anything: `done` trials of the run are there, None for a new one."""
    what = f"{label(config)}, model {model_word(config.model)}, policy {config.policy.kind}"
    several = f", {seeds} seeds" if seeds > 1 else ""
    if done is None:
        return f"learning {what}: {config.trials} trials{several}, folder {home}"
    return f"going on with {home}: {what}, {done} of {config.trials} trials are done{several}"


def devices() -> str:
    """Where JAX computes, in words."""
    import jax

    found = jax.devices()
    kind = "the CPU" if found[0].platform == "cpu" else found[0].device_kind
    return f"running on {kind}" + (f", {len(found)} devices" if len(found) > 1 else "")


def stopped(home: Path) -> str:
    """What a person who has stopped a run can do next."""
    if not (home / "config.yaml").exists() and not any(home.glob("seed*/config.yaml")):
        return f"stopped before the first trial of {home}; the same command begins again"
    if not any(home.glob("**/episodes/*.npz")):
        return f"stopped before the first episode had ended; {typed(['pegasus-train', f'resume={home}'])} goes on"
    return f"stopped; all rows of every episode are kept, {typed(['pegasus-train', f'resume={home}'])} goes on"


def summary(
    rows: Sequence[dict[str, Any]], trials: int, best: int | None = None, exploring: str = "random controls"
) -> str:
    """A trial in one line, from the row of each seed; of several seeds the means, and the median of the errors.

    `best` is the trial with the best policy so far, if that is known; `exploring` drives the first episodes.
    """
    first, several = rows[0], len(rows) > 1
    measured = first["mean_cost"] is not None
    errors = [row["calibration"] for row in rows if row["calibration"] is not None]
    parts = [
        f"trial {first['trial']:>2}/{trials}",
        f"{first['plant_seconds']:.1f} s of plant time",
        f"{executed(rows, exploring)}: cost {_mean(rows, 'episode_cost'):.3f}{outcome(rows)}",
        learned(rows),
        "" if best in (None, first["trial"], judged(first)) else f"best so far: trial {best}",
        f"{count_solved(rows)} of {len(rows)} seeds solved" if measured and several else "",
        f"model errors {np.median(errors):.1f} times as large as predicted" if errors else "",
        skipped(rows),
        limits(rows),
        waited(first["seconds"]),
    ]
    return " | ".join(part for part in parts if part)


def judged(row: dict[str, Any]) -> int:
    """The trial whose policy a row has measured: its own, where that was evaluated, else the one that just ran."""
    return row["trial"] if row["mean_cost"] is not None or "policy" not in row else row["policy"]


def waited(seconds: dict[str, float]) -> str:
    """How long a robot stands still until its next episode, and how much of that the compiler takes."""
    between = seconds["between_episodes"]
    # What is counted is the whole trial's, of which some was compiled before its episode: a part is never the larger.
    compiled = min(seconds["compile"], between)
    compiling = f", {compiled:.1f} s of them compiling" if compiled >= 0.05 else ""
    return f"{between:.1f} s until the next episode{compiling}"


def executed(rows: Sequence[dict[str, Any]], exploring: str) -> str:
    """Whose episode a trial's was: `policy` is the trial that learned the executed policy, 0 for what came before."""
    if "logs" in rows[0]:
        return f"{rows[0]['logs']} episodes of logs, {rows[0]['log_seconds']:g} s"
    policies = {row.get("policy", 0 if row["random"] else row["trial"] - 1) for row in rows}
    if policies == {0}:
        return f"episode of {exploring if rows[0]['random'] else 'the first policy'}"
    return f"episode by the policy of trial {policies.pop()}" if len(policies) == 1 else "episodes"


def outcome(rows: Sequence[dict[str, Any]]) -> str:
    """How a trial's episodes went, beside their cost: whether they succeeded, and what ended them early."""
    if "logs" in rows[0] or "ended" not in rows[0]:
        return ""
    if len(rows) > 1:
        return f", {sum(row['episode_success'] for row in rows)} of {len(rows)} succeeded"
    (row,) = rows
    early = "" if row["ended"] == "horizon" else f", {row['ended']} after {row['steps']} periods"
    return early if row["random"] else f"{early}, {'success' if row['episode_success'] else 'no success'}"


def learned(rows: Sequence[dict[str, Any]]) -> str:
    """What is known of the policy that a trial ends with: from its evaluation, and from imagined episodes."""
    parts = []
    if rows[0]["mean_cost"] is not None:
        parts += [f"cost {_mean(rows, 'mean_cost'):.3f}", f"success {_mean(rows, 'success_rate'):.0%}"]
    if (imagined := _mean(rows, "objective_fresh")) is not None:
        parts.append(f"imagined cost {imagined:.3f}")
    return f"{which_policy(rows)}: {', '.join(parts)}" if parts else ""


def which_policy(rows: Sequence[dict[str, Any]]) -> str:
    """What there is to say of the policies that go on: new ones, those that ran, or one that worked before that."""
    if all(row.get("policy") == 0 and row["objective_fresh"] is None for row in rows):
        return "first policy, before any search"
    if not all(row.get("replaced") is False for row in rows):
        return "new policy"
    back = rows[0].get("policy_next")
    return "policy kept" if len(rows) > 1 or back in (None, rows[0]["policy"]) else f"policy of trial {back} again"


def skipped(rows: Sequence[dict[str, Any]]) -> str:
    """How many updates of fit and search were not finite; "" for none."""
    count = sum(row.get("skipped_updates") or 0 for row in rows)
    return f"{count} updates skipped" if count else ""


def limits(rows: Sequence[dict[str, Any]]) -> str:
    """How a trial's episodes kept to the constraint, and how likely the policies break it; "" without one."""
    if "constraint_rows" not in rows[0]:
        return ""
    text = f"constraint broken at {_mean(rows, 'constraint_rows'):.0%} of the rows"
    expected = _mean(rows, "constraint_expected")
    return text if expected is None else f"{text}, expected in {expected:.0%} of the next policy's episodes"


def limits_line(rows: Sequence[dict[str, Any]]) -> str:
    """In how many of a run's episodes the constraint was broken, and how many ended early; "" without one."""
    broken = [row for row in rows if row.get("constraint_broken")]
    if not any("constraint_broken" in row for row in rows):
        return ""
    early = sum(row["ended"] == "terminated" for row in broken)
    return f"constraint broken in {len(broken)} of {len(rows)} episodes; {early} of these ended early"


def best_line(rows: Sequence[dict[str, Any]], trial: int) -> str:
    """The trial with the best policy of a run, and what its evaluation, or else its own episodes, say of it."""
    if all(row["objective_fresh"] is None for row in rows):
        return "no policy was learned: every episode explored"
    row = rows[trial - 1] if trial else {"mean_cost": None}  # 0: the policy that the first episode ran
    own = [other["episode_cost"] for other in judging(rows, trial)]
    if row["mean_cost"] is not None:
        return f"best policy: trial {trial} (success {row['success_rate']:.0%}, cost {row['mean_cost']:.3f})"
    known = f"cost {np.mean(own):.3f}, ran in {len(own)} episode{'s' * (len(own) > 1)}" if own else "not run yet"
    newest, ran = max(row.get("trial", 0) for row in rows), {row.get("policy") for row in rows}
    more = "" if newest in {trial, *ran} else f"; that of trial {newest} has not run yet: trial=last takes it"
    return f"best policy: trial {trial} ({known}){more}"


def _mean(rows: Sequence[dict[str, Any]], name: str) -> float | None:
    values = [row[name] for row in rows if row[name] is not None]
    return float(np.mean(values)) if values else None
