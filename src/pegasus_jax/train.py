"""The main job: an experiment trial by trial, for one seed or many at once, leaving folders that survive anything."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh

from pegasus_jax import checkpoint, record, restore, settings
from pegasus_jax.board import Board
from pegasus_jax.build import build, set_precision
from pegasus_jax.checks import RunError, SettingError
from pegasus_jax.config import Config
from pegasus_jax.dataset import grow
from pegasus_jax.program import Program, fetched, leads
from pegasus_jax.progress import Display
from pegasus_jax.trial import COLLECT, EVALUATE, trial_key
from pegasus_jax.types import Experiment, Key, Params, RunState, Task, Trajectory

# What `improved` says of a trial that has not improved anything.
UNKNOWN: dict[str, Any] = {
    "fit_loss": None,
    "objective_first": None,
    "objective_last": None,
    "objective_fresh": None,
    "gradient_norm": None,
    "skipped_updates": 0,
}
UNMEASURED: dict[str, Any] = {"mean_cost": None, "success_rate": None}  # what `evaluate` says without episodes


def train(config: Config, run: Path, *, resume: bool = False, command: str = "") -> RunState:
    """Run (or go on with) `config` in the folder `run`, and return the state after its last trial.

    Killed at any moment and resumed, it ends bit-equal to an uninterrupted run: every trial's randomness is a function
    of seed and trial, finished episodes are read back, and a trial cut short is done again from the state before it.
    """
    return part(train_seeds(config, {config.seed: run}, resume=resume, command=command), 0)


def train_seeds(
    config: Config,
    runs: dict[int, Path],
    *,
    resume: bool = False,
    command: str = "",
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
            held.enter_context(record.lock(run, new=not resume))
            record.remove_unfinished(run)
        before = settings.load(folders[0] / "config.yaml") if resume else config
        if config.trials < before.trials:
            raise SettingError(f"trials={config.trials} is fewer than the run was made for; at least {before.trials}")
        set_precision(config)
        experiment = build(replace(config, seed=0), mesh)  # the seed is in the key, so that all share one program
        for run in folders if resume else ():
            restore.same(run, experiment.task)
        program = Program(experiment, config.search.steps, len(seeds), mesh)
        display = Display(config.trials, 0, quiet=not leads())
        states = restore.together(folders, experiment, display.line) if resume else None
        done = display.done = 0 if states is None else int(states.trial[0])
        if done < config.trials:
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
            settings.save(replace(config, seed=seed), run / "config.yaml")
            record.note(run, command, done, experiment.task)
            record.write_trials(run, record.readable_trials(run)[0][:done])
            boards.append(Board(run / "tensorboard", done + 1, display.line))
        with display.running():
            for trial in range(done + 1, config.trials + 1):
                with on_plant(experiment.task, f"; resume={folders[0]} goes on from trial {trial}"):
                    states, rows = one_trial(states, trial, config, folders, experiment, program, display)
                whole = fetched(states)
                for index, board in enumerate(boards):
                    record.write_trials(folders[index], [*record.trials(folders[index]), rows[index]])
                    board.add(rows[index])
                    checkpoint.save(folders[index], trial, part(whole, index))
                display.line(summary(rows, config.trials))
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
    display.phase(trial, "collect")
    episodes = collected(states, trial, config, runs, task, program)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *episodes)
    # Before this episode teaches the model, and after another has. No first trial should wait for the compiler.
    judged = trial > max(1, config.explore.trials)
    calibration = fetched(program("calibrate", states, stacked)) if judged else np.full(len(runs), np.nan)
    states, found = program("absorb", states, stacked), [UNKNOWN] * len(runs)
    if trial >= config.explore.trials:  # before that, the next episode is random, and needs no policy
        states, found = improved(states, trial, runs, stacked, program, display)
    display.phase(trial, "evaluate", 0.9)
    keys = jax.vmap(lambda key: trial_key(key, trial, EVALUATE))(fetched(states.key))
    evaluation = evaluate(keys, states.policy.params, task, program, config.evaluation)
    seconds = program.seconds()
    rows = [
        {
            "trial": trial,
            "plant_seconds": round(trial * task.horizon * task.dt, 6),
            "random": trial <= config.explore.trials,
            "episode_cost": restore.mean_cost(episode.cost),
            **evaluation[index],
            **found[index],
            "saturated": float(saturated(episode.u, task)),
            "calibration": known(calibration[index]),
            "seconds": seconds,
        }
        for index, episode in enumerate(episodes)
    ]
    return states, rows


def improved(
    states: RunState, trial: int, runs: Sequence[Path], stacked: Trajectory, program: Program, display: Display
) -> tuple[RunState, list[dict[str, Any]]]:
    """Fit, search, and imagine what comes; how it went, of each run."""
    display.phase(trial, "fit", 0.02)
    states, fitted = fetched_info(program("fit", states))
    found = []
    for i in range(program.chunks):
        cost = np.mean(found[-1].objective[:, -1]) if found else None
        display.phase(trial, "search", 0.1 + 0.8 * i / program.chunks, cost)
        states, searched = fetched_info(program("search", states, jnp.int32(i * program.chunk)))
        found.append(jax.tree.map(np.asarray, searched))
        program.prepare("imagine")  # once; not before the first of the search, for which everybody waits
        program.prepare("calibrate", stacked)
    objective, norm = (np.concatenate([getattr(f, name) for f in found], 1) for name in ("objective", "gradient_norm"))
    skipped = fitted.skipped + sum(f.skipped for f in found)
    imagined, imagined_cost = fetched(program("imagine", states))
    for index, run in enumerate(runs if leads() else ()):
        record.save_imagined(run, trial, part(imagined, index), imagined_cost[index])
    return states, [
        {
            "fit_loss": float(fitted.loss[index]),
            "objective_first": float(objective[index, 0]),
            "objective_last": float(objective[index, -1]),
            "objective_fresh": float(jnp.mean(imagined_cost[index])),
            "gradient_norm": float(np.median(norm[index])),
            "skipped_updates": int(skipped[index]),
        }
        for index in range(len(runs))
    ]


def collected(
    states: RunState, trial: int, config: Config, runs: Sequence[Path], task: Task, program: Program
) -> list[Trajectory]:
    """The episodes of a trial: those on disk as they are, the others run on the plant and made durable."""
    episodes = [record.load_episode(run, trial) for run in runs]
    if any(episode is None for episode in episodes):
        keys = jax.vmap(lambda key: trial_key(key, trial, COLLECT))(fetched(states.key))
        exploring = jnp.asarray(trial <= config.explore.trials)
        fresh = fetched(program("episode", keys, states.policy.params, exploring, purpose="collect"))
        for index, run in enumerate(runs):
            if episodes[index] is None:
                episodes[index] = part(fresh, index)
                if leads():
                    policy = 0 if trial <= config.explore.trials else trial - 1
                    record.save_episode(run, trial, part(fresh, index), task, policy=policy, ended="horizon")
    return [episode for episode in episodes if episode is not None]


@contextmanager
def on_plant(task: Task, advice: str = "") -> Iterator[None]:
    """What a plant on the host raises becomes one line, Ctrl-C itself; JAX would show a traceback of its insides."""
    logging.getLogger("jax._src.callback").setLevel(logging.CRITICAL)
    trouble: list[BaseException] = getattr(task.plant, "trouble", [])
    trouble.clear()
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if not trouble:
            raise
        cause = trouble[-1]
        if isinstance(cause, KeyboardInterrupt):
            raise cause from error
        where = "".join(f" ({note})" for note in getattr(cause, "__notes__", []))
        what = " ".join(f"{type(cause).__name__}: {cause}{where}".split())
        raise RunError(f"{task.name} failed in an episode, {what}{advice}") from error


def evaluate(keys: Key, params: Params, task: Task, program: Program, episodes: int) -> list[dict[str, Any]]:
    """Mean cost a step and success rate of each seed [S], over fresh episodes, not data (docs/reference.md 10)."""
    if not episodes:
        return [UNMEASURED] * len(keys)
    costs = program.evaluate(jax.vmap(lambda key: jax.random.split(key, episodes))(keys), params)
    return [
        {"mean_cost": float(np.mean(cost)), "success_rate": float(np.mean(success))}
        for cost, success in zip(costs, succeeded(costs, task), strict=True)
    ]


def succeeded(costs: Any, task: Task) -> np.ndarray:
    """Which episodes [...] of costs [..., H] succeeded: their last five steps cost little on average."""
    return np.mean(costs[..., -5:], axis=-1) < task.success


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
    with on_plant(experiment.task):
        (result,) = evaluate(keys, params, experiment.task, program, episodes)
    return {"trial": int(state.trial), "episodes": episodes, **result, "fingerprint": checkpoint.fingerprint(state)}


def summary(rows: Sequence[dict[str, Any]], trials: int) -> str:
    """A trial in one line; over several seeds the means, and the median calibration."""
    measured = rows[0]["mean_cost"] is not None
    names = ("mean_cost", "success_rate") if measured else ("episode_cost",)
    mean = {name: np.mean([row[name] for row in rows]) for name in names}
    imagined = [row["objective_last"] for row in rows if row["objective_last"] is not None]
    first, skipped = rows[0], sum(row["skipped_updates"] for row in rows)
    solved = sum(row["success_rate"] >= 0.9 for row in rows) if measured else 0
    errors = [row["calibration"] for row in rows if row["calibration"] is not None]
    return (
        f"trial {first['trial']:>2}/{trials}  {first['plant_seconds']:6.1f} s of plant"
        + (
            f"  cost {mean['mean_cost']:.3f}  success {mean['success_rate']:4.0%}"
            if measured
            else f"  cost of its episode {mean['episode_cost']:.3f}"
        )
        + (f"  imagined {np.mean(imagined):.3f}" if imagined else "")
        + (f"  calibration {np.median(errors):.1f}" if errors else "")
        + (f"  {solved} of {len(rows)} seeds solved" if measured and len(rows) > 1 else "")
        + f"  ({sum(first['seconds'].values()):.0f} s, {first['seconds']['compile']:.0f} s of it compiling)"
        + (f"  {skipped} updates skipped" if skipped else "")
    )
