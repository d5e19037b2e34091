"""RunState on disk: orbax writes the arrays, a SHA-256 list beside them tells a damaged checkpoint from a whole one."""

import hashlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax.record import RunError, write_json
from pegasus_jax.types import Key, RunState


def save(run: Path, trial: int, state: RunState) -> None:
    """Write the state after a trial; complete once its list of sums exists."""
    path = _folder(run, trial)
    _sums(run, trial).unlink(missing_ok=True)
    shutil.rmtree(path, ignore_errors=True)
    with _checkpointer() as checkpointer:
        checkpointer.save(path, jax.tree.map(np.asarray, _plain(state)))  # of the host: any devices can read it back
    write_json(_sums(run, trial), {str(f.relative_to(path)): _digest(f) for f in _files(path)})


def available(run: Path) -> list[int]:
    """Trials with a checkpoint, newest first."""
    return sorted((int(p.stem) for p in (run / "checkpoints").glob("[0-9]*.json")), reverse=True)


def damage(run: Path, trial: int) -> str | None:
    """What is wrong with a checkpoint, naming the file, or None when it is whole."""
    path = _folder(run, trial)
    try:
        sums = json.loads(_sums(run, trial).read_text())
    except (OSError, ValueError):
        return f"{_sums(run, trial)} is missing or unreadable"
    for name, digest in sums.items():
        file = path / name
        if not file.is_file():
            return f"{file} is missing"
        if _digest(file) != digest:
            return f"{file} is damaged"
    return None


def restore(run: Path, trial: int, like: RunState) -> RunState:
    """The state after a trial; `like` is a state of the same experiment (shapes are enough: eval_shape of init).

    Raises RunError when it is the state of another experiment, or of a version that kept other things.
    """
    target = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), jax.eval_shape(_plain, like))
    try:
        with _checkpointer() as checkpointer:
            state = jax.tree.map(jnp.asarray, checkpointer.restore(_folder(run, trial), target))
    except ValueError as error:
        raise RunError(f"{_folder(run, trial)} is of another version or of other settings") from error
    return state._replace(key=jax.random.wrap_key_data(state.key))


def fingerprint(state: RunState) -> str:
    """SHA-256 over data, model and policy parameters: equal for bit-equal runs."""
    digest = hashlib.sha256()
    leaves = jax.tree_util.tree_leaves_with_path((state.data, state.model.params, state.policy.params))
    for path, leaf in leaves:
        digest.update(jax.tree_util.keystr(path).encode())
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()


def _checkpointer() -> Any:
    """One that waits for no other process: each reads for itself, and one alone writes."""
    import orbax.checkpoint as ocp  # here: it takes .2 s, and a run needs it after its first trial

    own = jax.process_index()
    alone = ocp.options.MultiprocessingOptions(
        primary_host=own, active_processes={own}, barrier_sync_key_prefix=f"process{own}"
    )
    return ocp.StandardCheckpointer(multiprocessing_options=alone)


def _plain(state: RunState) -> RunState:
    """The state with its typed key as the raw words that files can hold."""
    key: Key = state.key
    return state._replace(key=jax.random.key_data(key))


def _folder(run: Path, trial: int) -> Path:
    return run.absolute() / "checkpoints" / f"{trial:04d}"


def _sums(run: Path, trial: int) -> Path:
    return run / "checkpoints" / f"{trial:04d}.json"


def _files(path: Path) -> Iterator[Path]:
    return (f for f in sorted(path.rglob("*")) if f.is_file())


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
