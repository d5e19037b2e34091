"""The words of the commands: which there are, what each is for, and who asks for it.

Help and completion are made of these tables and of the settings' own help: neither knows a word the other lacks.
"""

from collections.abc import Iterable
from fnmatch import fnmatch
from typing import Any

from pegasus_jax import config as limits
from pegasus_jax.config import KINDS, TASKS, Config
from pegasus_jax.config_models import ACTIVATIONS, DROPOUTS, INITIALIZERS
from pegasus_jax.config_plant import EXPLORATIONS, VELOCITIES
from pegasus_jax.config_policies import SQUASHES
from pegasus_jax.presets import ALGORITHMS, EFFORTS, MODELS, NETWORKS, POLICIES, PRESETS

# Words of pegasus-train that are no settings: as help shows them, and what they are for.
OPTIONS = {
    "out": ("out=runs/...", "folder of the run; with seeds=, the folder of all runs (default: runs/TASK-seedN)"),
    "resume": (
        "resume=RUN",
        "continue a run, also one that was killed; trials=, eval_episodes=, fit.* and search.* may change",
    ),
    "final": ("final=true", "run the last policy for one more episode; a continued run learns from it too"),
    "track": (
        "track=tensorboard",
        "trackers that get numbers, settings and pictures: tensorboard, wandb, mlflow, several as wandb,mlflow, or none"
        " (default: the numbers to tensorboard; a continued run keeps its trackers)",
    ),
    "seeds": ("seeds=1", "number of seeds, from seed= on, that one program learns; each has its own run in OUT/seedN"),
    "mesh": (
        "mesh=SEEDSxPARTICLES",
        "devices that share the seeds and the particles (default: as many GPUs, or cores, as divide the seeds)",
    ),
    "distributed": (
        "distributed=true",
        "use the devices of several hosts, on which SLURM or MPI started this command; they share OUT",
    ),
    "coordinator": (
        "coordinator=HOST:PORT",
        "for hosts without SLURM or MPI: the first one's address; needs the next two settings",
    ),
    "processes": ("processes=N", "number of hosts"),
    "process": ("process=I", "number of this host, from 0"),
}
NEW = ("out", "seeds")  # of these, those of a new run

# Words that choose what a command begins with, or a whole section of it.
_ALONE = [name for name in PRESETS if name not in NETWORKS]
NAMED = {
    "task": ("task=cartpole", f"plant and goal: {', '.join(TASKS)}"),
    "preset": (
        "preset=NAME",
        f"named settings to begin with, instead of the task's own: {', '.join(_ALONE)}; or, with the paper's network,"
        " cartpole_network, double_cartpole_network, swimmer_..._network",
    ),
    "model": (
        "model=NAME",
        f"dynamics model: {', '.join(MODELS)} (default: the best one for the task; any other begins with the settings"
        " of preset=TASK_network)",
    ),
    "policy": ("policy=NAME", f"controller: {', '.join(POLICIES)}"),
    "algorithm": ("algorithm=pegasus", f"how the policy is searched: {', '.join(ALGORITHMS)}"),
    "effort": (
        "effort=laptop",
        "computing time of a trial: laptop; workstation, twice the iterations of a search; gpu, four policies side by"
        " side",
    ),
}

# What a first user needs.
FIRST = (
    *("task", "out", "resume", "trials", "seed", "eval_episodes", "model", "policy"),
    *("env", "mjcf", "cost", "angles", "start_mean", "dt", "horizon"),
)
# Who asks for a word: the first group that has it.
GROUPS: dict[str, tuple[str, ...]] = {
    "every run": ("task", "preset", "effort", "out", "resume", "trials", "seed", "final", "eval_episodes", "track"),
    "robots and Gymnasium environments": (
        *(
            "env",
            "env_args",
            "angles",
            "rates",
            "circles",
            "horizon",
            "dt",
            "*_names",
            "control_*",
            "start_*",
            "starts",
        ),
        *("sensors.*", "history", "explore.*", "data", "data_*"),
    ),
    "simulators and earlier runs": ("mjcf", "observe", "legs", "prior", "init", "init_parts"),
    "costs, goals and limits": ("cost", "reference", "goal*", "success", "stop", "stop_cost", "constraint*"),
    "the method: model, policy and search": ("model*", "policy*", "algorithm", "fit.*", "search.*", "successor", "x64"),
    "many seeds, GPUs or hosts": ("seeds", "mesh", "distributed", "coordinator", "processes", "process"),
}

