"""A run's environment, driven by its exported policy: on time, watched, and logged."""

import gc
import runpy
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from pegasus_jax import interrupt, tasks
from pegasus_jax.checks import ConfigError, RunError, check_range
from pegasus_jax.episode import Episode, costs, drive, mean_cost, padded
from pegasus_jax.exports.asked import asking
from pegasus_jax.exports.watchdog import Watchdog
from pegasus_jax.exports.write import export
from pegasus_jax.runs import driven, restore, store
from pegasus_jax.runs.collect import failed
from pegasus_jax.runs.files import write_whole
from pegasus_jax.task import Task
from pegasus_jax.tasks.terms import asked_names
from pegasus_jax.types import Trajectory

SLACK = 0.1  # of a period, by which a control may follow the one before it too late


class Drive(NamedTuple):
    """An episode that was driven, and how well it kept its time."""

    log: Path
    episode: Episode
    period: float  # [s]
    times: np.ndarray  # [L] when each control was sent [s], from the first on
    cost: float  # mean of a step, as of the run's own episodes

    @property
    def longest(self) -> float:
        """The longest time from one control to the next [s]."""
        return float(np.diff(self.times).max(initial=0.0))

    @property
    def overruns(self) -> int:
        """How many controls were sent more than a tenth of a period late."""
        return overruns(self.times, self.period)


def overruns(times: np.ndarray, period: float) -> int:
    """How many of these times [s] follow the one before them by more than a period and its slack."""
    return int(np.sum(np.diff(times) > (1 + SLACK) * period))


def drives(
    run: Path,
    trial: restore.Trial = restore.BEST,
    *,
    episodes: int = 1,
    seed: int = 0,
    seconds: float | None = None,
    watchdog: float | None = None,
) -> Iterator[Drive]:
    """Drive the environment of a run by its exported policy, and log each episode in RUN/driven.

    An episode takes as long as those of the run, or `seconds`. The watchdog stops it where no control was sent for so
    many seconds: five periods, and at least half a second, where that is None. Raises ConfigError for a task without an
    environment, and RunError where an episode failed; its rows are logged.
    """
    _, experiment, state = restore.ready(run, trial)
    task = experiment.task
    if task.environment is None:
        raise ConfigError(f"task={task.name} has no environment to drive; pegasus-eval RUN runs its simulation")
    limit = max(0.5, 5 * task.dt) if watchdog is None else watchdog
    check_range("watchdog", limit, task.dt, open_low=True)
    task = task._replace(horizon=task.horizon if seconds is None else max(1, round(seconds / task.dt)))
    print(restore.chosen(run, trial, int(state.trial)), file=sys.stderr)
    print(f"preparing the controller of trial {int(state.trial)}; nothing moves yet", file=sys.stderr, flush=True)
    with tempfile.TemporaryDirectory() as folder:
        control = runpy.run_path(str(export(run, int(state.trial), out=Path(folder) / "policy.py")))["Controller"]()
    cost_of = _counting(task)
    gc.freeze()  # nothing that is there is looked at by the garbage collector while the robot moves
    try:
        with driven.locked(run):  # two would write the same log
            for number in range(episodes):
                control.reset()
                with interrupt.held():  # a log is written before a signal is heard again
                    done = _driven(run, task, control, cost_of, int(state.trial), seed + number, limit)
                yield done
    finally:
        tasks.close(task)
        gc.unfreeze()


def _announced(task: Task, trial: int, limit: float) -> str:
    """What drives, said directly before it does: the reset may move a robot already."""
    limits = zip(task.control_names, task.control_low, task.control_high, strict=True)
    sent = ", ".join(f"{name} from {low:g} to {high:g}" for name, low, high in limits)
    period = f"every {task.dt:g} s for {task.horizon * task.dt:g} s, watchdog {limit:g} s"
    return f"the policy of trial {trial} drives {task.name}: {', '.join(task.state_names)} -> {sent}; {period}"


