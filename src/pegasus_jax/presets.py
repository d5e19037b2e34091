"""The presets: whole configs, a value each, and the words that change whole sections of one.

A command begins with a preset, its task's own or the one that `preset=` names. `model=`, `algorithm=`, `policy=` and
`effort=` change it in this order; single keys come last. Imports neither JAX nor a simulator, so that a command says
what it will do before it waits for them.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from pegasus_jax.checks import ConfigError, did_you_mean
from pegasus_jax.config import (
    BNN,
    GP,
    GYM,
    LBFGS,
    MANEUVERS,
    MJCF,
    MLP,
    RBF,
    SSGP,
    Analytic,
    Config,
    Explore,
    Fit,
    Lagrangian,
    Linear,
    Period,
    Search,
)
from pegasus_jax.config_models import several

# A plant of few dimensions needs no more, and narrow layers larger steps: docs/decisions.md 0037.
SMALL_POLICY, SMALL_POLICY_STEP = MLP(hidden=(64, 64)), 3e-3

CARTPOLE = Config(
    task="cartpole",
    model=Lagrangian(substeps=1),  # one: docs/decisions.md 0036
    fit=Fit(steps=3000, learning_rate=3e-3),
    policy=SMALL_POLICY,
    # docs/decisions.md 0014, 0015, 0029 and 0041.
    search=Search(
        particles=50,
        learning_rate=SMALL_POLICY_STEP,
        standardized_noise=True,
        refine_fraction=0.5,
        init="raced",
    ),
)

# docs/decisions.md 0006, 0008, 0009 and 0011.
DOUBLE_CARTPOLE = Config(
    task="double_cartpole",
    trials=40,
    model=Lagrangian(substeps=4),
    policy=MLP(hidden=(50,) * 4, input_units=(1.0, 3.0, 6.0, 8.0)),
    fit=Fit(steps=5000, learning_rate=3e-3, decay=0.03),
    search=Search(
        steps=600,
        learning_rate=3e-3,
        decay=0.03,
        matching="never",
        cost_estimator="particles",
        cost_width_start=4.0,
        anneal_trials=14,
        warm_restart=0.17,
        particle_grad_limit=1.0,
        warm_limit_factor=30.0,
        observation_noise="plant",
    ),
    explore=Explore(trials=4, kind="walk"),
)

# docs/reference.md 2.2: the paper's networks, dropout and step size.
DOUBLE_CARTPOLE_NETWORK = Config(
    task="double_cartpole",
    trials=40,
    model=BNN(hidden=(200,) * 4),
    policy=MLP(hidden=(50,) * 4, dropout=0.1),
    search=Search(learning_rate=1e-4, cost_width_start=4.0),
    explore=Explore(trials=2),
)


def own(task: str, legs: int = 2) -> str:
    """The name of the preset that a task begins with, for a swimmer by the legs that it drives."""
    return f"{task}_six_legs" if legs == 6 else task


def swimmer_network(maneuver: str, legs: int) -> Config:
    """The networks of docs/reference.md 3.4."""
    return Config(
        task=f"swimmer_{maneuver}",
        legs=legs,
        trials=50,
        model=BNN(hidden=(200,) * 4, initializer="orthogonal"),
        policy=MLP(hidden=(200,) * 4, dropout=0.1, initializer="orthogonal"),
        fit=Fit(steps={2: 2000, 6: 4000}[legs]),
        search=Search(
            steps=500,
            particles=200,
            cost_estimator="particles",
            cost_width_start=1.0,
            standardized_noise=True,
            refine_fraction=0.5,
            init="fresh",
        ),
        explore=Explore(trials=2, kind="walk"),
    )


# For any plant. The expectation of a cost of one's own is a mean over nodes: docs/decisions.md 0018. Such a plant may
# start anywhere: 0024. It is to hold for longer than an episode: 0023.
DEFAULT = Config(
    model=BNN(hidden=(100, 100), ensemble_size=None, kl_weight=None),
    policy=SMALL_POLICY,
    search=Search(
        learning_rate=SMALL_POLICY_STEP,
        standardized_noise=True,
        refine_fraction=0.5,
        matching="narrow",
        visited_starts=0.5,
    ),
    successor="better",  # a robot runs a new policy only where it is expected to be better than the one before
)

SWIMMERS = {own(f"swimmer_{name}", legs): (name, legs) for legs in (2, 6) for name in MANEUVERS}

# With a Bayesian neural network as the paper has it: what `model=` and the paper's algorithms change.
NETWORKS: dict[str, Config] = {
    "cartpole_network": replace(  # the paper's sizes
        CARTPOLE,
        model=BNN(),
        fit=Fit(),
        policy=MLP(),
        search=replace(
            CARTPOLE.search, particles=Search.particles, learning_rate=Search.learning_rate, init=Search.init
        ),
    ),
    "double_cartpole_network": DOUBLE_CARTPOLE_NETWORK,
    **{f"{name}_network": swimmer_network(*which) for name, which in SWIMMERS.items()},
}

FOR_ANY = ("default",)  # presets that any task can begin with

PRESETS: dict[str, Config] = {
    "default": DEFAULT,
    "cartpole": CARTPOLE,
    "double_cartpole": DOUBLE_CARTPOLE,
    "double_cartpole_gpu": replace(  # eight policies side by side: docs/decisions.md 0010
        DOUBLE_CARTPOLE,
        fit=replace(DOUBLE_CARTPOLE.fit, steps=3000),
        search=replace(DOUBLE_CARTPOLE.search, num_starts=8, particles=96, steps=2000),
    ),
    **{
        name: replace(DEFAULT, task=f"swimmer_{maneuver}", legs=legs, trials=30)
        for name, (maneuver, legs) in SWIMMERS.items()
    },
    GYM: replace(DEFAULT, task=GYM),
    MJCF: replace(DEFAULT, task=MJCF),
    **NETWORKS,
}

Change = Callable[[Config], Config]


def _network(**changes: Any) -> Change:
    return lambda config: replace(config, model=replace(config.model, **changes))


def _lagrangian(config: Config) -> Config:
    assert isinstance(config.model, BNN)
    # Five mechanisms know what they do not know: docs/decisions.md 0036.
    model = Lagrangian(initializer=config.model.initializer, ensemble_size=5)
    return replace(config, model=model, fit=Fit(steps=1000, learning_rate=3e-3))


def _dropout(rate: float) -> Change:
    return lambda config: replace(config, policy=replace(config.policy, dropout=rate))


# Each changes a preset with a network.
MODELS: dict[str, Change] = {
    "log_normal": lambda config: config,
    "binary": _network(dropout="binary"),
    "concrete": _network(dropout="concrete"),
    "gaussian": _network(dropout="gaussian"),
    "sparse": _network(dropout="sparse"),
    "deterministic": _network(dropout="none", ensemble_size=1),
    "ensemble": _network(dropout="none", ensemble_size=5),
    "lagrangian": _lagrangian,
    "gp": lambda config: replace(config, model=GP(), fit=LBFGS(num_starts=10)),
    "ssgp": lambda config: replace(config, model=SSGP(), fit=LBFGS()),
}
POLICIES: dict[str, Change] = {
    "mlp": _dropout(0.0),
    "dropout_mlp": _dropout(0.1),
    "rbf": lambda config: replace(config, policy=RBF()),
    "rbf100": lambda config: replace(config, policy=RBF(num_centers=100)),
    "linear": lambda config: replace(config, policy=Linear()),
}


def _papers(config: Config, **search: Any) -> Config:
    """The paper's network, dropout in the policy and step sizes, with a search that follows each particle."""
    model, fit = config.model, config.fit
    assert isinstance(config.search, Search)
    if isinstance(model, BNN | Lagrangian):
        model = replace(model, activation="relu", ensemble_size=several(model), kl_weight=1.0)
    if isinstance(fit, Fit):
        fit = replace(fit, learning_rate=1e-4)
    plain = dict(
        learning_rate=min(config.search.learning_rate, Search.learning_rate),
        cost_estimator="particles",
        cost_width_start=1.0,
        matching="always",
        visited_starts=0.0,
        standardized_noise=False,
        refine_fraction=0.0,
        init="previous",
    )
    changed = replace(config.search, **plain, **search)
    return replace(_dropout(0.1)(config), model=model, fit=fit, search=changed)


