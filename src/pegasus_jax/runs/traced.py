"""Programs as JAX traced them, kept beside the compiled ones: a second run on one of our own plants traces nothing.

A file is a program's StableHLO with the names of the tuples that go in and come out of it, and no pickle. Whoever can
write there runs what they like, as with compiled programs: it is the same folder, with the same checks.
"""

import contextlib
import hashlib
import json
from collections.abc import Callable, Iterable
from functools import cache
from importlib import import_module, metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jax import export

from pegasus_jax.config import Config
from pegasus_jax.runs import cache as folders
from pegasus_jax.runs import config_io
from pegasus_jax.runs.files import write_whole

# Settings that no program depends on, but for the rows that its data have room for.
FREE = ("seed", "trials", "eval_episodes", "data", "data_columns", "data_control")
# Settings behind which there is code of a user, a file or another run: nobody knows what else that depends on.
THEIRS = ("env", "mjcf", "cost", "stop", "goals", "constraint", "reference", "prior", "explore.policy", "init")
PACKAGES = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "numpy")
SOURCES = ("pegasus_jax", "pegasus_envs")  # read, not imported
OURS = ("pegasus_jax.", "optax.")  # modules whose tuples are named in a file


class Store(NamedTuple):
    """Where the programs of a job are."""

    folder: Path | None  # None: they are kept nowhere
    job: str  # what tells its programs from those of all other jobs

    def lower(self, name: str, function: Callable[..., Any], options: dict[str, Any], *arguments: Any) -> Any:
        """The function lowered for arguments of these shapes, with the compiler's options; traced, if it must be."""
        path = self.path(name, arguments)
        found = None if path is None else read(path)
        if found is None:
            found = export.export(jax.jit(function))(*shapes(arguments))
            if path is not None:
                keep(path, found)
        return jax.jit(found.call, compiler_options=options).lower(*arguments)

    def path(self, name: str, arguments: tuple) -> Path | None:
        """The file of a program for arguments of these shapes."""
        if self.folder is None:
            return None
        leaves, tree = jax.tree.flatten(arguments)
        told = repr([self.job, name, tree, [(leaf.shape, str(leaf.dtype)) for leaf in leaves]])
        return self.folder / f"{name}-{hashlib.sha256(told.encode()).hexdigest()}.stablehlo"


def store(config: Config, seeds: int, rows: int, *, alone: bool) -> Store | None:
    """The store for a config's programs, with room for so many `rows` of data. None where they are traced each time: of
    a task with code of its user, on a GPU, and where the job is not `alone` on one device.
    """
    settings = {name: value for name, value in config_io.plain(config).items() if name not in FREE}
    if jax.default_backend() != "cpu" or not alone or any(settings[name] is not None for name in THEIRS):
        return None
    flags = {name: value for name, value in jax.config.values.items() if "cache" not in name}
    told = repr([sorted(settings.items()), seeds, rows, sorted(map(str, flags.items())), jax.device_count(), code()])
    return Store(folder(), hashlib.sha256(told.encode()).hexdigest())


def folder() -> Path | None:
    """The folder of JAX's compiled programs, where they are kept and nobody else can write."""
    where = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if not where or "://" in where or not jax.config.jax_enable_compilation_cache:  # pyright: ignore[reportAttributeAccessIssue]
        return None
    return Path(where) if folders.problem(Path(where)) is None else None


@cache
def code() -> str:
    """SHA-256 of all that a program of our own plants is traced from: our files, and the versions of other packages."""
    digest = hashlib.sha256(repr([(name, metadata.version(name)) for name in PACKAGES]).encode())
    for package in SOURCES:
        spec = find_spec(package)
        for place in (spec and spec.submodule_search_locations) or ():
            for file in sorted(Path(place).rglob("*")):
                if file.suffix in (".py", ".xml"):
                    digest.update(file.read_bytes())
    return digest.hexdigest()


def shapes(tree: Any) -> Any:
    """The shapes of a tree's arrays."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), tree)


def keep(path: Path, program: export.Exported) -> None:
    """Write a program, if all its tuples are ours. A run needs no such file: what the disk refuses is left out."""
    names = sorted(set(tuples([program.in_tree, program.out_tree])))
    if not all(name.startswith(OURS) for name in names):
        return
    register(names)
    content = json.dumps(names).encode() + b"\n" + program.serialize()
    with contextlib.suppress(OSError):
        write_whole(path, lambda file: file.write(hashlib.sha256(content).digest() + content))


def read(path: Path) -> export.Exported | None:
    """The program of a file; None where there is none, or one that is damaged."""
    try:
        whole = path.read_bytes()
    except OSError:
        return None
    digest, content = whole[:32], whole[32:]
    if hashlib.sha256(content).digest() != digest:
        return None
    header, _, program = content.partition(b"\n")
    names = json.loads(header)
    if not all(name.startswith(OURS) for name in names):
        return None  # whoever wrote that, it was not `keep`
    register(names)
    return export.deserialize(bytearray(program))


def tuples(trees: Iterable[Any]) -> Iterable[str]:
    """The types of named tuples in trees, as module:name."""
    for tree in trees:
        kind = None if tree.node_data() is None else tree.node_data()[0]
        if kind not in (None, tuple) and issubclass(kind, tuple):
            yield f"{kind.__module__}:{kind.__qualname__}"
        yield from tuples(tree.children())


def register(names: Iterable[str]) -> None:
    """Let JAX read and write these tuples by name."""
    for name in names:
        _register(name)


@cache
def _register(name: str) -> None:
    module, _, kind = name.partition(":")
    export.register_namedtuple_serialization(getattr(import_module(module), kind), serialized_name=name)
