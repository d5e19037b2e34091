"""A run's folder: what is written, where, and how it survives a crash.

    RUN/config.yaml          every setting
        run.json             versions, machine, command
        episodes/0001.npz    x [H+1, D], u [H, U], cost [H], names, dt; written before anything else happens to it
        imagined/0001.npz    particles after trial 1: x [H+1, K, D], u [H, K, U], cost [H, K]
        trials.jsonl         one JSON object a trial
        checkpoints/0001/    orbax, with 0001.json: the SHA-256 of each of its files
        tensorboard/         the numbers of trials.jsonl as scalars

Files appear whole or not at all: written beside their place, flushed to disk, then renamed.
"""

from __future__ import annotations

import json
import os
import platform
import sys
import tempfile
import zipfile
from collections.abc import Callable
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from filelock import FileLock, Timeout

from pegasus_jax.checks import SettingError

if TYPE_CHECKING:  # JAX is imported where it is needed: a command names its folder before it waits for that
    from pegasus_jax.types import Episode, Rollout, Task, Trajectory


class RunError(Exception):
    """A run's folder is not as it should be; the message is one line for the person who named it."""


def write_whole(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Let `write` fill a file that then appears at `path` whole, and survives a power cut."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def write_json(path: Path, value: Any) -> None:
    """Write one JSON document, whole."""
    write_whole(path, lambda file: file.write(json.dumps(value, indent=1).encode() + b"\n"))


def create(path: Path) -> Path:
    """A new run's folder. Raises SettingError when it cannot be made or holds a run already."""
    if (path / "config.yaml").exists():
        raise SettingError(f"out={path} holds a run already; resume={path} goes on with it, out={free(path)} is free")
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise SettingError(f"out={path} cannot be written: {error.strerror}; for example out=runs/demo") from error
    return path


def existing(path: Path) -> Path:
    """The folder of a run. Raises RunError when there is none."""
    if not (path / "config.yaml").is_file():
        near = [p.parent for p in sorted(path.parent.glob("*/config.yaml"))] if path.parent.is_dir() else []
        hint = f"; there are {', '.join(map(str, near[:5]))}" if near else ""
        raise RunError(f"{path} is not a run (it has no config.yaml){hint}")
    return path


def seeds_of(path: Path) -> dict[int, Path]:
    """Seed -> folder of the runs that one study left in `path`; none where it is a run itself, or nothing."""
    found = sorted(path.glob("seed*/config.yaml"), key=lambda p: (len(p.parent.name), p.parent.name))
    return {int(p.parent.name.removeprefix("seed")): p.parent for p in found if p.parent.name[4:].isdecimal()}


def holds(path: Path) -> bool:
    """Whether the folder is a run, or has those of many seeds."""
    return (path / "config.yaml").exists() or bool(seeds_of(path))


def free(path: Path) -> Path:
    """The first of path, path-2, path-3, ... that holds no run."""
    candidates = [path, *(path.with_name(f"{path.name}-{i}") for i in range(2, 10_000))]
    return next(p for p in candidates if not holds(p))


def lock(path: Path) -> FileLock:
    """The right to write to a run, held until released. Raises RunError when another process has it."""
    guard = FileLock(path / ".lock")
    try:
        guard.acquire(timeout=0)
    except Timeout:
        raise RunError(f"{path} is being written by another process; stop it, or choose another out=") from None
    return guard


def episode_path(run: Path, trial: int) -> Path:
    """Where the episode of a trial lies."""
    return run / "episodes" / f"{trial:04d}.npz"


def save_episode(run: Path, trial: int, trajectory: Trajectory, task: Task, *, policy: int, ended: str) -> None:
    """Make an episode durable, with what a reader needs to understand it without us."""
    arrays = {name: np.asarray(getattr(trajectory, name)) for name in ("x", "u", "cost")}
    about = dict(state_names=task.state_names, control_names=task.control_names, dt=task.dt, task=task.name)
    about |= dict(trial=trial, horizon=task.horizon, policy=policy, ended=ended)
    write_whole(episode_path(run, trial), lambda file: np.savez(file, **arrays, **about))  # type: ignore[arg-type]


def load_episode(run: Path, trial: int) -> Episode | None:
    """The episode of a trial, or None when it was never finished. Raises RunError for an unreadable file."""
    path = episode_path(run, trial)
    if not path.exists():
        return None
    from pegasus_jax.types import Episode, Trajectory

    with _readable(path) as file:
        return Episode(Trajectory(file["x"], file["u"], file["cost"]), str(file["ended"]))


def save_imagined(run: Path, trial: int, imagined: Rollout, cost: Any) -> None:
    """Keep a fan of imagined trajectories for the plots."""
    x, u, c = np.asarray(imagined.x), np.asarray(imagined.u), np.asarray(cost)
    write_whole(run / "imagined" / f"{trial:04d}.npz", lambda file: np.savez(file, x=x, u=u, cost=c))


def load_imagined(run: Path, trial: int) -> dict[str, np.ndarray] | None:
    """The fan of a trial, or None when there is none (yet)."""
    path = run / "imagined" / f"{trial:04d}.npz"
    if not path.exists():
        return None
    with _readable(path) as file:
        return dict(file)


def trials(run: Path) -> list[dict[str, Any]]:
    """The finished trials, oldest first; a last line cut short by a crash is left out."""
    path = run / "trials.jsonl"
    lines = path.read_text().splitlines() if path.exists() else []
    rows = []
    for number, line in enumerate(lines):
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            if number < len(lines) - 1:
                raise RunError(f"{path} line {number + 1} is not JSON") from None
    return rows


def write_trials(run: Path, rows: list[dict[str, Any]]) -> None:
    """Replace trials.jsonl by these rows."""
    text = "".join(json.dumps(row) + "\n" for row in rows)
    write_whole(run / "trials.jsonl", lambda file: file.write(text.encode()))


def processors() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def about(command: str) -> dict[str, Any]:
    """Versions, machine and command: what somebody else needs to repeat the run."""
    import jax

    packages = ("pegasus-jax", "jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "orbax-checkpoint", "numpy")
    versions = {}
    for name in packages:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return {
        "command": command,
        "python": sys.version.split()[0],
        "platform": platform.platform(),
        "processor": ", ".join(f"{label}{processor()[name]}" for name, label in NAMED.items() if name in processor()),
        "devices": [str(device) for device in jax.devices()],
        "versions": versions,
    }


# What tells processors apart: a virtual machine may call two generations by one name.
NAMED = {"model name": "", "cpu family": "family ", "model": "model "}


@cache
def processor() -> dict[str, str]:
    """What the system says of its first processor, at least its "model name"; on Linux also what it can execute."""
    known = {"model name": f"{platform.machine()} {platform.processor()}"}
    try:
        lines = Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines()
    except OSError:
        return known
    return known | {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}


def note(run: Path, command: str, done: int) -> None:
    """Write down what a run was made with, and every command that had a part in it: each came after `done` trials."""
    path = run / "run.json"
    try:
        earlier = json.loads(path.read_text())["commands"]
    except (OSError, ValueError, KeyError):  # a new run, or one of before they were kept
        earlier = []
    write_json(path, about(command) | {"commands": [*earlier, {"done": done, "command": command}]})


def _readable(path: Path) -> Any:
    try:
        file = np.load(path)
        for name in file.files:
            file[name]  # reads it, and checks its CRC
        return file
    except (OSError, ValueError, zipfile.BadZipFile, EOFError, KeyError) as error:
        raise RunError(f"{path} cannot be read: {error}") from error
