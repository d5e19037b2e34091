"""Settings of earlier versions: what a config stored by one of them means today, and what serves instead."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

from pegasus_jax.checks import ConfigError, shown


class Removed(NamedTuple):
    """A setting that is no more."""

    always: Any  # the value that it had by default, and that is now the only one
    instead: str  # what serves where another value was wanted


class Renamed(NamedTuple):
    """A setting that has another name. Of two with the same new name, the later row of the table decides."""

    key: str
    # old value -> new value, of those that changed; None: it says nothing
    values: Mapping[Any, Any] = MappingProxyType({})


REMOVED = {
    "mjcf_digest": Removed(None, "run.json has it"),
    "model.high": Removed(0.0, "log z ends at 0; dropout.log_normal(low, high) in a model of your own"),
    "model.rate": Removed(0.1, "binary(rate) or concrete(rate) of the dropout module in a model of your own"),
    "model.head": Removed("sigmoid", "bnn(head=HEADS['softplus']) as a model of your own"),
    "model.input_noise": Removed(False, "model.dropout= is noise on the hidden units"),
    "model.whitening": Removed("full", "inputs and targets are scaled with their full covariance"),
    "model.features": Removed(200, "gp(features=) as a model of your own"),
    "model.points": Removed(100, "ssgp(points=) as a model of your own"),
    "policy.execution": Removed("sampled", "policy.dropout=0, or pegasus_jax.controller, the mean of any policy"),
    "policy.output_scale": Removed(1.0, "a policy of your own, with of_pair"),
    "fit.reset": Removed(False, "a fit goes on with Adam's moments of the one before"),
    "search.aggregate": Removed("mean", "objective(aggregate=costs.total) in a search of your own is the paper's sum"),
    "search.discount": Removed(1.0, "objective(aggregate=) in a search of your own"),
    "search.risk": Removed(1.0, "objective(aggregate=) in a search of your own"),
    "search.truncate": Removed(
        None, "search.particle_grad_limit=1 drops a particle's gradient where it grows too long"
    ),
    "search.best": Removed(False, "search.refine_fraction=0.5 ends with the better of the new policy and the old one"),
    "search.cost_noise": Removed(0.0, "search.state_noise= is noise on the state itself, which the cost sees"),
}

MATCHING = {False: "never", True: "always"}

RENAMED = {
    "precision": Renamed("x64", {"single": False, "double": True}),
    "evaluation": Renamed("eval_episodes"),
    "model.members": Renamed("model.ensemble_size"),
    "model.low": Renamed("model.log_z_min"),
    "model.initialiser": Renamed("model.initializer"),
    "policy.initialiser": Renamed("policy.initializer"),
    "policy.units": Renamed("policy.num_centers"),
    "fit.batch": Renamed("fit.batch_size"),
    "fit.starts": Renamed("fit.num_starts"),
    "search.clip": Renamed("search.grad_clip"),
    "search.match": Renamed("search.matching", MATCHING),
    "search.moment_matching": Renamed("search.matching", MATCHING),
    "search.balanced": Renamed("search.standardized_noise"),
    "search.cost": Renamed("search.cost_estimator", {"matched": "gaussian"}),
    "search.refine": Renamed("search.refine_fraction"),
    "search.widen": Renamed("search.cost_width_start"),
    "search.anneal": Renamed("search.anneal_trials"),
    "search.limit": Renamed("search.particle_grad_limit"),
    "search.reheat": Renamed("search.warm_restart"),
    "search.loosen": Renamed("search.warm_limit_factor"),
    "search.reset": Renamed("search.reset_optimizer"),
    "search.restart": Renamed("search.init", {False: "previous", True: "better"}),
    "search.anew": Renamed("search.init", {False: None, True: "fresh"}),  # where it is false, search.restart decides
    "search.starts": Renamed("search.num_starts"),
    "search.sensors": Renamed("search.observation_noise", {"predicted": "model", "known": "plant"}),
}


def refuse(key: str) -> None:
    """Raises ConfigError for the name of a setting of an earlier version."""
    if key in REMOVED:
        raise ConfigError(f"{key} was removed; instead: {REMOVED[key].instead}")
    if key in RENAMED:
        raise ConfigError(answer(key))


def answer(key: str) -> str:
    """What a setting of another name is called now: one line."""
    now, values = RENAMED[key]
    known = ", ".join(f"{shown(old)} is {shown(new)}" for old, new in values.items() if new is not None)
    return f"{key} is now called {now}{known and f', where {known}'}"


def renamed(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """(the words of a command with today's names and values of its settings, a line for each that had an old one)."""
    today, answers = [], []
    for word in words:
        key, equals, text = word.partition("=")
        if equals and key in RENAMED:
            now, values = RENAMED[key]
            value = {shown(old): new for old, new in values.items()}.get(text, text)
            today += [] if value is None else [f"{now}={value if isinstance(value, str) else shown(value)}"]
            answers.append(answer(key))
        else:
            today.append(word)
    return today, answers


def today(stored: dict[str, Any]) -> dict[str, Any]:
    """A stored config in the words of this version.

    Raises ConfigError where a removed setting had another value than the one that is left.
    """
    for key, value in stored.items():
        if key in REMOVED and value != REMOVED[key].always:
            raise ConfigError(
                f"{key}={shown(value)} was removed, only {shown(REMOVED[key].always)} is left;"
                f" an earlier version of pegasus_jax reads this run"
            )
    found = {key: value for key, value in stored.items() if key not in REMOVED and key not in RENAMED}
    for key, (now, values) in RENAMED.items():
        if key in stored:
            value = stored[key]
            changed = values.get(value, value) if isinstance(value, str | bool) else value
            if changed is not None or not values:
                found[now] = changed
    return found
