"""Learn a neural-network controller from a few minutes of robot time.

Everything here is a plain function or a plain value, to be jitted, vmapped and differentiated in your own code. What
each name is for: docs/design.md, "Public names".
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pegasus_jax import config, tasks
    from pegasus_jax.assembly.experiments import build, compose
    from pegasus_jax.assembly.pieces import dynamics_of, policy_of
    from pegasus_jax.checks import ConfigError, RunError
    from pegasus_jax.config import Config
    from pegasus_jax.episode import Episode
    from pegasus_jax.experiment import Experiment, Successor, TrialInfo, run, trial
    from pegasus_jax.exports.write import export
    from pegasus_jax.imagine import costs, matching
    from pegasus_jax.imagine.objective import objective
    from pegasus_jax.imagine.rollout import NoiseUse, rollout
    from pegasus_jax.imagine.scenarios import Blocks, Sampler, blocks, draw, sampler
    from pegasus_jax.learn import data
    from pegasus_jax.learn.fit import FitInfo, fit, minibatches
    from pegasus_jax.learn.gradient import SearchInfo, gradient_search
    from pegasus_jax.learn.schedule import SearchTable, search_table
    from pegasus_jax.learn.search import Problem, SearchState, search, searcher
    from pegasus_jax.math import angles, gaussian
    from pegasus_jax.models import dropout as dropouts
    from pegasus_jax.models.bnn import bnn
    from pegasus_jax.models.ensemble import ensemble
    from pegasus_jax.models.lagrangian import lagrangian
    from pegasus_jax.pilco.gp import gp
    from pegasus_jax.pilco.rbf import rbf
    from pegasus_jax.pilco.ssgp import ssgp
    from pegasus_jax.policies.linear import linear
    from pegasus_jax.policies.mlp import mlp
    from pegasus_jax.policies.wrap import of_pair
    from pegasus_jax.runs.controller import Controller, controller
    from pegasus_jax.runs.start import preset, train
    from pegasus_jax.types import (
        Batch,
        Cost,
        Dataset,
        Dropout,
        Dynamics,
        ModelLearner,
        Period,
        Policy,
        PolicyOptimizer,
        Prediction,
        Rollout,
        RunState,
        Scenarios,
        Task,
        TrainState,
        Trajectory,
    )
    from pegasus_jax.vectorized import Vectorized

# Module -> its public names, in the order in which a reader needs them.
_NAMES = {
    # a run, from settings
    "config": "Config",
    "runs.start": "preset train",
    "assembly.experiments": "build compose",
    "assembly.pieces": "dynamics_of policy_of",
    "experiment": "run trial Experiment Successor TrialInfo",
    "checks": "ConfigError RunError",
    "runs.controller": "controller Controller",
    "episode": "Episode",
    "exports.write": "export",
    # the method, function by function
    "imagine.scenarios": "blocks Blocks draw sampler Sampler",
    "imagine.rollout": "rollout NoiseUse",
    "learn.fit": "fit FitInfo minibatches",
    "imagine.objective": "objective",
    "learn.gradient": "gradient_search SearchInfo",
    "learn.search": "search searcher Problem SearchState",
    "learn.schedule": "search_table SearchTable",
    # models and policies
    "models.bnn": "bnn",
    "models.ensemble": "ensemble",
    "models.lagrangian": "lagrangian",
    "pilco.gp": "gp",
    "pilco.ssgp": "ssgp",
    "policies.mlp": "mlp",
    "policies.linear": "linear",
    "policies.wrap": "of_pair",
    "pilco.rbf": "rbf",
    # the values that pass between them
    "types": "Task Cost Trajectory Dataset Batch Dynamics Prediction Dropout Policy Scenarios Period Rollout"
    " TrainState ModelLearner PolicyOptimizer RunState",
    "vectorized": "Vectorized",
}
# Families of functions, each a module under a name of its own: `pegasus_jax.costs.mean`.
_FAMILIES = {
    "angles": "math.angles",
    "config": "config",
    "costs": "imagine.costs",
    "data": "learn.data",
    "dropouts": "models.dropout",
    "gaussian": "math.gaussian",
    "matching": "imagine.matching",
    "tasks": "tasks",
}
_RENAMED = {"Learner": "TrainState", "Fitter": "ModelLearner", "Searcher": "PolicyOptimizer"}
_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = [
    "Batch",
    "Blocks",
    "Config",
    "ConfigError",
    "Controller",
    "Cost",
    "Dataset",
    "Dropout",
    "Dynamics",
    "Episode",
    "Experiment",
    "FitInfo",
    "ModelLearner",
    "NoiseUse",
    "Period",
    "Policy",
    "PolicyOptimizer",
    "Prediction",
    "Problem",
    "Rollout",
    "RunError",
    "RunState",
    "Sampler",
    "Scenarios",
    "SearchInfo",
    "SearchState",
    "SearchTable",
    "Successor",
    "Task",
    "TrainState",
    "Trajectory",
    "TrialInfo",
    "Vectorized",
    "angles",
    "blocks",
    "bnn",
    "build",
    "compose",
    "config",
    "controller",
    "costs",
    "data",
    "draw",
    "dropouts",
    "dynamics_of",
    "ensemble",
    "export",
    "fit",
    "gaussian",
    "gp",
    "gradient_search",
    "lagrangian",
    "linear",
    "matching",
    "minibatches",
    "mlp",
    "objective",
    "of_pair",
    "policy_of",
    "preset",
    "rbf",
    "rollout",
    "run",
    "sampler",
    "search",
    "search_table",
    "searcher",
    "ssgp",
    "tasks",
    "train",
    "trial",
]


def __getattr__(name: str) -> Any:
    """A name is imported when somebody asks for it, so that a command speaks before JAX is there."""
    if name == "__version__":
        from importlib.metadata import version

        return version("pegasus-jax")
    if name in _FAMILIES:
        return import_module(f"{__name__}.{_FAMILIES[name]}")
    if name in _RENAMED:
        raise AttributeError(f"{__name__}.{name} is now called {_RENAMED[name]}")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
