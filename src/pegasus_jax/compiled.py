"""Compiled programs of earlier commands, on disk: the same command given again traces nothing.

JAX's own cache saves the compiling of a program, and to look there the program must have been traced and lowered: a
third of the seconds before a first search. Here an executable lies under what it is made of instead: the settings, the
sources of these packages, versions, flags, processor. Only the command line asks, because in another's process any
function of ours may have been replaced.
"""

import gzip
import hashlib
import json
import os
import pickle
import platform
import shutil
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import serialize_executable
from jax.stages import Compiled

from pegasus_jax import record, settings
from pegasus_jax.config import Config
from pegasus_jax.tasks import TASKS

PACKAGES = ("pegasus_jax", "pegasus_envs")  # whose sources the programs are made of
KEPT = 20  # shelves, the last that were used; one of the cart-pole has 3 MB


def shelf(config: Config, **shape: Any) -> Path | None:
    """The folder for the programs of a config and their `shape`, in JAX's cache folder.

    None where they cannot be told from others, or not be read: tasks made of the user's files, several devices,
    anything but a processor, and where JAX keeps no cache.
    """
    cache = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    known = config.task in TASKS and jax.default_backend() == "cpu" and jax.device_count() == 1
    if not known or not cache or "://" in cache:
        return None
    origin = [settings.plain(config), shape, jax.config.values, os.environ.get("XLA_FLAGS"), record.about("")]
    digest = hashlib.sha256(json.dumps([*origin, processor()], sort_keys=True, default=str).encode())
    for package in PACKAGES:
        home = Path(str(resources.files(package)))
        for path in sorted(path for path in home.rglob("*") if path.suffix in (".py", ".xml")):
            digest.update(f"{path.relative_to(home)}\n".encode() + path.read_bytes())
    return Path(cache) / "programs" / digest.hexdigest()[:32]


def processor() -> str:
    """What this machine's processor can execute, as far as the system says."""
    try:
        lines = Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()}"
    return "\n".join(line for line in lines if line.startswith(("model name", "flags", "Features")))


def load(path: Path, arguments: tuple) -> Compiled | None:
    """The program at `path`, if there is one that can be read and takes such arguments."""
    try:
        executable, in_tree, out_tree = pickle.loads(gzip.decompress(path.read_bytes()))
        _find_lapack()
        program = serialize_executable.deserialize_and_load(
            executable, in_tree, out_tree, execution_devices=jax.devices()[:1]
        )
    except Exception:  # of another version, cut short: whatever it is, the program can be compiled
        return None
    os.utime(path.parent)  # used now
    return program if _shapes(program.args_info[0]) == _shapes(arguments) else None


def save(path: Path, program: Compiled) -> None:
    """Keep a program at `path`, and of all shelves the last `KEPT`. What cannot be kept is not."""
    try:
        content = gzip.compress(pickle.dumps(serialize_executable.serialize(program)), 1)
        record.write_whole(path, lambda file: file.write(content))
        shelves = sorted(path.parent.parent.iterdir(), key=lambda folder: folder.stat().st_mtime)
        for old in shelves[:-KEPT]:
            shutil.rmtree(old, ignore_errors=True)
    except (OSError, NotImplementedError, ValueError):  # a full disk; a program that JAX cannot write
        return


def _find_lapack() -> None:
    """Let JAX look up LAPACK, which it does when it lowers a program that calls it, and a loaded one may."""
    jax.jit(jnp.linalg.cholesky).lower(jax.ShapeDtypeStruct((2, 2), float))


def _shapes(arguments: Any) -> tuple[Any, list]:
    leaves, tree = jax.tree.flatten(arguments)
    return tree, [(leaf.shape, leaf.dtype) for leaf in leaves]
