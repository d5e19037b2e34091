"""Every setting, typed, with its default and its limits. Frozen and hashable: a config is a key.

Values are checked when a config is made; a bad one raises `ConfigError`, which names it and what was expected.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from pegasus_jax import checks
from pegasus_jax.checks import ConfigError
from pegasus_jax.config_models import BNN, GP, SSGP, Lagrangian, Model, setting, several
from pegasus_jax.config_plant import EVERY, Explore, Sensors
from pegasus_jax.config_policies import MLP, RBF, Linear

__all__ = ["BNN", "GP", "LBFGS", "MLP", "RBF", "SSGP", "Analytic", "Config", "Explore", "Fit", "Lagrangian", "Linear"]
__all__ += ["Period", "Search", "Sensors"]

MANEUVERS = ("knife_edge", "belly_up", "corkscrew", "depth_change")
GYM = "gym"  # the task that `env=` and `cost=` describe
MJCF = "mjcf"  # the task that `mjcf=`, `cost=`, `dt=` and `horizon=` describe
TASKS = ("cartpole", "double_cartpole", *(f"swimmer_{maneuver}" for maneuver in MANEUVERS), GYM, MJCF)
OWN = (GYM, MJCF)
CONSTANTS = (GYM, "cartpole", "double_cartpole")  # the tasks that have `env_args`

MATCHINGS = ("always", "narrow", "never")
COST_ESTIMATORS = ("gaussian", "particles")
OBSERVATION_NOISES = ("model", "plant")
INIT_PARTS = ("policy", "model", "data")
INITS = ("previous", "better", "fresh", "raced")
LEGS = (2, 6)
SUCCESSORS = ("always", "better")
DATA_CONTROLS = ("sent", "before")


@dataclass(frozen=True)
class Fit:
    """Model learning after each trial, by Adam on minibatches."""

    kind: str = setting("adam", "")
    steps: int = setting(2000, "updates in a trial")
    batch_size: int = setting(100, "rows in an update")
    learning_rate: float = setting(3e-4, "Adam's step size")
    decay: float = setting(1.0, "step size at the end of a fit, divided by that at its start")

    def __post_init__(self) -> None:
        checks.typed("fit", self)
        checks.kind("fit", self.kind, "adam")
        checks.sizes("fit", self, "steps", "batch_size")
        checks.check_range("fit.learning_rate", self.learning_rate, 0, open_low=True)
        checks.check_range("fit.decay", self.decay, 0, 1)


@dataclass(frozen=True)
class LBFGS:
    """Model learning after each trial, by L-BFGS on all data."""

    kind: str = setting("lbfgs", "")
    steps: int = setting(300, "largest number of iterations in a trial")
    num_starts: int = setting(100, "random starts; the best of them, or the current parameters, begin the fit")

    def __post_init__(self) -> None:
        checks.typed("fit", self)
        checks.kind("fit", self.kind, "lbfgs")
        checks.sizes("fit", self, "steps", "num_starts")


@dataclass(frozen=True)
class Period:
    """For how many iterations each draw of the scenarios is kept; 0: the whole search of a trial."""

    start: int = setting(1, "iterations for which the first states are kept; 0: the whole search")
    dynamics: int = setting(100, "iterations for which the draws of the model are kept; 0: the whole search")
    policy: int = setting(1, "iterations for which the draws of the policy are kept; 0: the whole search")
    sensor: int = setting(1, "iterations for which the noise on what the policy sees is kept; 0: the whole search")
    match: int = setting(1, "iterations for which the noise of moment matching is kept; 0: the whole search")

    def __post_init__(self) -> None:
        checks.typed("search.period", self)
        for f in dataclasses.fields(self):
            checks.check_range(f"search.period.{f.name}", getattr(self, f.name), 0)


@dataclass(frozen=True)
class Search:
    """Policy search after each fit, along the gradient of imagined rollouts of particles."""

    kind: str = setting("particles", "")
    steps: int = setting(1000, "iterations in a trial")
    particles: int = setting(100, "K, the number of imagined rollouts in an iteration")
    learning_rate: float = setting(1e-3, "Adam's step size")
    decay: float = setting(1.0, "step size at the end of a search, divided by that at its start")
    grad_clip: float | None = setting(1.0, "largest global norm of the gradient; null: no clipping")
    matching: str = setting(
        "always", "moment matching: always; narrow, unless an angle spreads over more than 1 rad; or never"
    )
    standardized_noise: bool = setting(
        False, "give the drawn noise exactly zero mean and unit covariance over the particles"
    )
    cost_estimator: str = setting(
        "gaussian", "gaussian: expected cost of the matched Gaussian; particles: mean cost of the particles"
    )
    refine_fraction: float = setting(
        0.0,
        "last fraction of a search, which only refines the better of the new policy and the old one; after an episode"
        " that succeeded, usually the whole search",
    )
    cost_width_start: float | None = setting(
        None,
        "factor by which the cost is wider at the start of a search; it is 1 from half of the search on. null: as wide"
        " as the cost needs to fall where episodes start, and for as long as imagined episodes cost nearly 1",
    )
    anneal_trials: int = setting(1, "number of trials that share one schedule of cost_width_start= and decay=")
    particle_grad_limit: float | None = setting(
        None,
        "drop a particle's gradient with respect to its state where its norm is larger; null: with"
        " search.visited_starts=, where the spread of the data would change the cost by more than 10, else never",
    )
    warm_restart: float = setting(
        0.0, "step size at the start of each search after the first anneal_trials, as a fraction; 0: constant"
    )
    warm_limit_factor: float = setting(1.0, "factor of particle_grad_limit in searches that warm_restart begins")
    reset_optimizer: bool = setting(True, "reset Adam's moments in each trial")
    init: str = setting(
        "better",
        "policy that a search starts from: previous; fresh, a random one; better, the better of both; raced, the better"
        " of both after a part of the search for each; of search.num_starts= one is the previous",
    )
    num_starts: int = setting(
        1, "number of policies searched side by side, the old one and random ones; the best one is kept"
    )
    observation_noise: str = setting(
        "model", "noise on what the policy sees: model, as the model predicts it; plant, where the plant's is known"
    )
    visited_starts: float = setting(
        0.0, "share of the imagined rollouts that start at states of the data, while a search refines"
    )
    policy_noise: float = setting(1.0, "factor of the noise on what the policy sees")
    state_noise: float = setting(0.0, "factor of the predicted noise added to the state")
    period: Period = Period()

    def __post_init__(self) -> None:
        checks.typed("search", self)
        checks.kind("search", self.kind, "particles")
        checks.check_minimum("search", self, 0, "policy_noise", "state_noise")
        wide = () if self.cost_width_start is None else ("cost_width_start",)
        checks.check_minimum("search", self, 1, "warm_limit_factor", *wide)
        checks.sizes("search", self, "steps", "anneal_trials", "num_starts")
        checks.sizes("search", self, "particles", low=2)
        checks.check_range("search.learning_rate", self.learning_rate, 0, open_low=True)
        for name in ("decay", "warm_restart", "refine_fraction", "visited_starts"):
            checks.check_range(f"search.{name}", getattr(self, name), 0, 1)
        checks.choice("search.matching", self.matching, MATCHINGS)
        checks.choice("search.cost_estimator", self.cost_estimator, COST_ESTIMATORS)
        checks.choice("search.observation_noise", self.observation_noise, OBSERVATION_NOISES)
        checks.choice("search.init", self.init, INITS)
        for name in ("grad_clip", "particle_grad_limit"):
            if (value := getattr(self, name)) is not None:
                checks.check_range(f"search.{name}", value, 0, open_low=True)
        if self.warm_restart and (self.anneal_trials == 1 or self.decay == 1):
            raise ConfigError(
                f"search.warm_restart={self.warm_restart:g} needs searches that cool, search.anneal_trials=10"
                " search.decay=0.1; the nearest is 0"
            )
        if self.warm_limit_factor > 1 and (self.particle_grad_limit is None or not self.warm_restart):
            raise ConfigError(
                f"search.warm_limit_factor={self.warm_limit_factor:g} needs search.particle_grad_limit=1"
                " search.warm_restart=0.3, or the like; the nearest is 1"
            )
        if self.anneal_trials > 1 and self.refine_fraction:
            raise ConfigError(f"search.anneal_trials={self.anneal_trials} needs search.refine_fraction=0")
        if self.init in INITS[2:] and not self.refine_fraction:
            raise ConfigError(f"search.init={self.init} needs search.refine_fraction=0.5; the nearest is better")
        if self.visited_starts and not self.refine_fraction:
            raise ConfigError(
                f"search.visited_starts={self.visited_starts:g} needs search.refine_fraction=0.5; the nearest is 0"
            )
        if self.num_starts > 1 and not self.reset_optimizer:
            raise ConfigError(
                f"search.num_starts={self.num_starts} begins every search with fresh policies; it needs"
                " search.reset_optimizer=true"
            )


@dataclass(frozen=True)
class Analytic:
    """Policy search after each fit, PILCO's: L-BFGS on the expected cost of a Gaussian, propagated analytically."""

    kind: str = setting("analytic", "")
    steps: int = setting(300, "largest number of L-BFGS iterations in a trial")
    particles: int = setting(100, "K, the number of rollouts imagined after the search, for the record")
    init: str = setting("better", "start of a search: the previous policy, or the better of it and a random one")
    policy_noise: float = setting(1.0, "factor of the model's noise on what the policy sees")
    state_noise: float = setting(1.0, "factor of the model's noise added to the state")
    # No settings: curvature is of one model, and one Gaussian starts.
    reset_optimizer, anneal_trials, observation_noise, visited_starts = True, 1, "model", 0.0

    def __post_init__(self) -> None:
        checks.typed("search", self)
        checks.kind("search", self.kind, "analytic")
        checks.check_minimum("search", self, 0, "policy_noise", "state_noise")
        checks.sizes("search", self, "steps")
        checks.sizes("search", self, "particles", low=2)
        checks.choice("search.init", self.init, INITS[:2])


