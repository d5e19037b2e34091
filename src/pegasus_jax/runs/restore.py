"""What lies in a run's folder, made usable again: its task, its settings, and the state after one of its trials.

Reading a folder executes nothing from it. Only `planted` imports the user's cost and opens what the plant needs, says
so, and never imports from inside the folder.
"""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax import tasks
from pegasus_jax.assembly.experiments import assembled, set_precision
from pegasus_jax.checks import ConfigError, RunError, names_code
from pegasus_jax.config import Config, Lagrangian
from pegasus_jax.episode import verdict
from pegasus_jax.experiment import Experiment
from pegasus_jax.runs import checkpoint, config_io, facts, logged, store
from pegasus_jax.runs.best import best_trial
from pegasus_jax.runs.display import best_line
from pegasus_jax.task import Task
from pegasus_jax.types import RunState, TrainState

Trial = int | str  # a number, or one of:
LAST, BEST = "last", "best"


def restored(run: Path, trial: Trial = LAST, task: Task | None = None) -> tuple[Config, Experiment, RunState]:
    """A run's config, its experiment, and its state after a trial: a number, "last" or "best" (`best.best_trial`).

    The experiment is that of `task`: of the facts in the folder where that is None, without a plant or a cost. No
    global setting of JAX is changed. Raises RunError when there is no such trial, or none yet that can be read.
    """
    config = config_io.load(store.existing(run) / "config.yaml")
    with precision(config):
        experiment = assembled(config, task or _unplanted(run, config), None, logged.of_run(config, run).rows)
        like = jax.eval_shape(experiment.init, jax.random.key(0))
        return config, experiment, _state(run, trial, like)


def ready(run: Path, trial: Trial = LAST, mjcf: str | None = None) -> tuple[Config, Experiment, RunState]:
    """`restored`, with the plant and the cost, for a command that runs episodes: the run's precision is JAX's then.

    `mjcf` is where the model's file is now, if it is not where it was.
    """
    config = moved(run, config_io.load(store.existing(run) / "config.yaml"), mjcf)
    set_precision(config)
    return restored(run, trial, planted(run, config))


def _unplanted(run: Path, config: Config) -> Task:
    """The task of the facts in a run's folder. Where it has a simulator its model is of what that gets wrong."""

    def missing(*_: Any) -> Any:
        raise RunError(f"{run} imagines with its prior={config.prior}, which is opened with its plant only")

    task = store.task_of(run)
    return task if config.prior is None else task._replace(prior=missing)


def _state(run: Path, trial: Trial, like: RunState) -> RunState:
    """The state after a trial. Raises RunError in one line that says what there is."""
    if trial == LAST:
        state, problems = newest([run], like, [*checkpoint.available(run)])
        if state is None:
            why = f": {problems[0]}" if problems else f"; resume={run} makes one"
            raise RunError(f"{run / 'checkpoints'} holds no checkpoint that this version can use{why}")
        for problem in problems:
            print(f"note: {problem}", file=sys.stderr)
        return jax.tree.map(lambda leaf: leaf[0], state)
    number = best(run) if trial == BEST else trial
    there = checkpoint.available(run)
    choices = ", ".join([*map(str, sorted(there)), BEST, LAST])
    if number not in there:
        raise RunError(f"{run} has no checkpoint of trial={number!r}; choose from {choices}")
    if problem := checkpoint.damage(run, int(number)):
        raise RunError(problem)
    return checkpoint.restore(run, int(number), like)


def best(run: Path) -> int:
    """The trial after which the best policy of a run was learned. Raises RunError before its first trial has ended."""
    rows, there = store.trials(run), checkpoint.available(run)
    if not rows:
        raise RunError(f"{run / 'trials.jsonl'} holds no finished trial yet")
    if len(rows) > 1 and len(rows) not in there and len(rows) - 1 in there:  # its checkpoint is being written
        rows.pop()
    last = _episode_after(run, rows)
    try:
        return best_trial(rows, last, first=0 if 0 in there else 1)
    except (KeyError, TypeError) as error:
        raise RunError(f"{run / 'trials.jsonl'} has rows that this version cannot judge") from error


