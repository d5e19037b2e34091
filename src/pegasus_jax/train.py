"""The main job: run an experiment trial by trial on this machine, leaving a run's folder that survives anything."""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tensorboardX import SummaryWriter

from pegasus_jax import checkpoint, record, settings
from pegasus_jax.build import build, set_precision
from pegasus_jax.config import Config, SettingError
from pegasus_jax.dataset import grow
from pegasus_jax.progress import Display
from pegasus_jax.record import RunError
from pegasus_jax.trial import COLLECT, EVALUATE, trial_key
from pegasus_jax.types import Experiment, Key, RunState, Task, Trajectory

EPISODES = 20  # evaluation episodes a trial; never data


class Jitted:
    """A jitted function that says how long compiling took; compiles once, or it is a defect."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function, self.compiled, self.seconds = jax.jit(function), None, 0.0

    def __call__(self, *arguments: Any) -> Any:
        if self.compiled is None:
            began = time.monotonic()
            self.compiled = self.function.lower(*arguments).compile()
            self.seconds = time.monotonic() - began
        return jax.block_until_ready(self.compiled(*arguments))


class Program:
    """The compiled functions of an experiment, and the clock on them."""

    def __init__(self, experiment: Experiment, search_steps: int) -> None:
        self.chunk = chunk(search_steps)
        self.chunks = search_steps // self.chunk
        self.parts = {
            "init": Jitted(experiment.init),
            "episode": Jitted(experiment.episode),
            "absorb": Jitted(experiment.absorb),
            "fit": Jitted(experiment.fit),
            "search": Jitted(partial(experiment.search, steps=self.chunk)),
            "imagine": Jitted(experiment.imagine),
        }
        self.spent: dict[str, float] = {}

    def __call__(self, part: str, *arguments: Any, purpose: str | None = None) -> Any:
        """Run a part; its time is counted as that of `purpose`."""
        jitted, name = self.parts[part], purpose or part
        began, compiled = time.monotonic(), jitted.seconds
        result = jitted(*arguments)
        compiling = jitted.seconds - compiled
        self.spent[name] = self.spent.get(name, 0.0) + time.monotonic() - began - compiling
        self.spent["compile"] = self.spent.get("compile", 0.0) + compiling
        return result

    def seconds(self) -> dict[str, float]:
        """Seconds spent in each part since the last call."""
        spent, self.spent = self.spent, {}
        names = ("collect", "fit", "search", "imagine", "evaluate", "compile")
        return {name: round(spent.get(name, 0.0), 3) for name in names}


def chunk(steps: int) -> int:
    """Search iterations between two looks at the clock: a divisor of `steps` near a tenth of it."""
    divisors = [d for d in range(1, steps + 1) if steps % d == 0]
    return next(d for d in divisors if d * 20 >= steps)


def train(config: Config, run: Path, *, resume: bool = False, command: str = "") -> RunState:
    """Run (or go on with) `config` in the folder `run`, and return the state after its last trial.

    Killed at any moment and resumed, it ends bit-equal to an uninterrupted run: every trial's randomness is a function
    of seed and trial, finished episodes are read back, and a trial cut short is done again from the state before it.
    """
    with record.lock(run):
        before = settings.load(run / "config.yaml") if resume else config
        if config.trials < before.trials:
            raise SettingError(f"trials={config.trials} is fewer than the run was made for; at least {before.trials}")
        set_precision(config)
        record.write_json(run / "run.json", record.about(command))
        experiment = build(config)
        program = Program(experiment, config.search.steps)
        state = program("init", jax.random.key(config.seed))
        display = Display(config.trials, 0)
        if resume:
            state = latest(run, before, display) or state
            state = state._replace(data=grow(state.data, config.trials * experiment.task.horizon))
        settings.save(config, run / "config.yaml")
        done = int(state.trial)
        display.done = done
        record.write_trials(run, record.trials(run)[:done])
        with display.running(), SummaryWriter(str(run / "tensorboard"), purge_step=done + 1) as board:
            for trial in range(done + 1, config.trials + 1):
                state, row = one_trial(state, trial, config, run, experiment, program, display)
                record.write_trials(run, [*record.trials(run), row])
                scalars(board, row)
                checkpoint.save(run, trial, state)
                display.line(summary(row, config.trials))
    return state


def one_trial(
    state: RunState,
    trial: int,
    config: Config,
    run: Path,
    experiment: Experiment,
    program: Program,
    display: Display,
) -> tuple[RunState, dict[str, Any]]:
    """Collect (or read back) an episode, absorb it, improve, evaluate; the row for trials.jsonl says how it went."""
    task = experiment.task
    display.phase(trial, "collect")
    episode = record.load_episode(run, trial)
    if episode is None:
        key = trial_key(state.key, trial, COLLECT)
        exploring = jnp.asarray(trial <= config.explore.trials)
        episode = program("episode", key, state.policy.params, exploring, purpose="collect")
        record.save_episode(run, trial, episode, task)
    state = program("absorb", state, jax.tree.map(jnp.asarray, episode))
    display.phase(trial, "fit", 0.02)
    state, fitted = program("fit", state)
    objectives, norms, skipped = [], [], 0
    for i in range(program.chunks):
        cost = objectives[-1][-1] if objectives else None
        display.phase(trial, "search", 0.1 + 0.8 * i / program.chunks, cost)
        state, searched = program("search", state, jnp.int32(i * program.chunk))
        objectives.append(np.asarray(searched.objective))
        norms.append(np.asarray(searched.gradient_norm))
        skipped += int(searched.skipped)
    objective, norm = np.concatenate(objectives), np.concatenate(norms)
    display.phase(trial, "evaluate", 0.9)
    imagined, imagined_cost = program("imagine", state)
    record.save_imagined(run, trial, imagined, imagined_cost)
    evaluation_key = trial_key(state.key, state.trial, EVALUATE)
    evaluation = evaluate(evaluation_key, state, task, partial(program, "episode", purpose="evaluate"), EPISODES)
    row = {
        "trial": trial,
        "plant_seconds": round(trial * task.horizon * task.dt, 6),
        "random": trial <= config.explore.trials,
        "episode_cost": float(np.mean(episode.cost)),
        **evaluation,
        "fit_loss": float(fitted.loss),
        "objective_first": float(objective[0]),
        "objective_last": float(objective[-1]),
        "objective_fresh": float(jnp.mean(imagined_cost)),
        "gradient_norm": float(np.median(norm)),
        "skipped_updates": skipped + int(fitted.skipped),
        "saturated": saturated(episode, task),
        "seconds": program.seconds(),
    }
    return state, row


def evaluate(
    key: Key, state: RunState, task: Task, episode: Callable[..., Trajectory], episodes: int
) -> dict[str, float]:
    """Mean cost a step and success rate over fresh episodes that are not data (docs/reference.md 10)."""
    follow = jnp.asarray(False)  # the policy, not random controls
    costs = np.stack(
        [np.asarray(episode(k, state.policy.params, follow).cost) for k in jax.random.split(key, episodes)]
    )
    success = np.mean(costs[:, -5:], axis=1) < task.success
    return {"mean_cost": float(np.mean(costs)), "success_rate": float(np.mean(success))}


def saturated(episode: Trajectory, task: Task) -> float:
    """Fraction of an episode's controls within 1 % of a limit."""
    low, high = np.asarray(task.control_low), np.asarray(task.control_high)
    margin = 0.01 * (high - low)
    u = np.asarray(episode.u)
    return float(np.mean((u < low + margin) | (u > high - margin)))