@dataclass(frozen=True)
class Config:
    """One run."""

    task: str = setting("cartpole", "what to learn")
    seed: int = setting(0, "all random numbers of the run come from it")
    trials: int = setting(15, "number of trials, each with one episode; the first have random controls")
    eval_episodes: int = setting(20, "further episodes after each trial, which only measure the policy; 0 for a robot")
    successor: str = setting(
        "always", "policy that runs next: always the new one; better, the one with the lower cost under the new model"
    )
    x64: bool = setting(False, "compute in double precision")
    model: Model = BNN()  # noqa: RUF009 (frozen)
    policy: MLP | RBF | Linear = MLP()  # noqa: RUF009 (frozen)
    fit: Fit | LBFGS = Fit()
    search: Search | Analytic = Search()
    explore: Explore = Explore()  # noqa: RUF009 (frozen)
    # The plant: its sensors, and what the task leaves to you: of a gym's or an mjcf's task, and a swimmer's legs.
    sensors: Sensors = setting(Sensors(), "", EVERY)  # noqa: RUF009 (frozen)
    history: int = setting(1, "how many of the newest observations and controls make a state", EVERY)
    legs: int = setting(2, "number of legs that the swimmer drives: 2 or 6", ("swimmer_*",))
    env: str | None = setting(None, "the environment's Gymnasium id", (GYM,))
    mjcf: str | None = setting(None, "the MuJoCo file, path/to/model.xml", (MJCF,))
    cost: str | Callable | None = setting(  # noqa: RUF009 (frozen)
        None,
        "module:function in JAX, observation [D], and maybe u, previous_u, t, reference, goal -> cost in [0, 1]",
        EVERY,
    )
    reference: str | Callable | None = setting(  # noqa: RUF009 (frozen)
        None, "reference that the cost takes: a file .csv or .npz, or module:function of the time [s], in JAX", EVERY
    )
    goal_low: tuple[float, ...] = setting((), "lower limits of an episode's goal, drawn uniformly; []: no goal", EVERY)
    goal_high: tuple[float, ...] = setting((), "upper limits of the goal", EVERY)
    goals: str | Callable | None = setting(None, "module:function in JAX, key -> an episode's goal", EVERY)  # noqa: RUF009 (frozen)
    angles: tuple[int, ...] = setting((), "the entries of the observation that are angles [rad]", OWN)
    rates: tuple[int, ...] = setting((), "the entries that are rates of the other entries, in their order", (GYM,))
    circles: tuple[tuple[int, ...], ...] | None = setting(
        None, "entries that are cosine and sine of one angle, as [[0,1]]; null: found on 100 resets; []: none", (GYM,)
    )
    horizon: int | None = setting(None, "control periods in an episode; null: the environment's own limit, or 100", OWN)
    dt: float | None = setting(
        None, "control period [s]; null: the environment's own. A MuJoCo file: a whole number of its time steps", OWN
    )
    env_args: tuple[str, ...] = setting(
        (),
        "arguments of the environment, as env_args.port=/dev/ttyACM0; of a cart-pole env_args.pole_mass=0.4",
        CONSTANTS,
    )
    state_names: tuple[str, ...] = setting(
        (),
        """names of the observation, as '["angle [rad]","rate [rad/s]"]'; []: the environment's, or x0, x1, ...""",
        (GYM,),
    )
    control_names: tuple[str, ...] = setting((), "names of the controls; []: the environment's, or u0, u1, ...", (GYM,))
    stop: str | Callable | None = setting(  # noqa: RUF009 (frozen)
        None, "module:function, observation [D] -> probability that an episode ends there, in JAX", OWN
    )
    stop_cost: float = setting(1.0, "cost of each control period that an episode lacks because it ended early", OWN)
    constraint: str | Callable | None = setting(  # noqa: RUF009 (frozen)
        None, "module:function in JAX, observation [D] -> numbers, above 0 where a limit is broken", EVERY
    )
    constraint_bound: float = setting(0.05, "largest probability that an episode breaks the constraint", EVERY)
    control_rate: tuple[float, ...] = setting(
        (), "most that a control may change in a second [its unit], one for all or one each; []: no limit", EVERY
    )
    observe: tuple[str, ...] = setting(
        (), "what is observed of a MuJoCo file, as [qpos.0,qvel.1]; []: all positions, then all velocities", EVERY
    )
    control_low: tuple[float, ...] = setting(
        (), "least controls; []: of the action space, or the file's ctrlrange", OWN
    )
    control_high: tuple[float, ...] = setting(
        (), "greatest controls; []: of the action space, or the file's ctrlrange", OWN
    )
    start_mean: tuple[float, ...] = setting((), "mean start; []: of 100 resets, or the file's pose at rest", OWN)
    start_std: tuple[float, ...] = setting(
        (0.1,), "standard deviation of the starts around start_mean, one for all or one each", OWN
    )
    starts: tuple[tuple[float, ...], ...] = setting(
        (), "observations where episodes start, equally likely; []: as start_mean says, or 100 resets", EVERY
    )
    success: float = setting(0.2, "an episode succeeds if its last five steps cost less than this on average", OWN)
    data: tuple[str, ...] = setting(
        (), "logs to use as trial 1: logs/*.csv, .npz, .mcap, .db3, .bag, or minari:NAME; [a,b] for several", ("*",)
    )
    data_columns: tuple[str, ...] = setting(
        (), "their columns: the observation's, then the controls'; NAME=COLUMN*FACTOR; []: by name, else order", ("*",)
    )
    data_control: str = setting("sent", "controls of a log's row: sent after its observation, or before it", ("*",))
    prior: str | Callable | None = setting(  # noqa: RUF009 (frozen)
        None,
        "a simulator of the plant: module:function in JAX, (x [D], u [U]) -> x one period later; or a MuJoCo file",
        EVERY,
    )
    init: str | None = setting(
        None, "another run to begin with, RUN or RUN@TRIAL, for example one in a simulator", EVERY
    )
    init_parts: tuple[str, ...] = setting(("policy",), "what to take from the run of init=: policy, model, data", EVERY)

    def __post_init__(self) -> None:
        checks.typed("", self)
        if self.init in INITS:
            raise ConfigError(f"init={self.init} is no run; search.init={self.init} is what a search starts from")
        for part in self.init_parts:
            checks.choice("init_parts", part, INIT_PARTS)
        checks.choice("legs", self.legs, LEGS)
        checks.choice("successor", self.successor, SUCCESSORS)
        checks.check_range("stop_cost", self.stop_cost, 0)
        checks.check_range("constraint_bound", self.constraint_bound, 0, 1, open_low=True, open_high=True)
        for name in ("env_args", "angles", "rates", "observe"):
            checks.different(name, getattr(self, name))
        for name in ("control_low", "control_high", "start_mean", "goal_low", "goal_high"):
            checks.finite(name, getattr(self, name))
        for row in self.starts:
            checks.finite("starts", row)
        checks.pairs("circles", self.circles or ())
        checks.choice("data_control", self.data_control, DATA_CONTROLS)
        for rate in self.control_rate:
            checks.check_range("control_rate", rate, 0, open_low=True)
        for deviation in self.start_std:
            checks.check_range("start_std", deviation, 0)
        if self.start_std != Config.start_std:
            check_spread(self)
        checks.check_range("success", self.success, 0, open_low=True)
        if self.dt is not None:
            checks.check_range("dt", self.dt, 0, checks.SIZES["dt"], open_low=True)
        if self.horizon is not None:
            checks.size("horizon", self.horizon)
        checks.size("history", self.history)
        if self.history > 1 and self.sensors.velocity != "none":
            raise ConfigError(
                f"history={self.history} and sensors.velocity={self.sensors.velocity} both stand for rates; the nearest"
                " is history=1"
            )
        checks.check_range("seed", self.seed, 0, 2**32 - 1)
        checks.sizes("", self, "trials")
        checks.sizes("", self, "eval_episodes", low=0)
        checks.rows(self.trials, self.horizon)


