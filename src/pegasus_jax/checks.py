"""What is raised of a value that cannot be, and the checks that raise it: one line, with the nearest valid choice."""

import dataclasses
import difflib
import math
import numbers
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import partial, wraps
from pathlib import PureWindowsPath
from types import GenericAlias, UnionType
from typing import Any, ParamSpec, TypeVar, get_args

P = ParamSpec("P")
R = TypeVar("R")

# The greatest of each size that a setting may ask for: beyond is a slip of the keyboard, and no machine's work.
SIZES = {
    "steps": 10**7,
    "particles": 10**6,
    "batch_size": 10**6,
    "hidden": 10**5,
    "num_centers": 10**5,
    "num_starts": 10**4,
    "ensemble_size": 10**3,
    "substeps": 10**3,
    "anneal_trials": 10**4,
    "horizon": 10**5,
    "history": 100,
    "delay": 100,
    "eval_episodes": 10**5,
    "trials": 10**4,
    "seeds": 10**4,
    "periods": 10**6,
    "rows": 10**7,
    "dt": 10**4,
}
DIGITS = 20  # of a whole number; Python itself refuses to read thousands


class ConfigError(ValueError):
    """A setting that cannot be; the message is one line for the person who set it."""


class RunError(Exception):
    """A run's folder is not as it should be; the message is one line for the person who named it."""


