"""Files that appear whole or not at all, with the mode that the user's umask gives every new file."""

import json
import math
import os
import secrets
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

from filelock import FileLock, Timeout

from pegasus_jax.checks import RunError


def beside(path: Path) -> Path:
    """A new name in the folder of `path`, `.NAME.RANDOM`, for the file that will take its place."""
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}")


def held(path: Path, taken: str) -> FileLock:
    """The lock of a file, held until released. Raises RunError, which says `taken`, where another process has it."""
    guard = FileLock(path)
    try:
        guard.acquire(timeout=0)
    except Timeout:
        raise RunError(taken) from None
    return guard


def write_whole(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Let `write` fill a file that then appears at `path` whole, and survives a power cut.

    A symbolic link at `path` is replaced, not followed.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = beside(path)
    handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    try:
        with os.fdopen(handle, "wb") as file:
            write(file)
            file.flush()
            _to_disk(file.fileno())
        take_place(temporary, path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is None:  # such as a full disk
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise
    _flush(path.parent)


def take_place(new: Path, path: Path, seconds: float = 2.0) -> None:
    """Rename a file over another one.

    Windows refuses that while somebody reads the other one, as pegasus-watch does for a moment: it is tried again for
    so many seconds.
    """
    end = time.monotonic() + seconds
    while True:
        try:
            os.replace(new, path)
            return
        except PermissionError:
            if sys.platform != "win32" or time.monotonic() > end:
                raise
            time.sleep(0.02)


def _to_disk(handle: int) -> None:
    """Let a file survive a power cut; fsync of macOS leaves it in the memory of the disk."""
    try:
        import fcntl

        fcntl.fcntl(handle, fcntl.F_FULLFSYNC)  # pyright: ignore[reportAttributeAccessIssue]
    except (ImportError, AttributeError, OSError):  # another system, or a file system without it
        os.fsync(handle)


def _flush(folder: Path) -> None:
    """Let a folder's names survive a power cut, where folders can be opened: Windows journals names itself."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except PermissionError:
        return
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def refused(error: OSError) -> str:
    """What a file system refused, in one line that names the file."""
    reason = error.strerror or " ".join(str(error).split()) or type(error).__name__
    return f"{error.filename}: {reason}" if error.filename else reason


def write_json(path: Path, value: Any) -> None:
    """Write one JSON document, whole."""
    write_whole(path, lambda file: file.write(json.dumps(strict(value), indent=1, allow_nan=False).encode() + b"\n"))


def strict(value: Any) -> Any:
    """The value with None for every number that JSON has no word for: NaN and the infinities."""
    if isinstance(value, dict):
        return {key: strict(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [strict(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