# What each section can be, by the kind that a stored config names.
KINDS: dict[str, dict[str, Any]] = {
    "model": {"bnn": BNN(), "gp": GP(), "ssgp": SSGP(), "lagrangian": Lagrangian()},
    "policy": {"mlp": MLP(), "rbf": RBF(), "linear": Linear()},
    "fit": {"adam": Fit(), "lbfgs": LBFGS()},
    "search": {"particles": Search(), "analytic": Analytic()},
}


def check_spread(config: Config) -> None:
    """Raises ConfigError for an environment's start_std= without the start_mean= around which it would be."""
    if uses(config.task, "env") and not config.start_mean:
        raise ConfigError(
            f"start_std={checks.shown(config.start_std)} needs start_mean=, around which it is; without it episodes"
            " start as starts= or 100 resets say"
        )


def first_search(config: Config) -> int:
    """The trial after which a policy is searched for the first time; 0: before the first episode."""
    return max(config.explore.trials, 0 if config.prior is not None else 1)  # a simulator needs no episode


def begins_with(config: Config, part: str) -> bool:
    """Whether a run begins with the policy, the model or the data of another run."""
    return config.init is not None and part in config.init_parts


def label(config: Config) -> str:
    """The task with what tells it from others of its name, as part of a folder's name."""
    legs = f"legs{config.legs}" if uses(config.task, "legs") else ""
    own = legs or config.env or Path(config.mjcf or "").stem
    return f"{config.task}-{own}".replace("/", "-").replace(":", "-") if own else config.task


def model_word(model: Model) -> str:
    """What `model=` calls these settings: a network is named by the noise on its units, or as an ensemble."""
    if not isinstance(model, BNN):
        return model.kind
    size = several(model)  # 1 for null, until the plant's states are known: `sized`
    plain = {"none": "ensemble" if size > 1 else "deterministic"}.get(model.dropout)
    return plain or model.dropout + (f" of {size}" if size > 1 else "")


def uses(task: str, name: str) -> bool:
    """Whether a task uses the setting of this name: one of a plant's own is of use to some tasks only."""
    (of,) = (f.metadata.get("of", ()) for f in dataclasses.fields(Config) if f.name == name)
    return not of or any(fnmatch(task, pattern) for pattern in of)