def with_last(run: Path, rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows of a run's trials, and what one would say of the episode that has none yet."""
    last = _episode_after(run, rows)
    return [*rows, *([last] if last else [])]


def _episode_after(run: Path, rows: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """What a row would say of the episode that has none yet; None without one."""
    following = len(rows) + 1
    ran, origin = store.load_episode(run, following), store.origin(run, following)
    if ran is None or origin is None or not len(ran.trajectory.u) or not np.isfinite(ran.trajectory.cost).all():
        return None
    learned = {"objective_fresh": None, "mean_cost": None}
    told = {"policy": origin[0], "random": rows[-1]["random"], "ended": ran.ended}
    told["cost_since"] = store.cost_since(rows[-1])
    return learned | told | verdict(ran, store.task_of(run))


def chosen(run: Path, trial: Trial, number: int) -> str:
    """Which policy a command uses that was asked for `trial`, and why, in one line; `number` is its trial."""
    if trial == BEST:
        return best_line(with_last(run, store.trials(run)), number)
    return f"newest policy: trial {number}" if trial == LAST else f"policy of trial {number}, as asked"


def newest(runs: Sequence[Path], like: RunState, candidates: Sequence[int]) -> tuple[RunState | None, list[str]]:
    """The states [S, ...] of the newest candidate of which every run has a whole checkpoint, and what others lack."""
    found: list[str] = []
    for trial in sorted(candidates, reverse=True):
        problems = [problem for run in runs if (problem := checkpoint.damage(run, trial)) is not None]
        if not problems:
            try:
                return _stacked([checkpoint.restore(run, trial, like) for run in runs]), found
            except RunError as error:
                problems = [str(error)]
        found += [f"checkpoint {trial} is not usable: {problem}" for problem in problems]
    return None, found


def _stacked(states: Sequence[RunState]) -> RunState:
    """One state [S, ...] of many; an optimizer that one of them lacks, all lack."""

    def learner(name: str, state: RunState) -> TrainState:
        lacking = any(getattr(other, name).optimizer is None for other in states)
        return getattr(state, name)._replace(optimizer=None) if lacking else getattr(state, name)

    alike = [state._replace(model=learner("model", state), policy=learner("policy", state)) for state in states]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *alike)


def together(runs: Sequence[Path], experiment: Experiment, say: Callable[[str], None]) -> RunState | None:
    """The states [S, ...] from which all the runs go on together, or None: from their episodes alone.

    That is after the newest trial of which every run has its row and a whole checkpoint; trials after it are done
    again, from the episodes that there are. `say` is told why it is not the newest of all.
    """
    shared = set.intersection(*(set(checkpoint.available(run)) for run in runs))
    for run in runs:
        rows, problem = store.readable_trials(run)
        # An episode is run before all that the trial before it leaves has been written.
        proven = max([0, *checkpoint.available(run), *(n - 2 for n in store.numbered(run / "episodes", ".npz"))])
        if len(rows) < proven:
            missing = problem or f"{run / 'trials.jsonl'} has {len(rows)} rows"
            again = f"those after {len(rows)} are done again, from their episodes"
            say(f"{missing}, and there were {proven} trials; {again}")
        shared = {trial for trial in shared if trial <= len(rows)}
        if (rows or proven) and not (run / "run.json").exists():
            say(f"{run / 'run.json'} is missing and written anew; earlier commands are not known")
    states, problems = newest(runs, jax.eval_shape(experiment.init, jax.random.key(0)), sorted(shared))
    for problem in problems:
        say(f"{problem}; going on from the one before it")
    return states


def suited(states: RunState, fresh: RunState) -> RunState:
    """The states, with fresh optimizers where the settings ask for others than the run had so far."""

    def shape(tree: Any) -> tuple[Any, list[Any]]:
        return jax.tree.structure(tree), jax.tree.map(jnp.shape, jax.tree.leaves(tree))

    def learner(old: TrainState, new: TrainState) -> TrainState:
        same = shape(old.optimizer) == shape(new.optimizer)
        return old if same else old._replace(optimizer=new.optimizer)

    return states._replace(model=learner(states.model, fresh.model), policy=learner(states.policy, fresh.policy))


@contextmanager
def precision(config: Config) -> Iterator[None]:
    """JAX as a config wants it, in this block only."""
    products = jax.config.jax_default_matmul_precision or "float32"  # pyright: ignore[reportAttributeAccessIssue]
    with jax.enable_x64(config.x64), jax.default_matmul_precision(products):
        yield


def planted(run: Path, config: Config) -> Task:
    """The task of a run with its plant and its cost, for whoever runs episodes.

    What is imported for that is said on standard error. Raises RunError where that would be a file in the run's folder,
    or where the task is not the one that the run began with.
    """
    announce(run, config)
    task = tasks.of_config(config)
    same(run, task, config)
    return task._replace(name=store.task_of(run).name)


def moved(run: Path, config: Config, mjcf: str | None = None) -> Config:
    """The config with the model's file where it is now: `mjcf`, where it was, or of that name in the working folder.

    That it is the same model is seen when it is read. Raises RunError, or ConfigError for a task without such a file.
    """
    if mjcf is not None and config.mjcf is None:
        raise ConfigError(f"mjcf={mjcf} is of no use here: the run is of task={config.task}")
    if mjcf is None and (config.mjcf is None or Path(config.mjcf).is_file()):
        return config
    file = Path(mjcf or Path(config.mjcf or "").name)
    if mjcf is None and not file.is_file():
        raise RunError(f"mjcf={config.mjcf}, with which {run} began, is not there; mjcf=FILE says where it is now")
    if mjcf is None:
        print(f"{config.mjcf} is not there; reading {file.absolute()}", file=sys.stderr)
    return replace(config, mjcf=os.path.abspath(file))


def same(run: Path, task: Task, config: Config) -> None:
    """Raises RunError unless this is the task that a run of this config began with, as far as its folder tells."""
    if not (run / "run.json").exists():
        return
    began = store.stored(run)["task"]
    facts.to_task(began, str(run / "run.json"))  # facts that are none are said before they are compared
    if what := facts.difference(began, facts.of_task(task), isinstance(config.model, Lagrangian)):
        raise RunError(f"the task of {run / 'config.yaml'} is not that of run.json, with which it began: {what}")


def announce(run: Path, config: Config) -> None:
    """Say which modules of their user a config names, and where they are. Raises RunError for one inside the run."""
    inside = run.resolve()
    own = (config.cost, config.stop, config.goals, config.constraint, config.explore.policy)
    names = (*own, config.env, config.reference, config.prior)
    modules = sorted({str(name).partition(":")[0] for name in names if names_code(name)})
    for entry in (os.getcwd(), *sys.path) if modules else ():
        if Path(entry or ".").resolve().is_relative_to(inside):
            raise RunError(f"{entry or os.getcwd()} lies in {run}, and nothing is imported from there; go elsewhere")
    for module in modules:
        files = _files(module)
        for file in files:
            if file.resolve().is_relative_to(inside):
                raise RunError(f"{module} would be imported from {file}, in {run}; nothing is imported from there")
        print(f"importing {module} from {files[-1] if files else 'nowhere'}", file=sys.stderr)


def _files(module: str) -> list[Path]:
    """The files that an import of a module runs, found without running one: those of its packages, then its own."""
    path: Sequence[str] | None = [*sys.path, os.getcwd()]
    found = []
    for part in module.split("."):
        spec = PathFinder.find_spec(part, path)
        if spec is None:
            break
        found += [Path(spec.origin)] if spec.origin else []
        path = list(spec.submodule_search_locations or ())
    return found
