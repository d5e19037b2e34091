"""Learn a neural-network controller from a few minutes of robot time.

Everything here is a plain function or a plain value, to be jitted, vmapped and differentiated in your own code.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pegasus_jax import tasks
    from pegasus_jax.builder import build, compose
    from pegasus_jax.config import Config
    from pegasus_jax.experiment import run, trial
    from pegasus_jax.imagine.rollout import rollout
    from pegasus_jax.imagine.scenarios import draw
    from pegasus_jax.learn.fit import fit
    from pegasus_jax.learn.search import objective, optimise
    from pegasus_jax.presets import preset
    from pegasus_jax.runs.controller import controller

_MODULES = {
    "Config": "config",
    "build": "builder",
    "compose": "builder",
    "controller": "runs.controller",
    "draw": "imagine.scenarios",
    "fit": "learn.fit",
    "objective": "learn.search",
    "optimise": "learn.search",
    "preset": "presets",
    "rollout": "imagine.rollout",
    "run": "experiment",
    "tasks": "tasks",
    "trial": "experiment",
}
__all__ = [
    "Config",
    "build",
    "compose",
    "controller",
    "draw",
    "fit",
    "objective",
    "optimise",
    "preset",
    "rollout",
    "run",
    "tasks",
    "trial",
]


def __getattr__(name: str) -> Any:
    """A name is imported when somebody asks for it, so that a command speaks before JAX is there."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    module = import_module(f"{__name__}.{_MODULES[name]}")
    return module if name == "tasks" else getattr(module, name)


def __dir__() -> list[str]:
    return __all__
