"""A run's folder: what is written, where, and how it survives a crash.

    RUN/config.yaml          every setting
        run.json             versions, machine, commands, and the facts of the task (facts.py)
        episodes/0001.npz    of L <= H control periods: x [L+1, D], u [L, U], cost [L], how it ended, the policy that
                             ran, names, dt; written before anything else happens to it. Where x has angles for
                             the cosines and sines that its user observes, also observation [L+1, O] and circles;
                             of a controller that remembers, memory [M] at the start
        logged/0001.npz      episodes of logs, which are trial 1: as those of the run, with the `source` of each; all
                             are there before config.yaml is
        imagined/0001.npz    particles after trial 1: x [H+1, K, D], u [H, K, U], cost [H, K]
        trials.jsonl         one JSON object a trial
        checkpoints/0001/    the state after trial 1, with 0001.json: the SHA-256 of each of its files
        tensorboard/         the numbers of trials.jsonl as scalars
        tracked.json         of trackers that were asked for (tracked.py), and wandb/, the files of one
        driven/0001.npz      of pegasus-run, never data: as an episode, with when each control was sent, and overruns
        report.html          of pegasus-report, made of the files above; play.mp4 of pegasus-play
        controller.py        and .h, .onnx, .stablehlo: of pegasus-export, each with its contract, controller.py.json

Files appear whole or not at all: written beside their place, flushed to disk, then renamed.
"""

from __future__ import annotations

import difflib
import json
import re
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from filelock import FileLock

from pegasus_jax.checks import ConfigError, RunError
from pegasus_jax.math.circles import to_observation
from pegasus_jax.runs import facts
from pegasus_jax.runs.files import held, strict, write_json, write_whole
from pegasus_jax.runs.machine import about

if TYPE_CHECKING:  # JAX is imported where it is needed: a command names its folder before it waits for that
    from pegasus_jax.episode import Episode
    from pegasus_jax.task import Task
    from pegasus_jax.types import Rollout, Trajectory

FILES = ("config.yaml", "run.json", "trials.jsonl", "tracked.json", ".lock")
FOLDERS = ("episodes", "logged", "imagined", "checkpoints", "tensorboard", "plots")
# What a killed process was writing (files.beside, orbax), and pegasus-play.
UNFINISHED = re.compile(
    r"\.(\d{4,}\.(npz|json)|trials\.jsonl|(run|tracked)\.json|config\.yaml|learning\.png|report\.html|trial_\d{4,}\.png)"
    r"\.\w{8}|\.play\.\w{8}|\d{4,}\.orbax-checkpoint-tmp.*"
)
EPISODE = ("x", "u", "cost", "task", "trial", "policy", "ended", "horizon")  # what every episode's file has
ENDED = ("horizon", "terminated", "truncated", "error", "interrupted")  # how an episode can end
SOLVED = 0.9  # of a trial's evaluation episodes succeed
# What a row of trials.jsonl says in numbers, and readers of it use.
COLUMNS = ("plant_seconds", "episode_cost", "mean_cost", "success_rate", "objective_last", "objective_fresh")


