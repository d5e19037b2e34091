"""--version of every command, and --version --verbose: what a report of a problem needs."""

import re
from collections.abc import Sequence
from importlib import metadata

NAME = "pegasus-jax"
DEVELOPERS = ('extra == "dev"', "extra == 'dev'")


def asked(words: Sequence[str]) -> bool:
    """Whether the version is asked for."""
    return "--version" in words


def told(words: Sequence[str]) -> str:
    """The version; with --verbose also those of all that this package uses, and the machine."""
    from pegasus_jax.runs.machine import about, installed

    if "--verbose" not in words:
        return f"{NAME} {installed(NAME)}"
    found = about("")
    machine = {name: found[name] for name in ("python", "platform", "processor")} | {
        "devices": ", ".join(found["devices"])
    }
    versions = {name: installed(name) for name in (NAME, *_used())}
    return "\n".join(f"{name:22s} {value}" for name, value in (machine | versions).items())


def _used() -> list[str]:
    """The packages that this one needs, or that its extras name but for developers."""
    try:
        required = metadata.requires(NAME) or []
    except metadata.PackageNotFoundError:  # a source tree on PYTHONPATH
        return ["jax", "jaxlib"]
    users = [text for text in required if not any(extra in text for extra in DEVELOPERS)]
    return sorted({"jaxlib", *(re.split(r"[^\w.-]", text)[0] for text in users)}, key=str.lower)
