"""Where the results of a job go: a `Writer` is a value, so the loop of Alg. 1 (train.py) knows of no files.

`run_folders` keeps everything in a folder per seed (store.py), `nothing` keeps nothing; a study's writer, which makes
one JSON of all seeds, is in runs/study.py, that of trackers in runs/tracked.py.
"""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import jax

from pegasus_jax.checks import RunError
from pegasus_jax.config import Config
from pegasus_jax.episode import Episode
from pegasus_jax.experiment import Successor
from pegasus_jax.runs import checkpoint, config_io, store
from pegasus_jax.runs.programs import gather, is_main_process
from pegasus_jax.task import Task
from pegasus_jax.types import RunState

Row = dict[str, Any]  # a trial of one seed in numbers, as in trials.jsonl


class Writer(NamedTuple):
    """What is done with the results of S seeds. Every process of a job calls each function; one of them writes."""

    begin: Callable[[int], None]  # before the first trial of this job: so many trials are done already
    ready: Callable[[RunState], None]  # the states [S, ...] before the first episode, where they have learned by then
    known: Callable[[int], list[Episode | None]]  # trial -> its episodes [S] that are kept already, None for others
    episode: Callable[[int, int, Episode, int], None]  # index of the seed, trial, episode, policy that ran (0: random)
    imagined: Callable[[int, Successor], None]  # trial, what its new policy is expected to do [S, ...]
    trial: Callable[[int, RunState, list[Row]], None]  # trial, the states after it [S, ...], a row a seed
    where: Callable[[int, int], str]  # index of the seed, trial -> what to call that episode in a message
    advice: Callable[[int], str]  # index of the seed -> what follows the message of an episode that failed
    problem: Callable[[str], None]  # hears why nothing can be learned; raises where the job is to end with that


def nothing(seeds: int) -> Writer:
    """Keeps nothing, says problems on standard error, and goes on: one seed's failure is not that of the others."""
    return Writer(
        begin=lambda done: None,
        ready=lambda states: None,
        known=lambda trial: [None] * seeds,
        episode=lambda index, trial, ran, policy: None,
        imagined=lambda trial, successor: None,
        trial=lambda trial, states, rows: None,
        where=lambda index, trial: f"the episode of trial {trial}, seed number {index + 1},",
        advice=lambda index: "",
        problem=lambda text: print(text, file=sys.stderr, flush=True),
    )


def run_folders(runs: dict[int, Path], config: Config, task: Task, command: str) -> Writer:
    """Everything in a folder per seed, `runs`, so that each can be resumed (store.py says what is in it).

    Called by who holds the folders' locks. `command` is what the user typed.
    """
    folders = list(runs.values())
    known = config_io.numbered(config, len(task.state_names))

    def begin(done: int) -> None:
        for seed, run in runs.items() if is_main_process() else ():
            config_io.save(replace(known, seed=seed), run / "config.yaml")
            store.note(run, command, done, task)
            store.write_trials(run, store.readable_trials(run)[0][:done])

    def ready(states: RunState) -> None:
        whole = gather(states)
        for index, run in enumerate(folders if is_main_process() else ()):
            checkpoint.save(run, 0, part(whole, index))

    def episode(index: int, trial: int, ran: Episode, policy: int) -> None:
        if is_main_process() and len(ran.trajectory.u):
            store.save_episode(folders[index], trial, ran.trajectory, task, policy=policy, ended=ran.ended)

    def imagined(trial: int, successor: Successor) -> None:
        for index, run in enumerate(folders if is_main_process() else ()):
            store.save_imagined(run, trial, part(successor.rollout, index), successor.cost[index])

    def trial(number: int, states: RunState, rows: list[Row]) -> None:
        whole = gather(states)
        for index, run in enumerate(folders if is_main_process() else ()):
            store.write_trials(run, [*store.trials(run), rows[index]])
            checkpoint.save(run, number, part(whole, index))

    return Writer(
        begin=begin,
        ready=ready,
        known=lambda trial: [store.load_episode(run, trial) for run in folders],
        episode=episode,
        imagined=imagined,
        trial=trial,
        where=lambda index, trial: str(store.episode_path(folders[index], trial)),
        advice=lambda index: f"; resume={folders[index]} goes on",
        problem=refuse,
    )


def together(first: Writer, second: Writer) -> Writer:
    """Both keep what is learned, the first one before the second; what is asked is answered by the first."""

    def both(name: str) -> Callable[..., None]:
        def call(*given: Any) -> None:
            for writer in (first, second):
                getattr(writer, name)(*given)

        return call

    return first._replace(**{name: both(name) for name in ("begin", "ready", "episode", "imagined", "trial")})


def refuse(text: str) -> NoReturn:
    """End the job: raises RunError with this line."""
    raise RunError(text)


def part(tree: Any, index: int) -> Any:
    """One seed's part of a tree of arrays [S, ...]."""
    return jax.tree.map(lambda leaf: leaf[index], tree)
