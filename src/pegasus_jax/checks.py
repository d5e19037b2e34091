"""What is raised of a value that cannot be, and the checks that raise it: one line, with the nearest valid choice."""

import difflib
import math
from collections.abc import Iterable
from typing import Any


class SettingError(ValueError):
    """A setting that cannot be; the message is one line for the person who set it."""


class RunError(Exception):
    """A run's folder is not as it should be; the message is one line for the person who named it."""


def nearest(name: str, choices: Iterable[str]) -> str:
    """The end of an error message: the nearest valid choice, and all of them."""
    choices = [str(c) for c in choices]
    close = difflib.get_close_matches(str(name), choices, n=1, cutoff=0.4)
    hint = f"did you mean '{close[0]}'? " if close else ""
    return f"{hint}choices: {', '.join(choices)}"


def choice(name: str, value: Any, choices: Iterable[Any]) -> None:
    """Raises SettingError unless the value is one of the choices."""
    if value not in tuple(choices):
        raise SettingError(f"{name}={value} is not a choice; {nearest(value, choices)}")


def within(name: str, value: float, low: float, high: float = math.inf, *, open_low: bool = False) -> None:
    """Raises SettingError unless low <= value <= high, or low < value, and it is finite."""
    if not math.isfinite(value) or value > high or value < low or (open_low and value == low):
        interval = f"{'(' if open_low else '['}{number(low)}, {number(high)}{')' if high == math.inf else ']'}"
        nearest_value = min(max(value, low), high) if math.isfinite(value) and not open_low else None
        hint = f"; the nearest is {number(nearest_value)}" if nearest_value is not None else ""
        raise SettingError(f"{name}={number(value)} is out of range; expected a number in {interval}{hint}")


def least(section: str, config: Any, low: float, *names: str) -> None:
    """Raises SettingError unless each of these settings of a section is at least `low`."""
    for name in names:
        within(f"{section}.{name}", getattr(config, name), low)


def number(value: float) -> str:
    """A number in full when it is whole, else short."""
    return str(int(value)) if math.isfinite(value) and value == int(value) else f"{value:g}"


def layers(name: str, value: Any) -> tuple[int, ...]:
    """The widths of hidden layers. Raises SettingError unless they are whole numbers from 1."""
    widths = tuple(value)
    for width in widths:
        if not isinstance(width, int):
            raise SettingError(f"{name}={list(widths)} is not a list of whole numbers; for example {name}=[200,200]")
        within(name, width, 1)
    return widths


def kind(section: str, value: str, kind: str) -> None:
    """A section's kind says which class it is; a variant changes it, never a single setting."""
    if value != kind:
        raise SettingError(
            f"{section}.kind={value} cannot be set: model=, policy= and algorithm= choose what {section} is"
        )