# The values of words that have few.
VALUES: dict[str, tuple[Any, ...]] = {
    "task": TASKS,
    "preset": tuple(PRESETS),
    "model": tuple(MODELS),
    "policy": tuple(POLICIES),
    "algorithm": tuple(ALGORITHMS),
    "effort": tuple(EFFORTS),
    "track": ("tensorboard", "wandb", "mlflow", "none"),
    "legs": limits.LEGS,
    "successor": limits.SUCCESSORS,
    "data_control": limits.DATA_CONTROLS,
    "explore.kind": EXPLORATIONS,
    "sensors.velocity": VELOCITIES,
    "model.dropout": DROPOUTS,
    "model.activation": ACTIVATIONS,
    "model.initializer": INITIALIZERS,
    "policy.initializer": INITIALIZERS,
    "policy.squash": SQUASHES,
    "search.matching": limits.MATCHINGS,
    "search.cost_estimator": limits.COST_ESTIMATORS,
    "search.observation_noise": limits.OBSERVATION_NOISES,
    "search.init": limits.INITS,
}
BOOLEANS = ("true", "false")
PATHS = ("out", "resume", "init", "explore.policy", "data", "mjcf", "reference", "prior")  # words of files and folders

# The options of the commands that read a run, with their defaults.
OF_RUN: dict[str, dict[str, str]] = {
    "pegasus-eval": {"episodes": "20", "seed": "0", "json": "false", "trial": "best", "mjcf": ""},
    "pegasus-plot": {},
    "pegasus-report": {"out": "", "film": "false", "csv": ""},
    "pegasus-watch": {"port": "8765"},
    "pegasus-play": {"episodes": "1", "seed": "0", "trial": "best", "mjcf": ""},
    "pegasus-export": {"trial": "best", "format": "numpy", "out": "", "overwrite": "false"},
    "pegasus-run": {"trial": "best", "episodes": "1", "seed": "0", "seconds": "", "watchdog": ""},
}
# And their values, where there are few.
OF_RUN_VALUES = {
    "trial": ("best", "last"),
    "format": ("numpy", "c", "onnx", "stablehlo"),
    "json": BOOLEANS,
    "film": BOOLEANS,
    "overwrite": BOOLEANS,
}
# The other commands take pegasus-train's words, and these.
MORE: dict[str, tuple[str, ...]] = {
    "pegasus-train": (),
    "pegasus-check": (),
    "pegasus-delay": ("amplitude", "periods", "most"),
    "pegasus-sweep": ("launcher", "jobs"),
}


def described(config: Config) -> dict[str, tuple[str, str]]:
    """Word -> as help shows it, with its value in this config, and what it is for."""
    from pegasus_jax.runs import config_io

    return {**NAMED, "task": (f"task={config.task}", NAMED["task"][1]), **OPTIONS, **config_io.described(config)}


def grouped(words: Iterable[str]) -> dict[str, list[str]]:
    """Title of a group -> those of the words that it has, in its order. Each is in one group."""
    found: dict[str, list[str]] = {title: [] for title in GROUPS}
    rest = list(words)
    for title, patterns in GROUPS.items():
        for pattern in patterns:
            found[title] += [word for word in rest if fnmatch(word, pattern)]
            rest = [word for word in rest if not fnmatch(word, pattern)]
    return found


def of_train() -> dict[str, str]:
    """Every word of pegasus-train, also those of kinds that no preset chooses, and what it is for."""
    from pegasus_jax.runs import config_io

    kinds = [config_io.described(kind, f"{section}.") for section, of in KINDS.items() for kind in of.values()]
    every = [described(Config()), *kinds]
    return {word: text for found in every for word, (_, text) in found.items()}


def values(word: str) -> tuple[str, ...]:
    """The values of a word of pegasus-train, where they are few and known."""
    from pegasus_jax.runs import config_io

    if word in VALUES:
        return tuple(map(str, VALUES[word]))
    kinds = [config_io.leaves(kind, f"{section}.") for section, of in KINDS.items() for kind in of.values()]
    defaults = {name: value for found in [config_io.leaves(Config()), *kinds] for name, value in found.items()}
    return BOOLEANS if isinstance(defaults.get(word), bool) or word in ("final", "distributed") else ()
