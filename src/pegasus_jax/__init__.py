"""Learn a neural-network controller from a few minutes of robot time.

Everything here is a plain function or a plain value, to be jitted, vmapped and differentiated in your own code.
"""

from pegasus_jax import tasks
from pegasus_jax.build import build, compose
from pegasus_jax.config import Config
from pegasus_jax.deployed import controller
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
