"""The tasks' names and what each changes in the defaults of config.py.

Imports neither JAX nor a simulator, so that a command says what it will do before it waits for them.
"""

from pathlib import Path
from typing import Any

from pegasus_jax.config import Config

MANOEUVRES = ("knife_edge", "belly_up", "corkscrew", "depth_change")
GYM = "gym"  # the task that `env=` and `cost=` describe
MJCF = "mjcf"  # the task that `mjcf=`, `cost=`, `dt=` and `horizon=` describe
NAMES = ("cartpole", "double_cartpole", *(f"swimmer_{manoeuvre}" for manoeuvre in MANOEUVRES), GYM, MJCF)

# The search that finds a way on most seeds: docs/decisions/0014 and 0015.
_FINDING: dict[str, Any] = {"search.balanced": True, "search.refine": 0.5}

# A cost of one's own has no width to widen; its expectation is a mean over nodes: docs/decisions/0018.
_OWN_COST: dict[str, Any] = {"search.widen": 1.0, **_FINDING}
# A robot runs a new policy only where it is expected to be better than the one before.
_GYM: dict[str, Any] = {**_OWN_COST, "successor": "better"}

_CARTPOLE: dict[str, Any] = {
    "model.substeps": 1,  # no pole turns fast enough for two to matter
    "search.widen": 2.0,
    **_FINDING,
}

# docs/reference.md 2.2; the paper's networks, dropout and step size.
_DOUBLE_CARTPOLE: dict[str, Any] = {
    "trials": 40,
    "model.hidden": (200,) * 4,
    "policy.hidden": (50,) * 4,
    "policy.dropout": 0.1,
    "search.learning_rate": 1e-4,
    "explore.trials": 2,
}

# docs/reference.md 3.4; what the legs do not change. The policy's dropout is the paper's .1, as on every plant.
_SWIMMER: dict[str, Any] = {
    "trials": 50,
    "model.hidden": (200,) * 4,
    "model.initialiser": "orthogonal",
    "policy.hidden": (200,) * 4,
    "policy.dropout": 0.1,
    "policy.initialiser": "orthogonal",
    "search.steps": 500,
    "search.learning_rate": 1e-4,
    "explore.trials": 5,
    "explore.kind": "walk",
    "search.cost": "particles",  # so it was measured
    "search.widen": 1.0,
    **_FINDING,
    "search.anew": True,  # docs/decisions/0016
}
_LEGS: dict[int, dict[str, Any]] = {
    2: {"search.particles": 400, "fit.steps": 2000},
    6: {"search.particles": 500, "fit.steps": 4000},
}


# The model with which a task is learned best, where it is not the default one, and what is changed with it:
# docs/decisions/0006, 0008, 0009 and, for the swimmer, 0017.
BEST: dict[str, tuple[str, dict[str, Any]]] = {
    **{
        f"swimmer_{manoeuvre}": ("log_normal", {"model.members": 5, "model.kl_weight": 1.0}) for manoeuvre in MANOEUVRES
    },
    "cartpole": ("lagrangian", {}),
    "double_cartpole": (
        "lagrangian",
        {
            "model.substeps": 4,
            "policy.dropout": 0.0,
            "policy.input_units": (1.0, 3.0, 6.0, 8.0),
            "fit.steps": 5000,
            "fit.decay": 0.03,
            "search.steps": 600,
            "search.learning_rate": 3e-3,
            "search.decay": 0.03,
            "search.match": False,
            "search.cost": "particles",
            "search.anneal": 14,
            "search.reheat": 0.17,
            "search.limit": 1.0,
            "search.loosen": 30.0,
            "search.sensors": "known",
            "explore.trials": 4,
            "explore.kind": "walk",
        },
    ),
}


def defaults(name: str, legs: int = 2) -> dict[str, Any]:
    """What a task changes in the defaults of config.py, by dotted name."""
    if name == GYM:
        return _GYM
    if name == MJCF:
        return _OWN_COST
    if name == "cartpole":
        return _CARTPOLE
    if name == "double_cartpole":
        return _DOUBLE_CARTPOLE
    faster = {"search.learning_rate": 1e-3} if (name, legs) == ("swimmer_depth_change", 2) else {}
    return {**_SWIMMER, **_LEGS[legs], **faster}


def label(config: Config) -> str:
    """The task with what tells it from others of its name, as part of a folder's name."""
    if config.task.startswith("swimmer_"):
        return f"{config.task}-legs{config.legs}"
    own = {GYM: config.env, MJCF: Path(config.mjcf or "").stem}.get(config.task)
    return f"{config.task}-{own}".replace("/", "-").replace(":", "-") if own else config.task