def brief(function: Callable[P, R]) -> Callable[P, R]:
    """The function, whose ConfigError and RunError come without the calls inside of it: their line says it all.

    What caused them, such as an error of the user's own code, stays, and so does every other error.
    """

    @wraps(function)
    def called(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return function(*args, **kwargs)
        except (ConfigError, RunError) as error:
            raise error.with_traceback(None) from error.__cause__

    return called


def did_you_mean(name: str, choices: Iterable[str]) -> str:
    """The end of an error message: the nearest valid choice, and all of them."""
    choices = [str(c) for c in choices]
    close = difflib.get_close_matches(str(name), choices, n=1, cutoff=0.4)
    hint = f"did you mean '{close[0]}'? " if close else ""
    return f"{hint}choices: {', '.join(choices)}"


def choice(name: str, value: Any, choices: Iterable[Any]) -> None:
    """Raises ConfigError unless the value is one of the choices."""
    if value not in tuple(choices):
        raise ConfigError(f"{name}={value} is not a choice; {did_you_mean(value, choices)}")


def check_range(
    name: str, value: float, low: float, high: float = math.inf, *, open_low: bool = False, open_high: bool = False
) -> None:
    """Raises ConfigError unless the value is finite and from low to high, an end that is open left out."""
    outside = value < low or value > high or (open_low and value == low) or (open_high and value == high)
    if outside or not math.isfinite(value):
        left, right = "(" if open_low or low == -math.inf else "[", ")" if open_high or high == math.inf else "]"
        interval = f"{left}{number(low)}, {number(high)}{right}"
        open_end = open_high if value >= high else open_low
        nearest_value = min(max(value, low), high) if math.isfinite(value) and not open_end else None
        hint = f"; the nearest is {number(nearest_value)}" if nearest_value is not None else ""
        raise ConfigError(f"{name}={number(value)} is out of range; expected a number in {interval}{hint}")


def check_minimum(section: str, config: Any, low: float, *names: str) -> None:
    """Raises ConfigError unless each of these settings of a section is at least `low`."""
    for name in names:
        check_range(f"{section}.{name}", getattr(config, name), low)


def number(value: float) -> str:
    """A number in full when it is whole, else short."""
    return str(int(value)) if math.isfinite(value) and value == int(value) else f"{value:g}"


def size(name: str, value: float, low: int = 1) -> None:
    """Raises ConfigError unless a size, the last part of the setting's name in SIZES, is at least `low` and sane."""
    if isinstance(value, numbers.Real):
        check_range(name, value, low, SIZES[name.rpartition(".")[2]])
    if not isinstance(value, numbers.Integral):  # 5.0 would end inside of JAX
        near = round(value) if isinstance(value, numbers.Real) else low
        raise ConfigError(f"{name}={shown(value)} is not {expected(name, int, value, near)}")


def sizes(section: str, config: Any, *names: str, low: int = 1) -> None:
    """`size` of each of these settings of a section."""
    for name in names:
        size(f"{section}.{name}" if section else name, getattr(config, name), low)


def rows(trials: int, horizon: int | None) -> None:
    """Raises ConfigError where episodes make more data than SIZES allows."""
    most = SIZES["rows"]
    if trials * (horizon or 1) > most:
        raise ConfigError(
            f"trials={trials} of horizon={horizon} are more than {most:,} rows of data;"
            f" the nearest is trials={most // (horizon or 1)}"
        )


def layers(name: str, widths: tuple[int, ...]) -> None:
    """Raises ConfigError unless these are widths of hidden layers."""
    for width in widths:
        check_range(name, width, 1, SIZES["hidden"])
    check_range(f"number of {name}", len(widths), 0, 100)


def finite(name: str, values: Iterable[float]) -> None:
    """Raises ConfigError unless each of these is a finite number."""
    for value in values:
        if not math.isfinite(value):
            raise ConfigError(f"{name}={value} is not a finite number")


def different(name: str, values: tuple[Any, ...]) -> None:
    """Raises ConfigError where one of these is there twice."""
    for value in values:
        if values.count(value) > 1:
            once = ",".join(map(str, dict.fromkeys(values)))
            raise ConfigError(f"{name}=[{','.join(map(str, values))}] names {value} twice; the nearest is [{once}]")


def pairs(name: str, values: tuple[tuple[int, ...], ...]) -> None:
    """Raises ConfigError unless these are pairs, and no entry is there twice."""
    for pair in values:
        if len(pair) != 2:
            raise ConfigError(f"{name}={shown(values)} are not pairs; for example {name}=[[0,1]]")
    different(name, tuple(entry for pair in values for entry in pair))


def names_code(value: Any) -> bool:
    """Whether a setting says module:function. A path of Windows has a colon too, behind the letter of its drive."""
    return isinstance(value, str) and ":" in value and not PureWindowsPath(value).root


def typed(section: str, node: Any) -> None:
    """Makes each field of a config dataclass the type that it is declared as; lists become tuples.

    Raises ConfigError where it is of another type, in one line that names the setting and its default.
    """
    for f in dataclasses.fields(node):
        given = getattr(node, f.name)
        try:
            object.__setattr__(node, f.name, _as(f.type, given))
        except TypeError:
            name = f"{section}.{f.name}" if section else f.name
            raise ConfigError(f"{name}={shown(given)} is not {expected(name, f.type, given, f.default)}") from None


def expected(name: str, kind: Any, given: Any, default: Any) -> str:
    """What a setting takes, in words, and an example: what is given in brackets where that is a list, or a default.

    What was given, where only the way in which it is written is wrong: 20 for '20' and for 20.0, null for 'none'.
    """
    places = ", which are places in the observation counted from 0" if name in PLACES else ""
    with suppress(TypeError, ValueError):
        return f"{called(kind)} as written, {given!r}; write {name}={shown(_as(kind, _meant(given)))}"
    example = default if default or kind not in EXAMPLES else EXAMPLES[kind]
    if isinstance(given, numbers.Real):
        with suppress(TypeError):
            example = _as(kind, (given,))
    return f"{called(kind)}{places}; for example {name}={shown(example)}"


def _as(kind: Any, value: Any) -> Any:
    """The value as this type. Raises TypeError where it is of another."""
    if isinstance(kind, UnionType):
        for part in get_args(kind):
            with suppress(TypeError):
                return _as(part, value)
    elif isinstance(kind, GenericAlias):  # a tuple of any length
        if isinstance(value, tuple | list):
            return tuple(_as(get_args(kind)[0], part) for part in value)
    elif kind in (int, float):
        number: Any = {int: numbers.Integral, float: numbers.Real}[kind]
        if isinstance(value, number) and not isinstance(value, bool):
            return kind(value)
    elif isinstance(value, kind):
        return value
    raise TypeError(f"{value!r} is not {called(kind)}")


def _meant(value: Any) -> Any:
    """The value that a text, or a whole number with a point, stands for. Raises ValueError for a text that is none."""
    if isinstance(value, tuple | list):
        return tuple(map(_meant, value))
    if isinstance(value, str):
        words = {"none": None, "null": None, "true": True, "false": False}
        return words[value.lower()] if value.lower() in words else _meant(float(value))
    return int(value) if isinstance(value, float) and value.is_integer() else value


NAMED = 8  # of many, in one line
PLACES = ("angles", "rates", "circles")  # settings that say which entries of an observation are something
EXAMPLES: dict[Any, Any] = {  # of settings that are empty by default
    tuple[int, ...]: (0,),
    tuple[float, ...]: (0.5,),
    tuple[tuple[int, ...], ...] | None: ((0, 1),),
    tuple[tuple[float, ...], ...]: ((0.5, 0.0),),
}
FUNCTION = str | Callable | None  # of a setting that names a function, or from Python is one


def called(kind: Any) -> str:
    """A setting's type in words."""
    return {
        int: "a whole number",
        float: "a number",
        bool: "true or false",
        str: "a word",
        tuple[int, ...]: "a list of whole numbers",
        tuple[float, ...]: "a list of numbers",
        tuple[float, ...] | None: "a list of numbers or null",
        tuple[str, ...]: "a list of words",
        tuple[tuple[int, ...], ...] | None: "a list of pairs of whole numbers or null",
        tuple[tuple[float, ...], ...]: "a list of lists of numbers",
        str | None: "a word or null",
        FUNCTION: "a word or null",
        int | None: "a whole number or null",
        float | None: "a number or null",
    }.get(kind, f"a {kind.__module__}.{kind.__name__}" if isinstance(kind, type) else "one of its kinds")


def shown(value: Any) -> str:
    """A setting's value as the command line has it."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple | list):
        return "[" + ",".join(map(shown, value)) + "]"
    if callable(value):
        try:
            return f"{value.__module__}:{value.__qualname__}"
        except AttributeError:  # no function, but what can be called like one
            return shown(value.func if isinstance(value, partial) else type(value))
    words = f"{value:g}" if isinstance(value, float) else str(value)
    return words if words.isprintable() else repr(words)


def some(names: Sequence[Any]) -> str:
    """The first of many names, and how many more there are; pandas gives a column of row numbers none."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(str(name) or "(no name)" for name in names[:NAMED]) + more


def kind(section: str, value: str, kind: str) -> None:
    """A section's kind says which class it is; a variant changes it, never a single setting."""
    if value != kind:
        raise ConfigError(
            f"{section}.kind={value} cannot be set: model=, policy= and algorithm= choose what {section} is"
        )


def whole(name: str, text: str) -> int:
    """The whole number of an option. Raises ConfigError when it is none, or 0 where nothing would be done."""
    if not text.removeprefix("-").isdecimal():
        raise ConfigError(f"{name}={text} is not a whole number; for example {name}=20")
    least = 1 if name in ("episodes", "seeds", "jobs") else 0
    most = 2**32 - 1 if name == "seed" else SIZES.get(name, SIZES["trials"])
    if len(text) > DIGITS:
        raise ConfigError(f"{name}={text[:DIGITS]}... has {len(text)} digits; expected a number in [{least}, {most}]")
    check_range(name, int(text), least, most)
    return int(text)


def true(name: str, text: str) -> bool:
    """Whether an option is true. Raises ConfigError for one that is not false either."""
    if text not in ("true", "false"):
        raise ConfigError(f"{name}={text} is neither true nor false")
    return text == "true"