def latest(run: Path, config: Config, display: Display) -> RunState | None:
    """The state of the newest whole checkpoint, or None; every damaged one is named."""
    for trial in checkpoint.available(run):
        problem = checkpoint.damage(run, trial)
        if problem is None:
            return checkpoint.restore(run, trial, jax.eval_shape(build(config).init, jax.random.key(0)))
        display.line(f"checkpoint {trial} is not usable: {problem}; going on from the one before it")
    return None


def newest(run: Path) -> tuple[Config, Experiment, RunState]:
    """A run's config, its experiment and its newest whole state. Raises RunError when there is none yet."""
    config = settings.load(run / "config.yaml")
    set_precision(config)
    state = latest(run, config, Display(config.trials, 0))
    if state is None:
        raise RunError(f"{run} has no whole checkpoint yet")
    return config, build(config), state


def evaluate_run(run: Path, episodes: int, seed: int) -> dict[str, Any]:
    """How the newest policy of a run does on its plant, and the run's fingerprint."""
    _, experiment, state = newest(run)
    result = evaluate(jax.random.key(seed), state, experiment.task, Jitted(experiment.episode), episodes)
    return {"trial": int(state.trial), "episodes": episodes, **result, "fingerprint": checkpoint.fingerprint(state)}


def scalars(board: SummaryWriter, row: dict[str, Any]) -> None:
    """The numbers of a trial's row as TensorBoard scalars."""
    for name, value in {**row, **{f"seconds/{k}": v for k, v in row["seconds"].items()}}.items():
        if isinstance(value, int | float):
            board.add_scalar(name, value, row["trial"])


def summary(row: dict[str, Any], trials: int) -> str:
    """A trial in one line."""
    seconds = sum(row["seconds"].values())
    return (
        f"trial {row['trial']:>2}/{trials}  {row['plant_seconds']:6.1f} s of plant  cost {row['mean_cost']:.3f}"
        f"  success {row['success_rate']:4.0%}  imagined {row['objective_last']:.3f}"
        f"  ({seconds:.0f} s, {row['seconds']['compile']:.0f} s of it compiling)"
        + (f"  {row['skipped_updates']} updates skipped" if row["skipped_updates"] else "")
    )
