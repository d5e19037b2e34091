"""Functions and modules of the user's that settings name. Whatever is wrong with them is one line, with their own."""

import importlib
import importlib.util
import os
import sys
import sysconfig
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from inspect import unwrap
from pathlib import Path
from traceback import extract_tb
from types import ModuleType
from typing import Any

from pegasus_jax.checks import ConfigError, did_you_mean

STANDARD = tuple(sysconfig.get_paths()[name] for name in ("stdlib", "platstdlib"))
INSTALLED = ("site-packages", "dist-packages")
# Frames of these say nothing about what a user wrote.
LIBRARIES = {"jax", "jaxlib", "numpy", "gymnasium", "flax", "optax", "pegasus_jax", "pegasus_envs"}
LONGEST = 300  # characters of somebody else's message


def load(setting: str, name: str | Callable[..., Any]) -> Callable[..., Any]:
    """The function `module:function` that a setting names, also of a module in the working folder; or is, from Python.

    Raises ConfigError, in one line with the user's file and line, where it cannot be had.
    """
    if not isinstance(name, str):
        return name
    module, _, function = name.partition(":")
    what = f"{setting}={name}"
    if module == "__main__" or "<" in function:
        again = "cost=function" if setting == "cost" else f'settings={{"{setting}": function}}'
        raise ConfigError(
            f"{what} is a function of the Python program that began the run, which no other can import; define it in a"
            f" module of its own, or go on in Python: train(resume=RUN, {again})"
        )
    if not (module and function) or module.startswith("."):
        raise ConfigError(f"{what} cannot be imported: expected {setting}=module:function, as in {setting}=robot:cost")
    found = importing(what, module)
    with blamed(what):
        value = getattr(found, function, None)
    if value is None:
        names = [n for n in vars(found) if not n.startswith("_")]
        hint = did_you_mean(function, names).partition("choices:")[0].strip() or f"expected {setting}=module:function"
        raise ConfigError(f"{what} cannot be imported: {origin(module) or module} has no {function}; {hint}")
    if not callable(value):
        raise ConfigError(f"{what} is not a function, but of type {type(value).__name__}: {origin(module)}")
    return value


def importing(what: str, module: str) -> ModuleType:
    """The module of that name, imported. Raises ConfigError that begins with `what`; see `load`."""
    here = os.getcwd()
    if here not in sys.path:
        sys.path.append(here)
    parts = module.split(".")
    if parts[0] not in sys.modules and importlib.util.find_spec(parts[0]) is None:
        raise ConfigError(
            f"{what} cannot be imported: no module named '{parts[0]}' in {here} or among the installed packages"
        )
    for count in range(1, len(parts) + 1):  # from the outside in: to find a module imports those that hold it
        part = ".".join(parts[:count])
        place = origin(part, what)
        own = Path(here, f"{part}.py")
        if count == 1 and own.is_file() and place and own.resolve() != place.resolve():
            raise ConfigError(f"{what} cannot be imported: {part} is {place}, not your {own.name}; rename that file")
    with blamed(what, imports=True):
        return importlib.import_module(module)


def origin(module: str, what: str = "") -> Path | None:
    """The file that a module is, or would be, imported from; None where there is none. Of its parents' code is run."""
    return next(iter(_places(module, what)), None)


def _places(module: str, what: str) -> list[Path]:
    """The file of a module, or the folders of a package without one."""
    loaded = sys.modules.get(module)
    if loaded is not None and getattr(loaded, "__spec__", None) is None:  # made by a program, or the program itself
        return [Path(file)] if (file := getattr(loaded, "__file__", None)) else []
    try:
        with blamed(what or module, imports=True):
            spec = importlib.util.find_spec(module)
    except ValueError as error:
        if isinstance(error, ConfigError) and what:
            raise
        return []
    if spec is None:
        return []
    return (
        [Path(spec.origin)]
        if spec.has_location and spec.origin
        else [*map(Path, spec.submodule_search_locations or ())]
    )


@contextmanager
def blamed(what: str, function: Any = None, imports: bool = False) -> Iterator[None]:
    """Turns whatever is raised within into one line: `what`, the error, and the user's file and line.

    Where no line of theirs was reached, that of `function`. Ctrl-C is none of this.
    """
    try:
        yield
    except (KeyboardInterrupt, ConfigError):
        raise
    except BaseException as error:
        if any(kind.__name__ == "JAXTypeError" for kind in type(error).__mro__):  # JAX need not be imported for that
            place = line_of(error) or definition(function)
            raise ConfigError(
                f"{what} is not a JAX function: it makes a Python number or a NumPy array of x"
                f"{f' at {place}' if place else ''}; use jax.numpy, and jnp.where instead of if"
            ) from error
        middle = " cannot be imported" if imports and isinstance(error, ImportError) else ""
        raise ConfigError(f"{what}{middle}: {told(error, function)}") from error


def told(error: BaseException, function: Any = None) -> str:
    """An error in one line, with the user's file and line where there is one."""
    text = error.msg if isinstance(error, SyntaxError) else str(error)
    text = " ".join(text.split())
    if isinstance(error, SystemExit):
        text = f"it ends the program, sys.exit({text})"
    else:
        text = f"{type(error).__name__}: {text}" if text else type(error).__name__
    text = text if len(text) <= LONGEST else f"{text[:LONGEST]}..."
    place = line_of(error) or definition(function)
    return f"{text} ({place})" if place else text


def line_of(error: BaseException) -> str | None:
    """`file.py:line` of the last of the user's lines that an error went through; None where there is none."""
    if isinstance(error, SyntaxError) and error.filename:
        return f"{Path(error.filename).name}:{error.lineno}"
    return place_of([(frame.filename, frame.lineno or 0) for frame in extract_tb(error.__traceback__)])


def is_refusal(error: BaseException) -> bool:
    """Whether this package refused what the user's code answered, in words of its own: a line of ours raised it."""
    frames = extract_tb(error.__traceback__)
    return isinstance(error, ValueError) and bool(frames) and _ours(Path(frames[-1].filename))


def place_of(lines: Iterable[tuple[str, int]]) -> str | None:
    """`file.py:line` of the last of these (file, line) that is the user's, if it can be not an installed package's."""
    theirs = [(file, line) for file, line in lines if _users(file)]
    own = [(file, line) for file, line in theirs if not {*INSTALLED} & {*Path(file).parts}]
    for file, line in (own or theirs)[-1:]:
        return f"{Path(file).name}:{line}"
    return None


def definition(function: Any) -> str | None:
    """`file.py:line` where a function is defined; None where that is not known."""
    code = getattr(unwrap(function), "__code__", None) if callable(function) else None
    return f"{Path(code.co_filename).name}:{code.co_firstlineno}" if code and _users(code.co_filename) else None


def _users(file: str) -> bool:
    """Whether a line in this file is the user's, not Python's, JAX's, Gymnasium's or ours."""
    path = Path(file)
    if file.startswith("<") or _ours(path):
        return False
    for folder in INSTALLED:
        if folder in path.parts:
            return path.parts[path.parts.index(folder) + 1] not in LIBRARIES
    return not any(path.is_relative_to(folder) for folder in STANDARD)


def _ours(path: Path) -> bool:
    return path.is_relative_to(Path(__file__).parents[1]) or "pegasus_envs" in path.parts
