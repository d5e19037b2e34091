"""Line 3 of Alg. 1 as a job does it: the episodes of a trial, each durable before anything is learned from it."""

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import jax
import numpy as np

from pegasus_jax import episode, interrupt
from pegasus_jax.checks import RunError
from pegasus_jax.episode import Episode
from pegasus_jax.experiment import COLLECT, trial_keys
from pegasus_jax.math.circles import to_observation
from pegasus_jax.runs import store
from pegasus_jax.runs.job import Job
from pegasus_jax.runs.programs import gather, is_main_process, quick
from pegasus_jax.task import Task
from pegasus_jax.tasks import user_code
from pegasus_jax.types import RunState, Trajectory


def collected(job: Job, states: RunState, trial: int) -> tuple[list[Episode], np.ndarray]:
    """The episodes [S] of a trial: those that the writer has as they are, the others run on the plant and handed to it.

    And the trial [S] after which the policy was learned that runs in each; 0 for random controls.
    Raises RunError where one failed, after it was kept as far as it came, or is not made of finite numbers; and
    KeyboardInterrupt where a signal ended it.
    """
    task, known = job.experiment.task, job.writer.known(trial)
    missing = any(ran is None for ran in known)
    learned = gather(states.policy_trial)
    policies = np.zeros_like(learned) if job.random(trial) else learned
    last = job.config.trials  # the one more episode that a run may end with is shown as the end of its last trial
    job.display.phase(min(trial, last), "collect" if missing else "read", float(trial > last))
    if missing:
        # What was measured on an environment is stored before a signal is heard again.
        with interrupt.held() if task.environment is not None else nullcontext():
            known = gathered(job, states, trial, known, policies)
    episodes = []
    for index, ran in enumerate(ran for ran in known if ran is not None):
        finite = bool(np.isfinite(ran.trajectory.cost).all())
        episodes.append(ran if finite else costed(job, ran, trial))
        # A damaged file, or a cost that its user mended.
        if not finite and task.environment is None and is_main_process():
            where = job.writer.where(index, trial)
            job.display.line(f"{where} has costs that are not finite; counted again from its observations")
    return episodes, policies


def gathered(
    job: Job, states: RunState, trial: int, known: list[Episode | None], policies: np.ndarray
) -> list[Episode]:
    """The known episodes, and for those that are not, ones that are run on the plant and handed to the writer."""
    task, random = job.experiment.task, job.random(trial)
    keys = quick(trial_keys)(gather(states.key), trial, COLLECT)
    fresh = job.program.collect(keys, states.policy.params, random)
    for index, ran in enumerate(fresh):
        if known[index] is None:
            check_finite(job, ran.trajectory, trial)
            job.writer.episode(index, trial, ran, int(policies[index]))
            failed(ran, task, job.writer.advice(index))
    return [old if old is not None else new for old, new in zip(known, fresh, strict=True)]


def check_finite(job: Job, trajectory: Trajectory, trial: int) -> None:
    """Tell the writer, with trial and entry, of an episode that no model can learn from."""
    x = np.asarray(trajectory.x)
    for t, i in np.argwhere(~np.isfinite(x))[:1]:
        job.writer.problem(
            f"trial {trial}: {job.experiment.task.state_names[i]} is {x[t, i]} after {t} control periods of its"
            " episode; the plant's simulation diverged: a smaller time step or softer parts may help"
        )


def costed(job: Job, ran: Episode, trial: int) -> Episode:
    """The episode with its costs counted again: the user may have mended the cost.

    Where they are not finite then either, the writer is told, with trial and observation.
    """
    x = np.asarray(ran.trajectory.x)
    task = job.experiment.task
    cost = np.asarray(episode.costs(task, ran.trajectory))
    for (t,) in np.argwhere(~np.isfinite(cost))[:1]:
        seen = to_observation(x[t + 1], task.circles).tolist()
        found = f"the cost of the observation {seen} is {cost[t]}"
        job.writer.problem(f"trial {trial}: {found}; mend the cost")
    return ran._replace(trajectory=ran.trajectory._replace(cost=cost))


def costs_since(run: Path, task: Task, done: int, say: Callable[[str], None]) -> int:
    """The first trial with costs of today's function, of a run of which `done` trials are there; a change is told."""
    rows = store.readable_trials(run)[0][:done]
    if note := other_cost(run, task):
        say(note)
        return done + 1
    return store.cost_since(rows[-1]) if rows else 1


def other_cost(run: Path, task: Task) -> str | None:
    """What to say where an environment's newest episode costs something else today: its user has changed the cost."""
    stored = store.numbered(run / "episodes", ".npz")
    if task.environment is None or not stored:
        return None
    try:
        ran = store.load_episode(run, stored[-1])
    except RunError:  # whoever needs the damaged file tells
        return None
    if ran is None or not len(ran.trajectory.u):
        return None
    before, now = ran.trajectory.cost, np.asarray(episode.costs(task, ran.trajectory))
    if not np.isfinite(before).all() or np.allclose(before, now, rtol=1e-3, atol=1e-4):
        return None
    return (
        f"the episode of trial {stored[-1]} cost {np.mean(before):.3g} a step, and with today's cost"
        f" {np.mean(now):.3g}: those of trials 1 to {stored[-1]} were counted with another one, and no longer choose"
        " the best policy"
    )


def failed(ran: Episode, task: Task, advice: str = "", kept: bool = True) -> None:
    """Raise what ended an episode on an environment before its time: RunError in one line, or the signal itself."""
    if isinstance(ran.error, KeyboardInterrupt):
        raise ran.error
    if ran.error is not None:
        count = len(ran.trajectory.u)
        rows = f"; its {count} rows are kept" if kept and count else ""
        when = f"control period {count + 1}" if len(ran.trajectory.x) else "the reset"
        refused = f"{when} of an episode: {ran.error}"
        what = refused if user_code.is_refusal(ran.error) else f"an episode, {user_code.told(ran.error)}"
        raise RunError(f"{task.name} failed in {what}{rows}{advice}") from ran.error


def stacked(episodes: list[Episode], task: Task) -> Trajectory:
    """The episodes as one Trajectory [S, ...], each in arrays of H periods where the task may end early."""
    shaped = [episode.padded(ran.trajectory, task.horizon) if task.may_end else ran.trajectory for ran in episodes]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *shaped)
