"""Settings of earlier versions: what a config stored by one of them means today, and what serves instead."""

from typing import Any, NamedTuple

from pegasus_jax.checks import ConfigError, shown


class Removed(NamedTuple):
    """A setting that is no more."""

    always: Any  # the value that it had by default, and that is now the only one
    instead: str  # what serves where another value was wanted


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
    "search.discount": Removed(1.0, "search.aggregate= is mean or total, of all steps alike"),
    "search.risk": Removed(1.0, "search.aggregate= is mean or total, of all particles alike"),
    "search.truncate": Removed(None, "search.limit=1 drops a particle's gradient where it grows too long"),
    "search.best": Removed(False, "search.refine=0.5 ends with the better of the new policy and the old one"),
    "search.cost_noise": Removed(0.0, "search.state_noise= is noise on the state itself, which the cost sees"),
}


def refuse(key: str) -> None:
    """Raises ConfigError for a word of the command line that names a removed setting."""
    if key in REMOVED:
        raise ConfigError(f"{key} was removed; instead: {REMOVED[key].instead}")


def without(stored: dict[str, Any]) -> dict[str, Any]:
    """A stored config without what was removed since. Raises ConfigError where that had another value than today's."""
    for key, value in stored.items():
        if key in REMOVED and value != REMOVED[key].always:
            raise ConfigError(
                f"{key}={shown(value)} was removed, only {shown(REMOVED[key].always)} is left;"
                f" an earlier version of pegasus_jax reads this run"
            )
    return {key: value for key, value in stored.items() if key not in REMOVED}