def create(path: Path) -> Path:
    """A new run's folder. Raises ConfigError when it cannot be made or holds a run already."""
    unused(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise ConfigError(f"out={path} cannot be written: {error.strerror}; for example out=runs/demo") from error
    return path


def unused(path: Path) -> None:
    """Raises ConfigError for a folder that holds a run, or what is left of one."""
    if (path / "config.yaml").exists():
        raise ConfigError(f"out={path} holds a run already; resume={path} goes on with it, out={free(path)} is free")
    for name in ("episodes", "checkpoints", "trials.jsonl"):
        if (path / name).exists():
            raise ConfigError(f"out={path} holds {name} of a run without its config.yaml; out={free(path)} is free")


def enough(trials: int, done: int) -> None:
    """Raises ConfigError where a run is to end before the trials that it has done."""
    if done > trials:
        raise ConfigError(f"trials={trials} is fewer than the {done} that are done; expected at least that")


def existing(path: Path) -> Path:
    """The folder of a run. Raises RunError when there is none, or something in it is no file or no folder."""
    if not (path / "config.yaml").exists():
        inside = path.glob("*/config.yaml") if path.is_dir() else ()
        beside = path.parent.glob("*/config.yaml") if path.parent.is_dir() else ()
        there = [name for p in sorted(inside) or sorted(beside) if (name := str(p.parent)).isprintable()]
        near = difflib.get_close_matches(str(path), there, 5, cutoff=0.0)
        hint = f"; there are {', '.join(near)}" if near else ""
        raise RunError(f"{path} is not a run (it has no config.yaml){hint}")
    for names, kind, right in ((FILES, "file", Path.is_file), (FOLDERS, "folder", Path.is_dir)):
        for name in names:
            if (path / name).exists() and not right(path / name):
                raise RunError(f"{path / name} is not a {kind}; move it away")
    return path


def seeds_of(path: Path) -> dict[int, Path]:
    """Seed -> folder of the runs that one study left in `path`; none where it is a run itself, or nothing."""
    if (path / "config.yaml").exists():
        return {}
    found = sorted(path.glob("seed*/config.yaml"), key=lambda p: (len(p.parent.name), p.parent.name))
    return {int(p.parent.name.removeprefix("seed")): p.parent for p in found if p.parent.name[4:].isdecimal()}


def holds(path: Path) -> bool:
    """Whether the folder is a run, or has those of many seeds."""
    return any((path / name).exists() for name in ("config.yaml", "episodes", "checkpoints")) or bool(seeds_of(path))


def free(path: Path) -> Path:
    """The first of path, path-2, path-3, ... that holds no run."""
    candidates = [path, *(path.with_name(f"{path.name}-{i}") for i in range(2, 10_000))]
    return next(p for p in candidates if not holds(p))


def lock(path: Path, *, new: bool = False) -> FileLock:
    """The right to write to a run, held until released. Raises RunError when another process has it.

    Of a `new` run the folder must be unused; that is looked at under the lock, so that of two processes that begin in
    one folder, one gets it. ConfigError tells the other.
    """
    guard = held(path / ".lock", f"{path} is being written by another process; stop it, or choose another out=")
    try:
        unused(path) if new else existing(path)
    except BaseException:
        guard.release()
        raise
    return guard


def remove_unfinished(run: Path) -> None:
    """Remove the files that killed processes were writing. Only who holds the lock may do that."""
    for folder in (run, *(run / name for name in FOLDERS)):
        for path in list(folder.iterdir()) if folder.is_dir() else ():
            if UNFINISHED.fullmatch(path.name):
                shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink(missing_ok=True)


def numbered(folder: Path, suffix: str) -> list[int]:
    """The trials of the files `NNNN` + suffix in a folder, oldest first; others, such as copies, are not counted."""
    names = [path.name.removesuffix(suffix) for path in folder.glob(f"[0-9]*{suffix}")]
    return sorted(int(name) for name in names if name.isdecimal() and name == f"{int(name):04d}")


def episode_path(run: Path, trial: int) -> Path:
    """Where the episode of a trial lies."""
    return run / "episodes" / f"{trial:04d}.npz"


def save_episode(run: Path, trial: int, episode: Trajectory, task: Task, *, policy: int, ended: str) -> None:
    """Make an episode durable, with what a reader needs to understand it without us.

    Kept are the `episode.length` control periods that it lasted, all of them where that is None; `policy` is the trial
    after which the policy that ran was learned, 0 for random controls; `ended` is one of `ENDED`.
    """
    arrays = episode_arrays(run, trial, episode, task, policy=policy, ended=ended)
    write_whole(episode_path(run, trial), lambda file: np.savez(file, **arrays))  # type: ignore[arg-type]


def episode_arrays(
    run: Path, trial: int, episode: Trajectory, task: Task, *, policy: int, ended: str
) -> dict[str, Any]:
    """What the file of an episode of a run holds, by name."""
    return arrays_of(task_of(run).name, trial, episode, task, policy=policy, ended=ended)


def arrays_of(name: str, trial: int, episode: Trajectory, task: Task, *, policy: int, ended: str) -> dict[str, Any]:
    """What the file of an episode holds, by name; `name` is the task's, as its run began with it."""
    length = len(episode.u) if episode.length is None else int(episode.length)
    arrays: dict[str, Any] = {}
    if episode.memory is not None:
        arrays = dict(memory=np.asarray(episode.memory), memory_names=task.memory.names)
    arrays |= dict(
        x=np.asarray(episode.x)[: length + 1], u=np.asarray(episode.u)[:length], cost=np.asarray(episode.cost)[:length]
    )
    known = dict(state_names=task.state_names, control_names=task.control_names, dt=task.dt, horizon=task.horizon)
    if task.circles:  # x has angles for some of its cosines and sines
        known |= dict(observation=to_observation(arrays["x"], task.circles), circles=task.circles)
    known |= dict(task=name, trial=trial, policy=policy, ended=ended)
    return arrays | known


def load_episode(run: Path, trial: int) -> Episode | None:
    """The episode of a trial, of L <= H control periods, or None when it was never finished.

    Raises RunError for a file that cannot be read, or is not this trial's episode of this run's task.
    """
    found = _episode(run, trial)
    if found is None:
        return None
    from pegasus_jax.episode import Episode
    from pegasus_jax.types import Trajectory

    rows = (found[name] for name in ("x", "u", "cost"))
    return Episode(Trajectory(*rows, memory=found.get("memory")), str(found["ended"]))  # type: ignore[arg-type]


def origin(run: Path, trial: int) -> tuple[int, str] | None:
    """Which policy ran in the episode of a trial (0: random controls), and how it ended; None without an episode."""
    found = _episode(run, trial)
    return None if found is None else (int(found["policy"]), str(found["ended"]))


def _episode(run: Path, trial: int) -> dict[str, Any] | None:
    path = episode_path(run, trial)
    if not path.exists():
        return None
    found = arrays(path, *EPISODE)
    if what := wrong(found, trial, task_of(run)):
        raise RunError(f"{path} {what}")
    return found


def wrong(found: dict[str, np.ndarray], trial: int, task: Task) -> str | None:
    """What of an episode's arrays cannot be, or None."""
    x, u, cost = (found[name] for name in ("x", "u", "cost"))
    for name, kinds in (("trial", "iu"), ("policy", "iu"), ("horizon", "iu"), ("task", "U"), ("ended", "U")):
        if found[name].ndim or found[name].dtype.kind not in kinds:
            return f"says nothing usable of its {name}"
    if str(found["task"]) != task.name or int(found["trial"]) != trial:
        return f"is the episode of trial {found['trial']} of {found['task']}; expected trial {trial} of {task.name}"
    if {x.dtype, u.dtype, cost.dtype} not in ({np.dtype(np.float32)}, {np.dtype(np.float64)}):
        return f"has arrays of {x.dtype}, {u.dtype} and {cost.dtype}; expected float32 or float64, all the same"
    length, states, controls = len(u) if u.ndim else 0, len(task.state_names), len(task.control_names)
    expected = ((length + 1, states), (length, controls), (length,))
    if (x.shape, u.shape, cost.shape) != expected or length > task.horizon or int(found["horizon"]) != task.horizon:
        return (
            f"has x {list(x.shape)}, u {list(u.shape)} and cost {list(cost.shape)}; expected [L+1, {states}],"
            f" [L, {controls}] and [L], L at most {task.horizon}"
        )
    if not all(np.isfinite(array).all() for array in (x, u)):
        return "has numbers that are not finite"
    margin = 1e-5 * (np.asarray(task.control_high) - task.control_low)  # of rounding
    if np.any(u < task.control_low - margin) or np.any(u > task.control_high + margin):
        return "has controls beyond the limits of its task"
    if str(found["ended"]) not in ENDED or not 0 <= int(found["policy"]) < trial:
        return f"says that it ended by {found['ended']} and ran policy {found['policy']}, which cannot be"
    return None


def save_imagined(run: Path, trial: int, imagined: Rollout, cost: Any) -> None:
    """Keep a fan of imagined trajectories for the plots."""
    x, u, c = (np.asarray(rows) for rows in (imagined.x[..., : imagined.std.shape[-1]], imagined.u, cost))
    write_whole(run / "imagined" / f"{trial:04d}.npz", lambda file: np.savez(file, x=x, u=u, cost=c))


def load_imagined(run: Path, trial: int) -> dict[str, np.ndarray] | None:
    """The fan of a trial, or None when there is none (yet). Raises RunError for a file that is no fan."""
    path = run / "imagined" / f"{trial:04d}.npz"
    if not path.exists():
        return None
    found, task = arrays(path, "x", "u", "cost"), task_of(run)
    steps, particles = found["cost"].shape if found["cost"].ndim == 2 else (0, 0)
    shapes = ((steps + 1, particles, len(task.state_names)), (steps, particles, len(task.control_names)))
    if (
        not steps
        or (found["x"].shape, found["u"].shape) != shapes
        or {found[name].dtype.kind for name in ("x", "u", "cost")} != {"f"}
    ):
        raise RunError(f"{path} does not hold imagined trajectories of this run; remove it to draw the others")
    return found


def arrays(path: Path, *names: str) -> dict[str, np.ndarray]:
    """The arrays of an .npz file. Raises RunError unless it can be read, whole, and has these."""
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name] for name in file.files}  # reads each, and checks its CRC
    except Exception as error:  # of a damaged or foreign file NumPy and zipfile raise whatever they come across
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "it is damaged, or no .npz file"
        raise RunError(f"{path} cannot be read: {reason}") from error
    if lacks := [name for name in names if name not in found]:
        raise RunError(f"{path} lacks {', '.join(lacks)}")
    return found


