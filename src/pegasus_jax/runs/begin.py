"""What a run takes over from another one, `init=RUN`: copied into its folder before anything else is in it.

RUN/init/config.yaml, run.json, checkpoints/NNNN    of the other run, which may then be deleted

first.py copies the run of explore.policy= in the same way.
"""

import re
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax.checks import ConfigError, RunError, shown
from pegasus_jax.config import Config, begins_with
from pegasus_jax.experiment import Experiment
from pegasus_jax.math.units import parted
from pegasus_jax.memory import seen_kinds, seen_names
from pegasus_jax.runs import checkpoint, config_io, logged, restore, store
from pegasus_jax.task import Task
from pegasus_jax.types import RunState, TrainState

FOLDER = "init"
NUMBERED = r"(rate of )?(atan2\()?([xu]|qpos\.|qvel\.)\d+(, x\d+\))?"  # a name that nobody gave


def source(init: str) -> tuple[Path, int]:
    """The folder and the trial that init=RUN@TRIAL names, the best of init=RUN. Raises ConfigError, in one line."""
    run, text = logged.named(init)
    trial = text if "@" in init else restore.BEST
    if trial not in (restore.LAST, restore.BEST) and not trial.isdecimal():
        raise ConfigError(f"init={init} names no trial: expected a number, best or last after @, as init=runs/sim@best")
    return run, numbered(run, trial, f"init={init}")


def numbered(run: Path, trial: str, what: str) -> int:
    """The number of a run's trial, "last" and "best" too. Raises ConfigError, beginning with `what`, for no run."""
    try:
        number = restore.best(store.existing(run)) if trial == restore.BEST else trial
    except RunError as error:
        raise ConfigError(f"{what}: {error}") from error
    return max(checkpoint.available(run), default=0) if number == restore.LAST else int(number)


def read(run: Path, trial: restore.Trial, what: str) -> tuple[Config, Experiment, RunState]:
    """`restore.restored`, whose errors begin with `what`: the run's task is that of its folder, nothing is imported."""
    try:
        return restore.restored(run, trial)
    except RunError as error:
        raise ConfigError(f"{what}: {error}") from error


def checked(config: Config, task: Task) -> list[str]:
    """What to say of init=: one line each. Raises ConfigError, in one line that names both, where it does not suit."""
    if config.init is None:
        return []
    run, trial = source(config.init)
    what, learned = f"init={config.init}", [one for one in config.init_parts if one != "data"]
    old, other, _ = read(run, trial, what)
    theirs = other.task
    suits(what, task, theirs, more=remembered(old, config))
    mine, its = (", ".join(seen_names(one)) for one in (task, theirs))
    if learned and seen_kinds(task) != seen_kinds(theirs):
        why = remembered(old, config) or (
            "; give both runs the same sensors.*, history= and control_rate=, and a cost= that takes as many of u,"
            " previous_u, t, reference and goal"
        )
        raise ConfigError(f"{what} has a policy that sees {its}, and here it would see {mine}{why}")
    both = [config_io.numbered(one, len(task.state_names)) for one in (old, config)]
    for part in learned:  # data are checked as logs are
        its, mine = (config_io.leaves(getattr(one, part), f"{part}.") for one in both)
        for name in its:
            if its[name] != mine.get(name):
                hint = f"policy={its[name]}" if name == "policy.kind" else f"{name}={shown(its[name])}"
                raise ConfigError(
                    f"{what} has {name}={shown(its[name])}, and this run {shown(mine.get(name))}; give {hint}"
                )
    if "model" in config.init_parts and (old.prior is None) != (config.prior is None):
        raise ConfigError(
            f"{what} has prior={shown(old.prior)}, and this run {shown(config.prior)}; give init_parts=[policy]"
        )
    parts = [f"the {' and '.join(learned)} of trial {trial}"] * bool(learned)
    parts += ["all episodes"] * begins_with(config, "data")
    random = max(0, config.explore.trials - logged.has(config))  # logs take the place of the first
    first = f"{random} random episodes come first" if random else "no episode is random"
    notes = [
        f"{what}: begins with {' and '.join(parts)} of {theirs.name}; {first} (explore.trials={config.explore.trials})"
    ]
    return [*notes, *otherwise(task, theirs)]


