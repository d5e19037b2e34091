"""The plants of pegasus_envs by the names of their tasks; each is imported, with its simulator, when it is made."""

import inspect
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from pegasus_jax.checks import ConfigError, check_range, did_you_mean
from pegasus_jax.config import MANEUVERS

if TYPE_CHECKING:
    from pegasus_envs.plant import Plant


def _cartpole(_: Any, arguments: Sequence[str]) -> "Plant":
    from pegasus_envs.cartpole import cartpole

    return cartpole(**_constants(arguments, cartpole))


def _double_cartpole(_: Any, arguments: Sequence[str]) -> "Plant":
    from pegasus_envs.double_cartpole import double_cartpole

    return double_cartpole(**_constants(arguments, double_cartpole))


def _constants(arguments: Sequence[str], plant: Callable[..., "Plant"]) -> dict[str, float]:
    """The physical constants of env_args.NAME=VALUE. Raises ConfigError for a name or a number that cannot be."""
    found = {}
    for name, _, value in (argument.partition("=") for argument in arguments):
        if name not in (names := [*inspect.signature(plant).parameters]):
            raise ConfigError(f"env_args.{name} is no constant of the plant; {did_you_mean(name, names)}")
        try:
            found[name] = float(value.strip('"'))  # a text, from Python
        except ValueError:
            raise ConfigError(f"env_args.{name}={value} is not a number; for example env_args.{name}=0.4") from None
        check_range(f"env_args.{name}", found[name], 0, math.inf, open_high=True)
    return found


def _swimmer(maneuver: Any, legs: Any, _: Sequence[str]) -> "Plant":
    from pegasus_envs.swimmer.plant import swimmer

    return swimmer(maneuver, legs)


# Name -> the plant, given how many of its legs a swimmer drives, and constants of a cart-pole, as NAME=VALUE.
TASKS: dict[str, Callable[[Any, Sequence[str]], "Plant"]] = {
    "cartpole": _cartpole,
    "double_cartpole": _double_cartpole,
    **{f"swimmer_{maneuver}": partial(_swimmer, maneuver) for maneuver in MANEUVERS},
}
