"""The writer that tells trackers (trackers.py) what is learned, and remembers what each calls a run.

RUN/tracked.json    of a run that asks for trackers: {tracker: {known: what it calls the run, told: so many trials}}
"""

import json
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from pegasus_jax.checks import RunError
from pegasus_jax.config import Config
from pegasus_jax.runs import config_io, store, writers
from pegasus_jax.runs.files import write_json
from pegasus_jax.runs.programs import is_main_process
from pegasus_jax.runs.trackers import TRACKERS, Known, Opening, Say, Tracker
from pegasus_jax.runs.writers import Row, Writer
from pegasus_jax.task import Task

FILE = "tracked.json"
ALWAYS = ("tensorboard",)  # of a run that asks for none, without pictures, which take a second a trial

Draw = Callable[[Path, Task, int], Mapping[str, Path]]  # run, task, trial -> pictures of it, by name


class Told:
    """One tracker of one run, until it fails: whatever a service, a network or a disk raises, a run needs none."""

    def __init__(self, name: str, tracker: Tracker, trials: int, say: Say) -> None:
        self.known, self.trials = tracker.known, trials
        self._name, self._tracker, self._say = name, tracker, say

    def tell(self, row: Row, pictures: Mapping[str, Path]) -> None:
        """A trial's numbers and pictures."""

        def all_of_it(tracker: Tracker) -> None:
            tracker.trial(row)
            for name, file in pictures.items():
                tracker.picture(row["trial"], name, file)
            self.trials = row["trial"]

        self._do(all_of_it)

    def close(self) -> None:
        """Wait until it has everything."""
        self._do(lambda tracker: tracker.close())

    def _do(self, call: Callable[[Tracker], None]) -> None:
        if self._tracker is None:
            return
        try:
            call(self._tracker)
        except Exception as error:
            self._tracker = None
            self._say(f"track={self._name}: {line_of(error)}; going on without it")


def writer(
    runs: Mapping[int, Path],
    config: Config,
    task: Task,
    track: tuple[str, ...] | None,
    draw: Draw | None,
    say: Say,
    closing: ExitStack,
) -> Writer:
    """A writer that tells the trackers of every run; a run that goes on, and asks for none, has those it had before.

    Of trials that a tracker was not told, as the process was killed or the tracker is new, it is told at the beginning.
    Each is closed with `closing`. Where one cannot be opened, RunError is raised before anything moves.
    """
    told: dict[Path, dict[str, Told]] = {}
    draws: dict[Path, Draw | None] = {}  # of each run that asks for trackers

    def begin(done: int) -> None:
        for seed, run in runs.items() if is_main_process() else ():
            before = remembered(run)
            asks = track is not None or before is not None
            names = track if track is not None else tuple(ALWAYS if before is None else before)
            told[run], draws[run] = {}, draw if asks else None
            for name in names:
                known, trials = (before or {}).get(name, ({}, 0 if asks else done))
                trials = min(trials, done)
                opening = Opening(run, config_io.plain(config) | {"seed": seed}, trials + 1, known, say)
                told[run][name] = Told(name, opened(name, opening), trials, say)
                closing.callback(told[run][name].close)
            first = min((one.trials for one in told[run].values()), default=done)
            for row in store.trials(run)[first:done]:
                tell(run, row)
            if asks:
                keep(run, told[run])

    def trial(number: int, states: Any, rows: list[Row]) -> None:
        for run, row in zip(runs.values(), rows, strict=True) if is_main_process() else ():
            tell(run, row)
            if draws[run] is not None:
                keep(run, told[run])

    def tell(run: Path, row: Row) -> None:
        behind = [one for one in told[run].values() if one.trials < row["trial"]]
        pictures = drawn(draws[run], run, task, row["trial"], say) if behind else {}
        for one in behind:
            one.tell(row, pictures)

    return writers.nothing(len(runs))._replace(begin=begin, trial=trial)


def opened(name: str, opening: Opening) -> Tracker:
    """A tracker of a run. Raises RunError, in one line, where it cannot be opened."""
    try:
        return TRACKERS[name](opening)
    except Exception as error:
        other = " (WANDB_MODE=offline needs no account)" if name == "wandb" else ""
        raise RunError(
            f"track={name}: {line_of(error)}{other}; resume={opening.run} goes on with it, with track=none without it"
        ) from error


def drawn(draw: Draw | None, run: Path, task: Task, trial: int, say: Say) -> Mapping[str, Path]:
    """The pictures of a trial, none where they cannot be drawn."""
    try:
        return {} if draw is None else draw(run, task, trial)
    except (RunError, OSError) as error:
        say(f"the pictures of trial {trial} cannot be drawn: {line_of(error)}")
        return {}


def keep(run: Path, told: Mapping[str, Told]) -> None:
    """Write down what the trackers call a run, and how much they know of it."""
    write_json(run / FILE, {name: {"known": one.known, "told": one.trials} for name, one in told.items()})


def remembered(run: Path) -> dict[str, tuple[Known, int]] | None:
    """What `keep` wrote, of trackers that there are; None of a run that has asked for none. Raises RunError."""
    path = run / FILE
    if not path.exists():
        return None
    try:
        found = json.loads(path.read_bytes())
        return {name: (dict(one["known"]), int(one["told"])) for name, one in found.items() if name in TRACKERS}
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise RunError(f"{path} cannot be read; without it, resume={run} track=... begins a new run there") from error


def line_of(error: Exception) -> str:
    """What was raised, in one line."""
    return " ".join(str(error).split())[:300] or type(error).__name__