def suits(what: str, task: Task, theirs: Task, observed: bool = False, more: str = "") -> None:
    """Raises ConfigError where another run's policy cannot act on a task: other numbers, angles or order.

    With `observed` it is given the observation, and knows itself which of that are angles.
    """

    def facts_of(one: Task) -> list[str]:
        angles = [] if observed else [f"angles={shown(list(one.angles))}"]
        states = one.observed if observed else len(one.state_names)
        return [f"{states} states", f"{len(one.control_names)} controls", *angles]

    for its, mine in zip(facts_of(theirs), facts_of(task), strict=True):
        if its != mine:
            raise ConfigError(f"{what} is of {theirs.name} with {its}, and {task.name} has {mine}{more}")
    for its, mine in zip(_names(theirs), _names(task), strict=True):
        for form in (lambda name: name, lambda name: parted(name)[0]):  # units may be said by one of them only
            one, other = [*map(form, its)], [*map(form, mine)]
            if one != other and sorted(one) == sorted(other):
                raise ConfigError(
                    f"{what} is of {theirs.name} with {', '.join(its)}, and {task.name} has {', '.join(mine)}: expected"
                    " the same order"
                )


def _names(task: Task) -> tuple[tuple[str, ...], tuple[str, ...]]:
    return task.state_names, task.control_names


def otherwise(task: Task, theirs: Task) -> list[str]:
    """Notes on what is different in the task of another run, whose policy acts all the same."""
    notes = []
    for name in ("dt", "control_low", "control_high"):
        mine, its = (np.asarray(getattr(one, name), float) for one in (task, theirs))
        if not np.allclose(mine, its):
            notes.append(f"{name} of {theirs.name} is {shown(its.tolist())}, here {shown(mine.tolist())}")
    for its, mine in zip(_names(theirs), _names(task), strict=True):
        nameless = any(all(re.fullmatch(NUMBERED, name) for name in names) for names in (its, mine))
        if its != mine and not nameless:
            notes.append(f"{theirs.name} has {', '.join(its)}, here that is {', '.join(mine)}")
    return notes


def remembered(old: Config, config: Config) -> str:
    """The end of a line that two policies see different things: the words that make it so, or "" where none do."""
    its, mine = (config_io.leaves(one.sensors, "sensors.") for one in (old, config))
    for name in ("history", "control_rate", "goal_low", "goal_high", "goals", "reference"):
        its, mine = its | {name: getattr(old, name)}, mine | {name: getattr(config, name)}
    words = [f"{name}={shown(its[name])}" for name in its if shown(its[name]) != shown(mine[name])]
    return f"; that run has {' and '.join(words)}: give both runs the same" if words else ""


def copy(config: Config, run: Path) -> None:
    """Copy what the config's init= names into a new run's folder, which has no config.yaml yet."""
    if config.init is not None:
        copied(*source(config.init), run / FOLDER)


def copied(old: Path, trial: int, into: Path) -> None:
    """Copy into a folder what is needed to restore a trial of another run."""
    shutil.rmtree(into, ignore_errors=True)  # of a command that was killed before it began
    (into / "checkpoints").mkdir(parents=True)
    for name in ("config.yaml", "run.json", f"checkpoints/{trial:04d}.json"):
        shutil.copyfile(old / name, into / name)
    for folder in (f"checkpoints/{trial:04d}", logged.FOLDER):  # logs say how much room its data have
        if (old / folder).is_dir():
            shutil.copytree(old / folder, into / folder)


def begun(states: RunState, config: Config, run: Path | None = None) -> RunState:
    """The first states [S, ...] of a config's runs, with what their init= gives; read from the copy in `run`, if any.

    Raises RunError, or ConfigError, where it cannot be read.
    """
    if config.init is None:
        return states
    found = (run / FOLDER, restore.LAST) if run is not None else source(config.init)
    return taken_over(states, read(*found, f"init={config.init}")[2], config.init_parts)


def taken_over(states: RunState, old: RunState, parts: tuple[str, ...]) -> RunState:
    """States [S, ...] with the parameters of the parts of another state, of one run or [S, ...], in their precision.

    Optimizers start fresh: their moments are those of another cost or of other data.
    """

    def part(name: str) -> TrainState:
        mine: TrainState = getattr(states, name)
        if name not in parts:
            return mine
        return mine._replace(params=jax.tree.map(like, getattr(old, name).params, mine.params))

    def like(leaf: Any, mine: Any) -> Any:
        return jnp.broadcast_to(jnp.asarray(leaf, mine.dtype), mine.shape)

    return states._replace(policy=part("policy"), model=part("model"))