def trials(run: Path) -> list[dict[str, Any]]:
    """The finished trials, oldest first. Raises RunError where trials.jsonl is not one row a trial, in order."""
    rows, problem = readable_trials(run)
    if problem:
        raise RunError(f"{problem}; resume={run} does these trials again, from their episodes")
    return rows


def readable_trials(run: Path) -> tuple[list[dict[str, Any]], str | None]:
    """The rows of the trials 1, 2, ... as far as trials.jsonl is whole, and what is wrong with the next one."""
    path, rows = run / "trials.jsonl", []
    try:
        lines = path.read_bytes().splitlines() if path.exists() else []
    except OSError as error:
        raise RunError(f"{path} cannot be read: {error.strerror}") from error
    for number, line in enumerate(lines, start=1):
        try:
            row = json.loads(line, parse_constant=lambda _: None)  # of a NaN, which is no JSON
        except ValueError:
            return rows, f"{path} line {number} is not JSON"
        if not isinstance(row, dict) or row.get("trial") != number:
            said = row.get("trial") if isinstance(row, dict) else None
            return rows, f"{path} line {number} is not of trial {number}" + (f" but of {said}" if said else "")
        if lacks := [name for name in COLUMNS if type(row.get(name, "")) not in (int, float, type(None))]:
            return rows, f"{path} line {number} has no usable {lacks[0]}"
        rows.append(row)
    return rows, None


