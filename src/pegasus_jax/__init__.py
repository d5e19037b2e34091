"""Learn a neural-network controller from a few minutes of robot time.

Everything here is a plain function or a plain value, to be jitted, vmapped and differentiated in your own code.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pegasus_jax import tasks
    from pegasus_jax.build import build, compose
    from pegasus_jax.config import Config
    from pegasus_jax.deploy import controller
    from pegasus_jax.fit import fit
    from pegasus_jax.rollout import rollout
    from pegasus_jax.scenarios import draw
    from pegasus_jax.search import objective, optimise
    from pegasus_jax.trial import run, trial

__all__ = [
    "Config",
    "build",
    "compose",
    "controller",
    "draw",
    "fit",
    "objective",
    "optimise",
    "rollout",
    "run",
    "tasks",
    "trial",
]


class _From:
    """A name that is imported from its module when somebody asks for it, so that a command speaks before JAX is there.

    It is a descriptor because some names are also those of their modules, which Python would put in their place.
    """

    def __init__(self, module: str, name: str) -> None:
        self.module, self.name = f"{__name__}.{module}", name

    def __get__(self, package: ModuleType, kind: type) -> Any:
        module = import_module(self.module)
        return getattr(module, self.name) if self.name else module

    def __set__(self, package: ModuleType, value: Any) -> None:
        """Python has imported a module of this name."""


class _Package(ModuleType):
    Config = _From("config", "Config")
    build = _From("build", "build")
    compose = _From("build", "compose")
    controller = _From("deploy", "controller")
    draw = _From("scenarios", "draw")
    fit = _From("fit", "fit")
    objective = _From("search", "objective")
    optimise = _From("search", "optimise")
    rollout = _From("rollout", "rollout")
    run = _From("trial", "run")
    tasks = _From("tasks", "")
    trial = _From("trial", "trial")


sys.modules[__name__].__class__ = _Package