def _counting(task: Task) -> Callable[[Trajectory], np.ndarray]:
    """The costs [L] of an episode of L <= H periods, compiled now: a robot that has moved waits to be closed."""
    jitted = jax.jit(partial(costs, task))

    def cost_of(rows: Trajectory) -> np.ndarray:
        return np.asarray(jitted(padded(rows, task.horizon)), np.float32)[: len(rows.u)]

    states, controls = len(task.state_names), len(task.control_names)
    memory: Any = np.zeros(len(task.memory.names), np.float32) if asked_names(task) else None
    cost_of(Trajectory(*(np.zeros(shape, np.float32) for shape in ((1, states), (0, controls), 0)), memory=memory))  # type: ignore[arg-type]
    return cost_of


def _driven(
    run: Path,
    task: Task,
    control: Callable[[Any], np.ndarray],
    cost_of: Callable[[Trajectory], np.ndarray],
    policy: int,
    seed: int,
    limit: float,
) -> Drive:
    """One episode, logged. Raises RunError, or the signal, where it failed."""
    log = driven.path_of(run, 1 + max(store.numbered(run / driven.FOLDER, ".npz"), default=0))
    times: list[float] = []
    rows: list[Any] = []
    act, memories = asking(control, task, seed)

    def save(ran: Episode) -> Drive:
        first: Any = np.asarray(memories[0], np.float32) if memories else None
        ran = ran._replace(trajectory=ran.trajectory._replace(memory=first))
        drove = len(ran.trajectory.u) > 0
        cost = cost_of(ran.trajectory) if drove else np.zeros(0, np.float32)
        kept = ran._replace(trajectory=ran.trajectory._replace(cost=cost))  # type: ignore[arg-type]
        done = Drive(
            log,
            kept,
            task.dt,
            np.array(times[: len(ran.trajectory.u)]) - (times[0] if times else 0),
            mean_cost(kept, task) if drove else float("nan"),
        )
        if len(done.times):
            _write(run, done, task, policy)
        return done

    def last_words() -> str:
        """What is known of an episode whose environment hangs."""
        x, u = [rows[0], *(x for x, _ in rows[1:])], [u for _, u in rows[1:]]
        size = len(task.control_names)
        save(Episode(Trajectory(np.array(x), np.array(u).reshape(-1, size), np.zeros(0)), "interrupted"))  # type: ignore[arg-type]
        return _stopped(task, limit, len(u), log)

    print(_announced(task, policy, limit), file=sys.stderr, flush=True)
    with Watchdog(limit, task.environment.close, last_words) as watch:
        on_time = task._replace(environment=timed(task.environment, task.dt, times, rows, watch.beat))
        ran = drive(seed, act, on_time)
    done = save(ran)
    if watch.fired:
        raise RunError(_stopped(task, limit, len(done.times), log))
    failed(ran, task, f" in {log}" if len(done.times) else "")
    return done


def timed(environment: Any, period: float, times: list[float], rows: list[Any], beat: Callable[[], None]) -> Any:
    """The environment, each of whose controls is sent when it is due: one period after the one before it, or late."""
    due = 0.0

    def reset(seed: int) -> np.ndarray:
        x = environment.reset(seed)
        rows.append(x)
        return x

    def step(control: np.ndarray) -> tuple[Any, ...]:
        nonlocal due
        now = time.monotonic()
        if times and now < due:
            time.sleep(due - now)
            now = time.monotonic()
        times.append(now)
        beat()
        # After a late one the clock begins again: two controls never follow each other faster than usual to catch up.
        due = period + (due if len(times) > 1 and now - due < SLACK * period else now)
        answer = environment.step(control)
        rows.append(answer[:2])
        return answer

    def rest() -> None:
        beat()  # it may take as long as a control may
        environment.rest()

    return environment._replace(reset=reset, step=step, rest=rest)


def _write(run: Path, done: Drive, task: Task, policy: int) -> None:
    """Write a log: an episode as those of the run, with `time` [L] and `overruns` besides."""
    number = int(done.log.stem)
    arrays = store.episode_arrays(run, number, done.episode.trajectory, task, policy=policy, ended=done.episode.ended)
    timing = {"time": done.times, "overruns": done.overruns}
    write_whole(done.log, lambda file: np.savez(file, **arrays, **timing))  # type: ignore[arg-type]


def _stopped(task: Task, limit: float, rows: int, log: Path) -> str:
    kept = f"its {rows} rows are kept in {log}"
    return f"{task.name} was given no control for {limit:g} s, so the watchdog closed it; {kept}"
