"""The folder of compiled programs. They are machine code: whoever can write there runs what they like as its user."""

import os
from pathlib import Path


def folder() -> str | None:
    """Where a user's compiled programs are kept; None for a user without a home."""
    try:
        said = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")  # the latter of Windows
        return str(Path(said or Path.home() / ".cache") / "pegasus_jax")
    except RuntimeError:
        return None


def problem(path: Path) -> str | None:
    """Why programs must not be taken from a folder, in words, or None. It is made, for its user alone, if need be."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.mkdir(mode=0o700, exist_ok=True)
        about = path.stat()
    except OSError as error:
        return f"cannot be used for compiled programs: {error.strerror}"
    try:
        user = os.getuid()
    except AttributeError:  # Windows: the folder of a user is closed to others by its access list, and has no mode
        return None
    if about.st_uid != user:
        return "belongs to another user"
    if about.st_mode & 0o022:
        return f"can be written by others (chmod 700 {path} closes it)"
    return None