ALGORITHMS: dict[str, Change] = {
    "pegasus": lambda config: config,  # what learned best (docs/decisions)
    # Alg. 3 as printed: all draws but the start particles held for a whole search.
    "paper": lambda config: _papers(config, reset_optimizer=False, period=Period(1, 0, 0, 0, 0)),
    # Alg. 2: everything redrawn every iteration, no clipping.
    "deep_pilco": lambda config: _papers(config, particles=10, grad_clip=None, period=Period(dynamics=1)),
    "pilco": lambda config: replace(config, search=Analytic(particles=config.search.particles), x64=True),
}


def _four_policies(config: Config) -> Config:
    if not isinstance(config.search, Search):
        raise ConfigError(
            "effort=gpu is policies side by side, of which this search has one; the nearest is effort=laptop"
        )
    return replace(config, search=replace(config.search, num_starts=max(4, config.search.num_starts)))


# How much computing a trial is worth: docs/decisions.md 0012.
EFFORTS: dict[str, Change] = {
    "laptop": lambda config: config,
    "workstation": lambda config: replace(config, search=replace(config.search, steps=2 * config.search.steps)),
    "gpu": _four_policies,
}

WORDS = {"preset": PRESETS, "model": MODELS, "policy": POLICIES, "algorithm": ALGORITHMS, "effort": EFFORTS}


def preset(
    name: str = "cartpole",
    *,
    model: str | None = None,
    policy: str | None = None,
    algorithm: str | None = None,
    effort: str | None = None,
) -> Config:
    """What a command with these words begins with: preset("cartpole") is the config of pegasus-train task=cartpole.

    `model`, `policy`, `algorithm` and `effort` are the command line's words. A model that is not the preset's own, and
    every algorithm but "pegasus", change the preset NAME_network where there is one: what was tuned for one says
    nothing of another.
    Raises ConfigError for an unknown word, in one line with the nearest one.
    """
    said = {"preset": name, "model": model, "policy": policy, "algorithm": algorithm, "effort": effort}
    for word, value in said.items():
        if value is not None and value not in WORDS[word]:
            raise ConfigError(f"{word}={value} is unknown; {did_you_mean(value, WORDS[word])}")
    own = model in (None, PRESETS[name].model.kind) and algorithm in (None, "pegasus")
    config = PRESETS[name if own else network(name)]
    for change in (MODELS["log_normal" if own else model or "log_normal"], ALGORITHMS[algorithm or "pegasus"]):
        config = change(config)
    if policy:
        config = POLICIES[policy](config)
    return EFFORTS[effort or "laptop"](config)


def network(name: str) -> str:
    """The preset of the same task, and as many legs, that has a network."""
    of = PRESETS[name]
    same = (one for one, config in NETWORKS.items() if (config.task, config.legs) == (of.task, of.legs))
    return name if name in (*FOR_ANY, *NETWORKS) else next(same, name)
