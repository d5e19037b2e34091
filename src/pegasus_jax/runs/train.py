"""Alg. 1 trial by trial, for one seed or many at once: `learn` is its loop, `one_trial` and `improved` are its lines.

Whatever is learned goes to a `Writer` (writers.py): `train` keeps a folder per seed that survives anything, a study
(runs/study.py) one JSON of all seeds.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh

from pegasus_jax import episode
from pegasus_jax.config import Config, begins_with, first_search
from pegasus_jax.experiment import EVALUATE, trial_keys
from pegasus_jax.learn.fit import FitInfo
from pegasus_jax.learn.gradient import SearchInfo
from pegasus_jax.logs.read import Logged
from pegasus_jax.runs import begin, checkpoint, config_io, first, logged, restore, store, tracked, writers
from pegasus_jax.runs.beside import beside
from pegasus_jax.runs.collect import collected, costs_since, stacked
from pegasus_jax.runs.display import learned
from pegasus_jax.runs.evaluation import UNMEASURED, evaluate, kept_to, saturated
from pegasus_jax.runs.job import Job, first_states, opened
from pegasus_jax.runs.programs import Program, gather, is_main_process, quick
from pegasus_jax.runs.stuck import stuck, unforeseen
from pegasus_jax.runs.writers import Row, part
from pegasus_jax.task import Task
from pegasus_jax.types import RunState, Trajectory

Result = Callable[[], list[Row]]  # how a trial went, a row a seed; it may take a while

UNKNOWN: dict[str, Any] = {
    "fit_loss": None,
    "objective_first": None,
    "objective_last": None,
    "objective_fresh": None,
    "objective_incumbent": None,
    "replaced": None,
    "policy_next": None,
    "gradient_norm": None,
    "iterations": 0,
    "skipped_updates": 0,
}


def train(config: Config, run: Path, *, resume: bool = False, command: str = "", final: bool = False) -> RunState:
    """Run (or go on with) `config` in the folder `run`, and return the state after its last trial.

    With `final` the last policy runs for one more episode: the first of the next trial, should the run go on.

    Killed at any moment and resumed, it ends bit-equal to an uninterrupted run: every trial's randomness is a function
    of seed and trial, finished episodes are read back, and a trial cut short is done again from the state before it.
    """
    return part(train_seeds(config, {config.seed: run}, resume=resume, command=command, final=final), 0)


def train_seeds(
    config: Config,
    runs: dict[int, Path],
    *,
    resume: bool = False,
    command: str = "",
    final: bool = False,
    mesh: Mesh | None = None,
    logs: Sequence[Logged] | None = None,
    track: tuple[str, ...] | None = None,
    draw: tracked.Draw | None = None,
) -> RunState:
    """`train` for the seeds and folders of `runs`, all as one program; returns their states [S, ...].

    Each folder is what a run of that seed alone would leave, and can be resumed alone. The seeds share nothing but the
    clock: one that diverges leaves the others as they are. All go on from the newest trial that all have finished.
    With a `mesh` (sharding.py) of several devices the seeds are shared out among them; where several processes hold the
    devices, all call this together, see the same files, and the first one writes. `logs` are the episodes of the
    config's `data`, None where they are to be read; a run that goes on has copies of them. `track` are the trackers
    that are also told, with the pictures that `draw` draws; None: those of before, or the usual one (tracked.py).
    """
    folders = list(runs.values())
    with ExitStack() as held:
        for run in folders if is_main_process() else ():
            held.enter_context(store.lock(run, new=not resume))
            store.remove_unfinished(run)
            if not resume:
                begin.copy(config, run)
                first.copy(config, run)
        multihost_utils.sync_global_devices("what is begun with is copied")
        before = config_io.load(folders[0] / "config.yaml") if resume else config
        store.enough(config.trials, max([0, *(trial for run in folders for trial in checkpoint.available(run))]))
        begun = logged.of_run(config, folders[0]) if resume else logged.of_config(config, logs)
        closing = held.enter_context(ExitStack())  # of trackers, which may wait for a network: a robot is closed before
        job = held.enter_context(opened(config, list(runs), mesh, begun, folders[0]))
        task, say = job.experiment.task, job.display.line
        for run in folders if begun.rows and not resume and is_main_process() else ():
            logged.save(run, begun.episodes(), task)
        for run in folders if resume else ():
            restore.same(run, task, config)
        stored = restore.together(folders, job.experiment, say) if resume else None
        done = None if stored is None else int(stored.trial[0])
        job = job._replace(cost_since=[costs_since(run, task, done, say) for run in folders if done])
        states = first_states(job, stored, changed=(config.fit, config.search) != (before.fit, before.search))
        if stored is None:
            states = begin.begun(states, config, folders[0])
        job.display.done += zip(*(store.readable_trials(run)[0][: int(done or 0)] for run in folders), strict=False)
        multihost_utils.sync_global_devices("every process has read what there is")
        others = tracked.writer(runs, config, task, track, draw, say, closing)
        job = job._replace(writer=writers.together(writers.run_folders(runs, config, task, command), others))
        states = learn(job, states, done)
        if final:
            collected(job, states, config.trials + 1)
    return states


def learn(job: Job, states: RunState, done: int | None = None) -> RunState:
    """Alg. 1: the states [S, ...] after the last trial of the config, `done` trials of which have been done before.

    None: not even what comes before the first episode. Raises RunError where the job's writer does not go on after a
    problem; an episode that was kept is never lost.
    """
    job.writer.begin(done or 0)
    if done is None and first_search(job.config) == 0 and not job.logs.rows:
        states, found = improved(job, states, 0)
        job.display.line(f"before the first episode  {learned([UNMEASURED | row for row in found])}")
    if first_search(job.config) == 0 or begins_with(job.config, "policy"):
        job.display.first = 0
        if done is None:
            job.writer.ready(states)
    before: list[Row] = []
    told: list[str] = []  # once
    changed = [{"cost_since": since} if since > 1 else {} for since in job.cost_since or [1] * len(job.seeds)]

    def kept(trial: int, states: RunState, result: Result) -> None:
        rows = [row | since for row, since in zip(result(), changed, strict=True)]
        job.writer.trial(trial, states, rows)
        job.display.trial(rows)
        news = [] if told else unforeseen(rows, job.experiment.task)
        told.extend(news)
        for line in [*stuck(before, rows), *news]:
            job.display.line(line)
        before[:] = [] if "logs" in rows[0] else rows

    # A robot is driven by this process: nothing may hold up its control periods.
    with beside(job.program.concurrent and job.experiment.task.environment is None) as in_background:
        for trial in range((done or 0) + 1, job.config.trials + 1):
            in_background.check()
            states, result = one_trial(job, states, trial)
            in_background(partial(kept, trial, states, result))
        job.display.phase(job.config.trials, "evaluate", 0.9)
    return states


def one_trial(job: Job, states: RunState, trial: int) -> tuple[RunState, Result]:
    """One round of Alg. 1 for every seed, and a function that makes its rows: the next episode does not wait for it."""
    if trial == 1 and job.logs.rows:
        return of_logs(job, states)
    config, task, program = job.config, job.experiment.task, job.program
    # Line 3: run the policy on the plant.
    episodes, policies = collected(job, states, trial)
    ended, trajectories, before = time.monotonic(), stacked(episodes, task), states
    # Line 4: add the episode to the data.
    states, found = program("add_episode", states, trajectories), [unknown(task)] * len(episodes)
    # Lines 5 and 6: fit the model, search a policy; not where the next episode is random too.
    if trial >= config.explore.trials:
        states, found = improved(job, states, trial, trajectories)
    evaluation = evaluated(job, states, trial, ended)

    def rows() -> list[Row]:
        measured, seconds = evaluation()
        # By the model before this episode, where it has learned from an earlier one.
        judged, aside = trial > first_search(config), program.aside()
        calibration = gather(aside("calibrate", before, trajectories)) if judged else np.full(len(episodes), np.nan)
        sizes = gather(states.data.size)
        return [
            {
                "trial": trial,
                "plant_seconds": round((int(sizes[index]) - job.logs.rows) * task.dt, 6),
                "random": job.random(trial),
                "policy": int(policies[index]),
                **episode.verdict(ran, task),
                "steps": len(ran.trajectory.u),
                "ended": ran.ended,
                **measured[index],
                **found[index],
                **kept_to(ran, task),
                **saturated(ran.trajectory.u, task),
                "calibration": known(calibration[index]),
                "seconds": seconds,
            }
            for index, ran in enumerate(episodes)
        ]

    return states, rows


def of_logs(job: Job, states: RunState) -> tuple[RunState, Result]:
    """Trial 1 of a run that begins with logs: they become data, then all goes on as after an episode."""
    config, task = job.config, job.experiment.task
    job.display.phase(1, "read")
    logs, ended = job.logs.episodes(), time.monotonic()
    states, found = logged.added(states, logs, job.experiment), [unknown(task)] * len(job.seeds)
    if config.explore.trials < 2:
        states, found = improved(job, states, 1)
    evaluation = evaluated(job, states, 1, ended)

    def rows() -> list[Row]:
        measured, seconds = evaluation()
        own = {"trial": 1, "plant_seconds": 0.0, "random": False, "policy": 0, **logged.told(logs, task)}
        controls = np.concatenate([one.trajectory.u for one in logs])
        rest = {**saturated(controls, task), "calibration": None, "seconds": seconds}
        return [{**own, **worth, **learned, **rest} for worth, learned in zip(measured, found, strict=True)]

    return states, rows


def evaluated(job: Job, states: RunState, trial: int, ended: float) -> Callable[[], tuple[list[Row], dict[str, float]]]:
    """() -> (what the policies [S] are worth after a trial, by episodes that are not data; the trial's seconds).

    It is to be called when the next episode may begin; `ended` is when the last one did. An environment is one object,
    whose episodes do not overlap: there the next episode waits for the evaluation.
    """
    task, program, count = job.experiment.task, job.program, job.config.eval_episodes

    def measured(program: Program) -> list[Row]:
        keys = quick(trial_keys)(gather(states.key), trial, EVALUATE)
        return evaluate(keys, states.policy.params, task, program, count)

    now = None
    if task.environment is not None and count:
        job.display.phase(trial, "evaluate", 0.9)
        now = measured(program)
    spent = program.seconds()

    def told() -> tuple[list[Row], dict[str, float]]:
        waited, aside = round(time.monotonic() - ended, 3), program.aside()
        found = measured(aside) if now is None else now
        later = aside.seconds()["evaluate"]
        return found, spent | {"evaluate": spent["evaluate"] + later, "between_episodes": waited}

    return told


def unknown(task: Task) -> dict[str, Any]:
    """What `improved` says of a trial that has not improved anything."""
    return UNKNOWN if task.constraint is None else UNKNOWN | {"constraint_expected": None}


def improved(
    job: Job, states: RunState, trial: int, trajectories: Trajectory | None = None
) -> tuple[RunState, list[Row]]:
    """Fit, search, and imagine what comes (lines 5 and 6 of Alg. 1); how it went, of each seed.

    `trajectories` are the trial's own; None: it is 0, before the first episode, and a model without data is not fitted.
    Where no seed's model, or no seed's policy, could learn anything, the writer is told.
    """
    program, phase = job.program, job.display.phase
    phase(trial, "fit", 0.02)
    incumbents, none = states.policy.params, np.zeros(len(job.seeds))
    fitted = FitInfo(*(none,) * len(FitInfo._fields))  # type: ignore[arg-type]
    if gather(states.data.size).any():
        states, fitted = program("fit", states)
        fitted = gather(fitted)
    if not np.isfinite(fitted.loss).any():
        loss = float(fitted.loss[0])
        job.writer.problem(f"trial {trial}: the loss of the model's fit is {loss}, so nothing was learned")
    found = []
    for i in range(program.chunks):
        so_far = f", imagined cost {np.mean(last(found)):.3f}" if found else ""
        note = f", step {i * program.chunk} of at most {program.chunks * program.chunk}{so_far}"
        phase(trial, "search", 0.1 + 0.8 * i / program.chunks, note)
        states, searched = program("search", states, np.int32(i * program.chunk))
        found.append(gather(searched))
        if (iterations(found[-1:]) < program.chunk).all():  # all are done
            break
        program.prepare("succeed", incumbents)  # once; not before the first of the search, for which everybody waits
        if trajectories is not None:
            program.prepare("calibrate", trajectories)
    objective, norm = (np.concatenate([getattr(f, name) for f in found], 1) for name in ("objective", "gradient_norm"))
    if not np.any(np.isfinite(objective) & np.isfinite(norm)):
        lost = "the imagined cost or its gradient is not finite in any iteration"
        job.writer.problem(f"trial {trial}: {lost}, so nothing was learned")
    reached, done = last(found), iterations(found)
    skipped = fitted.skipped + sum(f.skipped for f in found)
    states, successor = program("succeed", states, incumbents, purpose="imagine")
    successor, goes_on = gather((successor, states.policy_trial))
    job.writer.imagined(trial, successor)
    return states, [
        {
            "fit_loss": float(fitted.loss[index]),
            "objective_first": float(objective[index, 0]),
            "objective_last": float(reached[index]),
            "objective_fresh": float(np.mean(successor.cost[index])),
            "objective_incumbent": known(successor.incumbent[index]),
            "replaced": bool(successor.replaced[index]),
            "policy_next": int(goes_on[index]),
            "gradient_norm": float(np.median(norm[index, : done[index]])),
            "iterations": int(done[index]),
            "skipped_updates": int(skipped[index]),
            **({} if successor.chance is None else {"constraint_expected": float(successor.chance[index])}),
        }
        for index in range(len(skipped))
    ]


def iterations(found: Sequence[SearchInfo]) -> np.ndarray:
    """How many iterations of a search the seeds [S] have done, of which `found` are the parts."""
    return np.sum([f.objective.shape[1] + 0 * f.skipped if f.iterations is None else f.iterations for f in found], 0)


def last(found: Sequence[SearchInfo]) -> np.ndarray:
    """The objective of the last iteration that the seeds [S] have done."""
    objective = np.concatenate([f.objective for f in found], 1)
    return np.take_along_axis(objective, iterations(found)[:, None] - 1, 1)[:, 0]


def known(value: Any) -> float | None:
    """A number, or None for one that is not known: JSON has no NaN."""
    return None if np.isnan(value) else float(value)