def write_trials(run: Path, rows: list[dict[str, Any]]) -> None:
    """Replace trials.jsonl by these rows."""
    text = "".join(json.dumps(strict(row), allow_nan=False) + "\n" for row in rows)
    write_whole(run / "trials.jsonl", lambda file: file.write(text.encode()))


def cost_since(row: dict[str, Any]) -> int:
    """The first trial whose costs are of the same function as those of a row of trials.jsonl."""
    return row.get("cost_since", 1)


def phases(row: dict[str, Any]) -> dict[str, float]:
    """The seconds of each phase of a trial, none twice: `between_episodes` is a waiting time, made of the others."""
    known = row.get("seconds") or {}
    return {name: spent for name, spent in known.items() if name != "between_episodes" and spent is not None}


def computing(row: dict[str, Any]) -> tuple[float, float]:
    """The seconds of a trial that went into computing, and into compiling: the episode is the plant's time."""
    spent = phases(row)
    compiling = spent.pop("compile", 0.0)
    return sum(spent.values()) - spent.get("collect", 0.0), compiling


def task_of(run: Path) -> Task:
    """The task of a run as its folder tells it: without a plant, and no code is imported for its cost."""
    return facts.to_task(stored(run)["task"], str(run / "run.json"))


def stored(run: Path) -> dict[str, Any]:
    """What run.json says. Raises RunError when that is not known, or was written by a version that noted less."""
    path = run / "run.json"
    try:
        found = json.loads(path.read_bytes())
    except OSError as error:
        raise RunError(f"{path} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise RunError(f"{path} is damaged; without it, resume={run} writes a new one") from error
    kinds = {"commands": list, "task": dict}
    if not isinstance(found, dict) or not all(isinstance(found.get(name, of()), of) for name, of in kinds.items()):
        raise RunError(f"{path} is damaged; without it, resume={run} writes a new one")
    if "task" not in found:
        versions = found.get("versions")
        version = versions.get("pegasus-jax") if isinstance(versions, dict) else "of an unknown version"
        raise RunError(
            f"{path} is damaged, or of pegasus-jax {version}, which noted no facts of its task: it cannot be read"
        )
    return found | {"task": facts.of_today(found["task"])}


def note(run: Path, command: str, done: int, task: Task) -> None:
    """Write down what a run was made with, and every command that had a part in it: each came after `done` trials.

    The facts of the task are those of the first command: later ones were compared with them.
    """
    earlier = stored(run) if (run / "run.json").exists() else {"commands": [], "task": facts.of_task(task)}
    commands = [*earlier.get("commands", []), {"done": done, "command": command}]
    write_json(run / "run.json", about(command) | {"commands": commands, "task": earlier["task"]})
