"""RunState on disk: orbax writes its arrays by name, a list of SHA-256 tells a damaged checkpoint from a whole one."""

import errno
import hashlib
import json
import logging
import os
import shutil
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax.checks import RunError
from pegasus_jax.runs.files import write_json
from pegasus_jax.runs.store import numbered
from pegasus_jax.types import Key, RunState

ROWS = ("data.x", "data.u", "data.y", "data.memory")  # arrays with as many rows as there is room for


def save(run: Path, trial: int, state: RunState) -> None:
    """Write the state after a trial; complete once its list of sums exists."""
    path = _folder(run, trial)
    _sums(run, trial).unlink(missing_ok=True)
    shutil.rmtree(path, ignore_errors=True)
    # Of the host: any devices can read it back. orbax has no files for arrays of no size.
    leaves = {name: np.asarray(leaf) for name, leaf in _named(_plain(state)).items() if leaf.size}
    path.parent.mkdir(parents=True, exist_ok=True)
    with _refused(path), _checkpointer() as checkpointer:
        checkpointer.save(path.absolute(), leaves)
    write_json(_sums(run, trial), _summed(path))


def available(run: Path) -> list[int]:
    """Trials with a checkpoint, newest first."""
    return numbered(run / "checkpoints", ".json")[::-1]


