"""The main job: an experiment trial by trial, for one seed or many at once, leaving folders that survive anything."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh

from pegasus_jax import episode, interrupt, tasks
from pegasus_jax.builder import build, set_precision
from pegasus_jax.checks import RunError, SettingError
from pegasus_jax.config import Config
from pegasus_jax.experiment import COLLECT, EVALUATE, trial_key
from pegasus_jax.learn.data import grow
from pegasus_jax.runs import checkpoint, config_io, restore, store
from pegasus_jax.runs.display import Display, summary
from pegasus_jax.runs.programs import Program, fetched, leads
from pegasus_jax.runs.tensorboard import Board
from pegasus_jax.tasks import user_code
from pegasus_jax.types import Episode, Experiment, Key, Params, RunState, Task, Trajectory

# What `improved` says of a trial that has not improved anything.
UNKNOWN: dict[str, Any] = {
    "fit_loss": None,
    "objective_first": None,
    "objective_last": None,
    "objective_fresh": None,
    "objective_incumbent": None,
    "replaced": None,
    "gradient_norm": None,
    "skipped_updates": 0,
}
UNMEASURED: dict[str, Any] = {"mean_cost": None, "success_rate": None}  # what `evaluate` says without episodes


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
) -> RunState:
    """`train` for the seeds and folders of `runs`, all as one program; returns their states [S, ...].

    Each folder is what a run of that seed alone would leave, and can be resumed alone. The seeds share nothing but the
    clock: one that diverges leaves the others as they are. All go on from the newest trial that all have finished.
    With a `mesh` (mesh.py) of several devices the seeds are shared out among them; where several processes hold the
    devices, all call this together, see the same files, and the first one writes.
    """
    folders, seeds = list(runs.values()), list(runs)
    with ExitStack() as held:
        for run in folders if leads() else ():
            held.enter_context(store.lock(run, new=not resume))
            store.remove_unfinished(run)
        before = config_io.load(folders[0] / "config.yaml") if resume else config
        if config.trials < before.trials:
            raise SettingError(f"trials={config.trials} is fewer than the run was made for; at least {before.trials}")
        set_precision(config)
        experiment = build(replace(config, seed=0), mesh)  # the seed is in the key, so that all share one program
        held.callback(tasks.close, experiment.task)
        for run in folders if resume else ():
            restore.same(run, experiment.task)
        program = Program(experiment, config.search.steps, len(seeds), mesh)
        display = Display(config.trials, quiet=not leads())
        program.on_compile = held.enter_context(display.running()).compiling
        states = restore.together(folders, experiment, display.line) if resume else None
        done = 0 if states is None else int(states.trial[0])
        if (most := max([0, *(trial for run in folders for trial in checkpoint.available(run))])) > config.trials:
            raise RunError(
                f"{folders[0] / 'config.yaml'} has trials={config.trials}, and {most} are done; expected at least that"
            )
        if max(done + 1, config.explore.trials) <= config.trials:  # else no policy is searched
            program.prepare("search")
        keys = jnp.stack([jax.random.key(seed) for seed in seeds])
        if states is None:
            states = program("init", keys)
        elif (config.fit, config.search) != (before.fit, before.search) or any(
            learner.optimizer is None for learner in (states.model, states.policy)
        ):
            states = restore.suited(states, program("init", keys))
        room = config.trials * experiment.task.horizon
        if room > states.data.x.shape[1]:
            states = states._replace(data=jax.vmap(partial(grow, capacity=room))(states.data))
        multihost_utils.sync_global_devices("every process has read what there is")
        boards = []
        for seed, run in runs.items() if leads() else ():
            config_io.save(replace(config, seed=seed), run / "config.yaml")
            store.note(run, command, done, experiment.task)
            store.write_trials(run, store.readable_trials(run)[0][:done])
            boards.append(Board(run / "tensorboard", done + 1, display.line))
        for trial in range(done + 1, config.trials + 1):
            states, rows = one_trial(states, trial, config, folders, experiment, program, display)
            whole = fetched(states)
            for index, board in enumerate(boards):
                store.write_trials(folders[index], [*store.trials(folders[index]), rows[index]])
                board.add(rows[index])
                checkpoint.save(folders[index], trial, part(whole, index))
            display.line(summary(rows, config.trials))
        if final:
            display.phase(config.trials, "collect", 1.0)
            collected(states, config.trials + 1, config, folders, experiment.task, program, display.line)
    return states


def one_trial(
    states: RunState,
    trial: int,
    config: Config,
    runs: Sequence[Path],
    experiment: Experiment,
    program: Program,
    display: Display,
) -> tuple[RunState, list[dict[str, Any]]]:
    """Collect (or read back) episodes, absorb, improve, evaluate; a row a run for its trials.jsonl says how it went."""
    task = experiment.task
    on_disk = all(store.episode_path(run, trial).exists() for run in runs)
    display.phase(trial, "read" if on_disk else "collect")
    policies = np.asarray(fetched(states.policy_trial))
    episodes = collected(states, trial, config, runs, task, program, display.line)
    shaped = [episode.padded(ran.trajectory, task.horizon) if task.may_end else ran.trajectory for ran in episodes]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *shaped)
    # Before this episode teaches the model, and after another has. No first trial should wait for the compiler.
    judged = trial > max(1, config.explore.trials)
    calibration = fetched(program("calibrate", states, stacked)) if judged else np.full(len(runs), np.nan)
    states, found = program("absorb", states, stacked), [UNKNOWN] * len(runs)
    if trial >= config.explore.trials:  # before that, the next episode is random, and needs no policy
        states, found = improved(states, trial, runs, stacked, program, display)
    display.phase(trial, "evaluate", 0.9)
    keys = jax.vmap(lambda key: trial_key(key, trial, EVALUATE))(fetched(states.key))
    evaluation = evaluate(keys, states.policy.params, task, program, config.evaluation)
    random, rows_so_far = trial <= config.explore.trials, np.asarray(fetched(states.data.size))
    seconds = program.seconds()
    rows = [
        {
            "trial": trial,
            "plant_seconds": round(int(rows_so_far[index]) * task.dt, 6),
            "random": random,
            "policy": 0 if random else int(policies[index]),
            **episode.verdict(ran, task),
            "steps": len(ran.trajectory.u),
            "ended": ran.ended,
            **evaluation[index],
            **found[index],
            "saturated": float(saturated(ran.trajectory.u, task)),
            "calibration": known(calibration[index]),
            "seconds": seconds,
        }
        for index, ran in enumerate(episodes)
    ]
    return states, rows


def improved(
    states: RunState, trial: int, runs: Sequence[Path], stacked: Trajectory, program: Program, display: Display
) -> tuple[RunState, list[dict[str, Any]]]:
    """Fit, search, and imagine what comes; how it went, of each run.

    Raises RunError where no run's model, or no run's policy, could learn anything: nothing would follow from it.
    """
    display.phase(trial, "fit", 0.02)
    incumbents = states.policy.params
    states, fitted = fetched_info(program("fit", states))
    if not np.isfinite(fitted.loss).any():
        raise RunError(f"trial {trial}: the loss of the model's fit is {float(fitted.loss[0])}, so nothing was learned")
    found = []
    for i in range(program.chunks):
        cost = np.mean(found[-1].objective[:, -1]) if found else None
        display.phase(trial, "search", 0.1 + 0.8 * i / program.chunks, cost)
        states, searched = fetched_info(program("search", states, jnp.int32(i * program.chunk)))
        found.append(jax.tree.map(np.asarray, searched))
        program.prepare("succeed", incumbents)  # once; not before the first of the search, for which everybody waits
        program.prepare("calibrate", stacked)
    objective, norm = (np.concatenate([getattr(f, name) for f in found], 1) for name in ("objective", "gradient_norm"))
    if not np.any(np.isfinite(objective) & np.isfinite(norm)):
        raise RunError(
            f"trial {trial}: the imagined cost or its gradient is not finite in any iteration, so nothing was learned"
        )
    skipped = fitted.skipped + sum(f.skipped for f in found)
    states, successor = fetched_info(program("succeed", states, incumbents, purpose="imagine"))
    for index, run in enumerate(runs if leads() else ()):
        store.save_imagined(run, trial, part(successor.rollout, index), successor.cost[index])
    return states, [
        {
            "fit_loss": float(fitted.loss[index]),
            "objective_first": float(objective[index, 0]),
            "objective_last": float(objective[index, -1]),
            "objective_fresh": float(jnp.mean(successor.cost[index])),
            "objective_incumbent": known(successor.incumbent[index]),
            "replaced": bool(successor.replaced[index]),
            "gradient_norm": float(np.median(norm[index])),
            "skipped_updates": int(skipped[index]),
        }
        for index in range(len(runs))
    ]


def collected(
    states: RunState,
    trial: int,
    config: Config,
    runs: Sequence[Path],
    task: Task,
    program: Program,
    say: Callable[[str], None],
) -> list[Episode]:
    """The episodes of a trial: those on disk as they are, the others run on the plant and made durable.

    Raises RunError where one failed, which is on disk as far as it came, or is not made of finite numbers; and
    KeyboardInterrupt where a signal ended it.
    """
    episodes = [store.load_episode(run, trial) for run in runs]
    if any(ran is None for ran in episodes):
        # What was measured on an environment is stored before a signal is heard again.
        with interrupt.held() if task.environment is not None else nullcontext():
            episodes = gathered(states, trial, config, runs, task, program, episodes)
    counted = [costed(ran, task, trial) for ran in episodes if ran is not None]
    for run, ran, now in zip(runs, episodes, counted, strict=True) if task.environment is None else ():
        if now is not ran and leads():  # a damaged file, or a cost that its user has mended
            say(f"{store.episode_path(run, trial)} has costs that are not finite; counted again from its observations")
    return counted


def gathered(
    states: RunState,
    trial: int,
    config: Config,
    runs: Sequence[Path],
    task: Task,
    program: Program,
    known: Sequence[Episode | None],
) -> list[Episode | None]:
    """The known episodes, and for those that are not, ones that are run on the plant and made durable."""
    keys = jax.vmap(lambda key: trial_key(key, trial, COLLECT))(fetched(states.key))
    random = trial <= config.explore.trials
    fresh = program.collect(keys, states.policy.params, random)
    policies = np.asarray(fetched(states.policy_trial))
    for index, run in enumerate(runs):
        if known[index] is None:
            ran = fresh[index]
            finite(ran.trajectory, task, trial)
            if leads() and len(ran.trajectory.u):
                policy = 0 if random else int(policies[index])
                store.save_episode(run, trial, ran.trajectory, task, policy=policy, ended=ran.ended)
            failed(ran, task, f"; resume={run} goes on")
    return [old if old is not None else new for old, new in zip(known, fresh, strict=True)]


def finite(trajectory: Trajectory, task: Task, trial: int) -> None:
    """Raises RunError, which names trial and entry, for an episode that no model can learn from."""
    x = np.asarray(trajectory.x)
    for t, i in np.argwhere(~np.isfinite(x))[:1]:
        raise RunError(
            f"trial {trial}: {task.state_names[i]} is {x[t, i]} after {t} control periods of its episode;"
            " the plant's simulation diverged: a smaller time step or softer parts may help"
        )


def costed(ran: Episode, task: Task, trial: int) -> Episode:
    """The episode with its costs, which are counted again where they are not finite: the user may have mended the cost.

    Raises RunError, which names trial and observation, where they are not finite then either.
    """
    if np.isfinite(ran.trajectory.cost).all():
        return ran
    x = np.asarray(ran.trajectory.x)
    cost = np.asarray(jax.vmap(task.cost)(jnp.asarray(x[1:])))
    for (t,) in np.argwhere(~np.isfinite(cost))[:1]:
        raise RunError(f"trial {trial}: the cost of the observation {x[t + 1].tolist()} is {cost[t]}; mend the cost")
    return ran._replace(trajectory=ran.trajectory._replace(cost=cost))


def failed(ran: Episode, task: Task, advice: str = "") -> None:
    """Raise what ended an episode on an environment before its time: RunError in one line, or the signal itself."""
    if isinstance(ran.error, KeyboardInterrupt):
        raise ran.error
    if ran.error is not None:
        kept = f"; its {len(ran.trajectory.u)} rows are kept" if len(ran.trajectory.u) else ""
        raise RunError(f"{task.name} failed in an episode, {user_code.told(ran.error)}{kept}{advice}") from ran.error


def evaluate(keys: Key, params: Params, task: Task, program: Program, episodes: int) -> list[dict[str, Any]]:
    """Mean cost a step and success rate of each seed [S], over fresh episodes, not data (docs/reference.md 10)."""
    if not episodes:
        return [UNMEASURED] * len(keys)
    keys = jax.vmap(lambda key: jax.random.split(key, episodes))(keys)
    costs = program.evaluate(keys, params) if task.environment is None else driven(keys, params, task, program)
    return [
        {"mean_cost": float(np.mean(cost)), "success_rate": float(np.mean(success))}
        for cost, success in zip(costs, episode.succeeded(costs, task), strict=True)
    ]


def driven(keys: Key, params: Params, task: Task, program: Program) -> np.ndarray:
    """Costs [S, E, H] of episodes on an environment, the periods that an early end left out included."""
    costs = []
    for some in jnp.swapaxes(keys, 0, 1):
        for ran in program.collect(some, params, False, purpose="evaluate"):
            failed(ran, task)
            costs.append(episode.charged(ran.trajectory.cost, task))
    return np.reshape(costs, (keys.shape[1], keys.shape[0], task.horizon)).swapaxes(0, 1)


def saturated(u: Any, task: Task) -> np.ndarray:
    """Fraction of the controls [..., H, U] of episodes that are within 1 % of a limit [...]."""
    low, high = np.asarray(task.control_low), np.asarray(task.control_high)
    margin = 0.01 * (high - low)
    u = np.asarray(u)
    return np.mean((u < low + margin) | (u > high - margin), axis=(-2, -1))


def known(value: Any) -> float | None:
    """A number, or None for one that is not known: JSON has no NaN."""
    return None if np.isnan(value) else float(value)


def fetched_info(result: tuple[RunState, Any]) -> tuple[RunState, Any]:
    """The states where they lie, and the info on this process."""
    states, info = result
    return states, fetched(info)


def part(tree: Any, index: int) -> Any:
    """One seed's part of a tree of arrays [S, ...]."""
    return jax.tree.map(lambda leaf: leaf[index], tree)


def evaluate_run(
    run: Path,
    episodes: int,
    seed: int,
    trial: restore.Trial = restore.LAST,
    mjcf: str | None = None,
) -> dict[str, Any]:
    """How the policy of a trial does on its plant, and the run's fingerprint then.

    `mjcf` is where the model's file is now, if it is not where it was.
    """
    _, experiment, state = restore.ready(run, trial, mjcf)
    program = Program(experiment, 1)
    params = jax.tree.map(lambda leaf: leaf[None], state.policy.params)
    keys = jax.random.key(seed)[None]
    try:
        (result,) = evaluate(keys, params, experiment.task, program, episodes)
    finally:
        tasks.close(experiment.task)
    return {"trial": int(state.trial), "episodes": episodes, **result, "fingerprint": checkpoint.fingerprint(state)}
