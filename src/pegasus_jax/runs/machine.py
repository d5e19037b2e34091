"""What a run was made with: versions, machine, CPUs."""

import os
import platform
import sys
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any


def cpus() -> int:
    """How many CPUs this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # macOS does not tell
        return os.cpu_count() or 1


def about(command: str) -> dict[str, Any]:
    """Versions, machine and command: what somebody else needs to repeat the run."""
    import jax

    packages = ("pegasus-jax", "jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "orbax-checkpoint", "numpy")
    return {
        "command": command,
        "python": sys.version.split()[0],
        "platform": platform.platform(),
        "processor": ", ".join(f"{label}{cpu()[name]}" for name, label in NAMED.items() if name in cpu()),
        "devices": [str(device) for device in jax.devices()],
        "versions": {name: installed(name) for name in packages},
    }


def installed(name: str) -> str:
    """The version of a package, or that there is none."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


# What tells CPUs apart: a virtual machine may call two generations by one name.
NAMED = {"model name": "", "cpu family": "family ", "model": "model "}


@cache
def cpu() -> dict[str, str]:
    """What the system says of its first CPU, at least its "model name"; on Linux also what it can execute."""
    known = {"model name": f"{platform.machine()} {platform.processor()}"}
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n")[0].splitlines()
    except OSError:
        return known
    return known | {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