def damage(run: Path, trial: int) -> str | None:
    """What is wrong with a checkpoint, naming the file, or None when it is whole."""
    path = _folder(run, trial)
    try:
        sums = json.loads(_sums(run, trial).read_bytes())
    except (OSError, ValueError):
        sums = None
    if not isinstance(sums, dict) or not sums:
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

    The data may have room for fewer rows than in `like`, and for more that are not in use. An optimizer is None where
    it is that of other settings. Raises RunError, naming the difference, when the rest is the state of another
    experiment or version.
    """
    folder, like = _folder(run, trial), jax.eval_shape(_plain, like)
    with _checkpointer() as checkpointer:
        try:
            stored = {name: np.asarray(leaf) for name, leaf in checkpointer.restore(folder.absolute()).items()}
        except Exception as error:  # orbax raises many kinds for what it cannot read
            raise RunError(f"{folder} is of another version: orbax cannot read it as ours") from error
    stored |= {name: np.zeros(leaf.shape, leaf.dtype) for name, leaf in _named(like).items() if not leaf.size}
    stored = _of_today(stored)
    stored |= _shortened(stored, len(like.data.x))
    optimizers = {"model": like.model.optimizer, "policy": like.policy.optimizer}
    rest = like._replace(model=like.model._replace(optimizer=None), policy=like.policy._replace(optimizer=None))
    if difference := _difference(stored, _named(rest)):
        raise RunError(f"{folder} is of another version, or of other settings than config.yaml: {difference}")
    state = _filled(stored, rest)
    kept = {
        name: _filled(stored, tree, f"{name}.optimizer.") if _suits(stored, tree, f"{name}.optimizer.") else None
        for name, tree in optimizers.items()
    }
    return state._replace(
        key=jax.random.wrap_key_data(state.key),
        model=state.model._replace(optimizer=kept["model"]),
        policy=state.policy._replace(optimizer=kept["policy"]),
    )


def _checkpointer() -> Any:
    """One that waits for no other process: each reads for itself, and one alone writes."""
    import orbax.checkpoint as ocp  # here: it takes .6 s, and a run needs it after its first trial

    own = jax.process_index()
    alone = ocp.options.MultiprocessingOptions(
        primary_host=own, active_processes={own}, barrier_sync_key_prefix=f"process{own}"
    )
    return ocp.StandardCheckpointer(multiprocessing_options=alone)


@contextmanager
def _refused(path: Path) -> Iterator[None]:
    """What the file system refuses becomes one OSError that names the path.

    orbax's threads, in Python and in C++, would each log or print a traceback of it, also later: of other threads than
    the main one only the error itself is told.
    """
    level, hooks = logging.root.manager.disable, (sys.unraisablehook, threading.excepthook)

    def of_main_thread(told: Any) -> None:
        if threading.current_thread() == threading.main_thread():
            hooks[0](told)

    logging.disable(logging.CRITICAL)
    sys.unraisablehook, threading.excepthook = of_main_thread, lambda _: None
    try:
        yield
    except Exception as error:
        logging.getLogger("absl").setLevel(logging.CRITICAL + 1)
        full = any(text in str(error) for text in ("No space left", "RESOURCE_EXHAUSTED"))
        number = error.errno if isinstance(error, OSError) and error.errno else errno.ENOSPC if full else errno.EIO
        raise OSError(number, os.strerror(number), str(path)) from error
    else:
        sys.unraisablehook, threading.excepthook = hooks
    finally:
        logging.disable(level)


def _named(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Name -> leaf of a tree, as `model.params.network.kernel`."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {prefix + jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def _of_today(stored: dict[str, Any]) -> dict[str, Any]:
    """The leaves with those that older runs did not keep: no episode of theirs succeeded, and none is gone back to."""
    working = {
        f"working{name.removeprefix('policy.params')}": leaf
        for name, leaf in stored.items()
        if name.startswith("policy.params")
    }
    return {"succeeded": np.zeros((), bool), "working_trial": np.zeros((), np.int32)} | working | stored


def _shortened(stored: dict[str, Any], room: int) -> dict[str, Any]:
    """The rows of the data in a smaller room, if all that are in use have a place there; else nothing."""
    used = stored.get("data.size")
    if used is None or used.shape or used > room:
        return {}
    return {name: stored[name][:room] for name in ROWS if name in stored and stored[name].shape}


def _difference(stored: dict[str, Any], expected: dict[str, Any]) -> str | None:
    """The first leaf that is missing, or has another shape or type than expected, in words."""
    rows = {stored[name].shape[:1] for name in stored if name in ROWS}
    for name, leaf in expected.items():
        if name not in stored:
            return f"it has no {name}"
        found, shape = stored[name], leaf.shape
        if name in ROWS and len(rows) == 1 and (found.shape[:1] or (-1,)) <= shape[:1]:
            shape = (*found.shape[:1], *shape[1:])
        if (found.shape, found.dtype) != (shape, leaf.dtype):
            return f"{name} is {found.dtype} {list(found.shape)}, and these settings make it {leaf.dtype} {list(shape)}"
    extra = [name for name in stored if name not in expected and ".optimizer" not in name]
    return f"it has {extra[0]} too" if extra else None


def _suits(stored: dict[str, Any], tree: Any, prefix: str) -> bool:
    """Whether the stored leaves below a prefix are those of this tree, in name, shape and type."""
    expected = {name: (leaf.shape, leaf.dtype) for name, leaf in _named(tree, prefix).items()}
    return expected == {name: (leaf.shape, leaf.dtype) for name, leaf in stored.items() if name.startswith(prefix)}


def _filled(stored: dict[str, Any], tree: Any, prefix: str = "") -> Any:
    """The tree with its leaves from the stored ones."""
    return jax.tree.unflatten(jax.tree.structure(tree), [jnp.asarray(stored[name]) for name in _named(tree, prefix)])


def fingerprint(state: RunState) -> str:
    """SHA-256 over data, model and policy parameters: equal for bit-equal runs."""
    digest = hashlib.sha256()
    leaves = jax.tree_util.tree_leaves_with_path((state.data, state.model.params, state.policy.params))
    for path, leaf in leaves:
        digest.update(jax.tree_util.keystr(path).encode())
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()


def _plain(state: RunState) -> RunState:
    """The state with its typed key as the raw words that files can hold."""
    key: Key = state.key
    return state._replace(key=jax.random.key_data(key))


def _folder(run: Path, trial: int) -> Path:
    return run / "checkpoints" / f"{trial:04d}"


def _sums(run: Path, trial: int) -> Path:
    return run / "checkpoints" / f"{trial:04d}.json"


def _summed(path: Path) -> dict[str, str]:
    """The sum of each file in a folder, by its name there, which is the same on every system."""
    return {file.relative_to(path).as_posix(): _digest(file) for file in _files(path)}


def _files(path: Path) -> Iterator[Path]:
    return (f for f in sorted(path.rglob("*")) if f.is_file())


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
