"""The words that choose several settings at once: `model=`, `policy=` and `algorithm=`."""

from typing import Any

from pegasus_jax.config import BNN, GP, LBFGS, MLP, RBF, SSGP, Analytic, Fit, Lagrangian, Linear, Search

# The named variants that `model=`, `policy=` and `algorithm=` select: what each changes in the defaults, whole sections
# first. A dotted change counts only where the chosen sections have such a setting.
MODELS: dict[str, dict[str, Any]] = {
    "log_normal": {},
    "binary": {"model": BNN(dropout="binary")},
    "concrete": {"model": BNN(dropout="concrete")},
    "gaussian": {"model": BNN(dropout="gaussian")},
    "sparse": {"model": BNN(dropout="sparse")},
    "deterministic": {"model": BNN(dropout="none")},
    "ensemble": {"model": BNN(dropout="none", members=5)},
    # Widths and numbers of steps once more, because a task's own are meant for the network of the paper.
    "lagrangian": {
        "model": Lagrangian(),
        "model.hidden": Lagrangian.hidden,
        "fit.steps": 3000,
        "fit.learning_rate": 3e-3,
    },
    "gp": {"model": GP(), "fit": LBFGS(starts=10), "fit.steps": 300},
    "ssgp": {"model": SSGP(), "fit": LBFGS(), "fit.steps": 300},
}
POLICIES: dict[str, dict[str, Any]] = {
    "mlp": {"policy.dropout": 0.0},
    "dropout_mlp": {"policy.dropout": 0.1},
    "rbf": {"policy": RBF()},
    "rbf100": {"policy": RBF(units=100)},
    "linear": {"policy": Linear()},
}
ALGORITHMS: dict[str, dict[str, Any]] = {
    "pegasus": {},  # the defaults: what learned best (docs/decisions)
    "paper": {  # Alg. 3 as printed: all draws but the start particles held for a whole search
        "model.activation": "relu",
        "model.kl_weight": 1.0,
        "policy.dropout": 0.1,
        "fit.learning_rate": 1e-4,
        "search.period.start": 1,
        "search.period.dynamics": 0,
        "search.period.policy": 0,
        "search.period.sensor": 0,
        "search.period.match": 0,
        "search.cost": "particles",
        "search.widen": 1.0,
        "search.balanced": False,
        "search.refine": 0.0,
        "search.reset": False,
        "search.restart": False,
        "search.anew": False,
    },
    "deep_pilco": {  # Alg. 2: everything redrawn every iteration, no clipping
        "model.activation": "relu",
        "model.kl_weight": 1.0,
        "policy.dropout": 0.1,
        "fit.learning_rate": 1e-4,
        "search.restart": False,
        "search.anew": False,
        "search.particles": 10,
        "search.cost": "particles",
        "search.widen": 1.0,
        "search.balanced": False,
        "search.refine": 0.0,
        "search.clip": None,
        "search.period.start": 1,
        "search.period.dynamics": 1,
        "search.period.policy": 1,
        "search.period.sensor": 1,
        "search.period.match": 1,
    },
    "pilco": {"search": Analytic(), "search.steps": Analytic.steps, "precision": "double"},
}

# What each section can be, by the kind that a stored config names.
KINDS: dict[str, dict[str, Any]] = {
    "model": {"bnn": BNN(), "gp": GP(), "ssgp": SSGP(), "lagrangian": Lagrangian()},
    "policy": {"mlp": MLP(), "rbf": RBF(), "linear": Linear()},
    "fit": {"adam": Fit(), "lbfgs": LBFGS()},
    "search": {"particles": Search(), "analytic": Analytic()},
}
