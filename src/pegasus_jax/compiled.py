"""Compiled programs of earlier commands, on disk: the same command given again traces nothing.

JAX's own cache saves the compiling of a program, and to look there the program must have been traced and lowered: a
third of the seconds before a first search. Here an executable lies under a digest of its lowered program, and that
digest under what the program is made of: the settings, the sources of these packages, versions, flags, processor. Only
the command line asks, because in another's process any function of ours may have been replaced.
"""

import gzip
import hashlib
import json
import os
import pickle
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import serialize_executable
from jax.stages import Compiled, Wrapped

from pegasus_jax import files, machine, settings
from pegasus_jax.config import Config
from pegasus_jax.tasks import TASKS

PACKAGES = ("pegasus_jax", "pegasus_envs")  # whose sources the programs are made of
KEPT = 400  # files, the last that were used; the cart-pole's programs are 16 of them, 3 MB


def shelf(config: Config, **shape: Any) -> Path | None:
    """Where the programs of a config and their `shape` are, in JAX's cache folder: what their files' names begin with.

    None where they cannot be told from others, or not be read: tasks made of the user's files, several devices,
    anything but a processor, and where JAX keeps no cache.
    """
    cache = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    known = config.task in TASKS and jax.default_backend() == "cpu" and jax.device_count() == 1
    if not known or not cache or "://" in cache:
        return None
    digest = hashlib.sha256(json.dumps([settings.plain(config), shape], sort_keys=True, default=str).encode())
    digest.update(surroundings())
    for package in PACKAGES:
        home = Path(str(resources.files(package)))
        for path in sorted(path for path in home.rglob("*") if path.suffix in (".py", ".xml")):
            digest.update(f"{path.relative_to(home)}\n".encode() + path.read_bytes())
    return Path(cache) / "programs" / digest.hexdigest()[:32]


def surroundings() -> bytes:
    """What one lowered program may become different executables by."""
    about = {key: value for key, value in machine.about("").items() if key != "command"}
    config = {
        key: value for key, value in jax.config.values.items() if key != "jax_num_cpu_devices"
    }  # `about` lists them
    executes = [machine.processor().get(name) for name in ("flags", "Features")]  # as x86 and ARM call it
    known = [config, os.environ.get("XLA_FLAGS"), about, executes]
    return json.dumps(known, sort_keys=True, default=str).encode()


def program(path: Path, function: Wrapped, arguments: tuple, options: dict[str, Any]) -> Compiled:
    """The function, jitted with these options, compiled for such arguments.

    That is the executable that `path` names, or the one that the same lowered program has become before, or a new one;
    `path` names it from then on. JAX's cache must be off: an executable that was read from there cannot be written.
    """
    try:
        named = path.with_name(path.read_text())
    except (OSError, ValueError):  # a name cut short is none
        named = None
    if named and (found := read(named, arguments)):
        touch(path)
        return found
    lowered = function.lower(*arguments)
    what = [lowered.as_text(), str(lowered.in_tree), str(lowered.out_tree), str(options)]
    named = path.with_name(hashlib.sha256("\n".join(what).encode() + surroundings()).hexdigest())
    found = read(named, arguments)
    if found is None:
        found = lowered.compile()
        write(named, found)
    keep(path, named.name.encode())
    return found


def read(path: Path, arguments: tuple) -> Compiled | None:
    """The executable at `path`, if there is one that can be read and takes such arguments."""
    try:
        executable, *trees = pickle.loads(gzip.decompress(path.read_bytes()))
        _find_lapack()
        found = serialize_executable.deserialize_and_load(executable, *trees, execution_devices=jax.devices()[:1])
    except Exception:  # of another version, cut short: whatever it is, the program can be compiled
        return None
    touch(path)
    return found if _shapes(found.args_info[0]) == _shapes(arguments) else None


def write(path: Path, found: Compiled) -> None:
    """Keep an executable at `path`. What JAX cannot write is not kept."""
    try:
        content = serialize_executable.serialize(found)
    except (NotImplementedError, ValueError):
        return
    keep(path, gzip.compress(pickle.dumps(content), 1))


def keep(path: Path, content: bytes) -> None:
    """Write a file, and of all the last `KEPT` stay; on a full disk, none is written."""
    try:
        files.write_whole(path, lambda file: file.write(content))
        kept = sorted(path.parent.iterdir(), key=lambda file: file.stat().st_mtime)
        for old in kept[:-KEPT]:
            old.unlink()
    except OSError:  # or another process was quicker
        return


def touch(path: Path) -> None:
    """Used now, if it is still there."""
    if path.exists():
        path.touch()


def _find_lapack() -> None:
    """Let JAX look up LAPACK, which it does when it lowers a program that calls it, and a loaded one may."""
    jax.jit(jnp.linalg.cholesky).lower(jax.ShapeDtypeStruct((2, 2), jnp.float32))


def _shapes(arguments: Any) -> tuple[Any, list]:
    leaves, tree = jax.tree.flatten(arguments)
    return tree, [(leaf.shape, leaf.dtype) for leaf in leaves]
