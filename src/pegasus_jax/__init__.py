"""Learn a neural-network controller from a few minutes of robot time.

Everything here is a plain function or a plain value, to be jitted, vmapped and differentiated in your own code. What
each name is for: the API reference of the documentation, and `_NAMES`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pegasus_jax import config as config
    from pegasus_jax import memory as memory
    from pegasus_jax import tasks as tasks
    from pegasus_jax.assembly.experiments import build as build
    from pegasus_jax.assembly.experiments import compose as compose
    from pegasus_jax.assembly.pieces import dynamics_of as dynamics_of
    from pegasus_jax.assembly.pieces import policy_of as policy_of
    from pegasus_jax.checks import ConfigError as ConfigError
    from pegasus_jax.checks import RunError as RunError
    from pegasus_jax.config import Config as Config
    from pegasus_jax.episode import Episode as Episode
    from pegasus_jax.experiment import Experiment as Experiment
    from pegasus_jax.experiment import Successor as Successor
    from pegasus_jax.experiment import TrialInfo as TrialInfo
    from pegasus_jax.experiment import run as run
    from pegasus_jax.experiment import trial as trial
    from pegasus_jax.exports.write import export as export
    from pegasus_jax.imagine import costs as costs
    from pegasus_jax.imagine import matching as matching
    from pegasus_jax.imagine.limits import Constraint as Constraint
    from pegasus_jax.imagine.objective import objective as objective
    from pegasus_jax.imagine.rollout import NoiseUse as NoiseUse
    from pegasus_jax.imagine.rollout import rollout as rollout
    from pegasus_jax.imagine.scenarios import Blocks as Blocks
    from pegasus_jax.imagine.scenarios import Sampler as Sampler
    from pegasus_jax.imagine.scenarios import blocks as blocks
    from pegasus_jax.imagine.scenarios import draw as draw
    from pegasus_jax.imagine.scenarios import sampler as sampler
    from pegasus_jax.learn import data as data
    from pegasus_jax.learn.fit import FitInfo as FitInfo
    from pegasus_jax.learn.fit import fit as fit
    from pegasus_jax.learn.fit import minibatches as minibatches
    from pegasus_jax.learn.gradient import SearchInfo as SearchInfo
    from pegasus_jax.learn.gradient import gradient_search as gradient_search
    from pegasus_jax.learn.rounds import Progress as Progress
    from pegasus_jax.learn.schedule import SearchTable as SearchTable
    from pegasus_jax.learn.schedule import search_table as search_table
    from pegasus_jax.learn.search import Problem as Problem
    from pegasus_jax.learn.search import search as search
    from pegasus_jax.learn.search import searcher as searcher
    from pegasus_jax.learn.visits import SearchState as SearchState
    from pegasus_jax.logs.read import load_logs as load_logs
    from pegasus_jax.math import angles as angles
    from pegasus_jax.math import gaussian as gaussian
    from pegasus_jax.math.delays import Delay as Delay
    from pegasus_jax.math.delays import delay_of as delay_of
    from pegasus_jax.models import dropout as dropouts  # noqa: F401
    from pegasus_jax.models.bnn import bnn as bnn
    from pegasus_jax.models.ensemble import ensemble as ensemble
    from pegasus_jax.models.lagrangian import lagrangian as lagrangian
    from pegasus_jax.pilco.gp import gp as gp
    from pegasus_jax.pilco.rbf import rbf as rbf
    from pegasus_jax.pilco.ssgp import ssgp as ssgp
    from pegasus_jax.policies.linear import linear as linear
    from pegasus_jax.policies.mlp import mlp as mlp
    from pegasus_jax.policies.wrap import of_pair as of_pair
    from pegasus_jax.runs.controller import Controller as Controller
    from pegasus_jax.runs.controller import controller as controller
    from pegasus_jax.start import preset as preset
    from pegasus_jax.start import train as train
    from pegasus_jax.task import Signal as Signal
    from pegasus_jax.task import Task as Task
    from pegasus_jax.types import Batch as Batch
    from pegasus_jax.types import Cost as Cost
    from pegasus_jax.types import Dataset as Dataset
    from pegasus_jax.types import Dropout as Dropout
    from pegasus_jax.types import Dynamics as Dynamics
    from pegasus_jax.types import Hindsight as Hindsight
    from pegasus_jax.types import Memory as Memory
    from pegasus_jax.types import ModelLearner as ModelLearner
    from pegasus_jax.types import Period as Period
    from pegasus_jax.types import Policy as Policy
    from pegasus_jax.types import PolicyOptimizer as PolicyOptimizer
    from pegasus_jax.types import Prediction as Prediction
    from pegasus_jax.types import Rollout as Rollout
    from pegasus_jax.types import RunState as RunState
    from pegasus_jax.types import Scenarios as Scenarios
    from pegasus_jax.types import TrainState as TrainState
    from pegasus_jax.types import Trajectory as Trajectory
    from pegasus_jax.vectorized import Vectorized as Vectorized

# Module -> its public names, in the order in which a reader needs them.
_NAMES = {
    # a run, from settings
    "config": "Config",
    "start": "preset train",
    "logs.read": "load_logs",
    "assembly.experiments": "build compose",
    "assembly.pieces": "dynamics_of policy_of",
    "experiment": "run trial Experiment Successor TrialInfo",
    "checks": "ConfigError RunError",
    "runs.controller": "controller Controller",
    "exports.write": "export",
    "math.delays": "delay_of Delay",
    "episode": "Episode",
    # the method, function by function
    "imagine.scenarios": "blocks Blocks draw sampler Sampler",
    "imagine.rollout": "rollout NoiseUse",
    "learn.fit": "fit FitInfo minibatches",
    "imagine.objective": "objective",
    "learn.gradient": "gradient_search SearchInfo",
    "learn.search": "search searcher Problem",
    "learn.visits": "SearchState",
    "learn.rounds": "Progress",
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
    "task": "Task Signal",
    "imagine.limits": "Constraint",
    "types": "Cost Trajectory Dataset Batch Dynamics Prediction Dropout Policy Memory Hindsight Scenarios"
    " Period Rollout TrainState ModelLearner PolicyOptimizer RunState",
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
    "memory": "memory",
    "tasks": "tasks",
}
_RENAMED = {"Learner": "TrainState", "Fitter": "ModelLearner", "Searcher": "PolicyOptimizer"}
_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = sorted((*_MODULES, *_FAMILIES))  # pyright: ignore[reportUnsupportedDunderAll]


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
