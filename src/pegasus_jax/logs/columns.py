"""Which columns of a table are the observation, the controls, the time and the episode."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pegasus_jax.checks import ConfigError, did_you_mean, shown
from pegasus_jax.logs.table import EPISODE, TIMES, Names, Table, plain

SETTING = "data_columns"


class Column(NamedTuple):
    """A column of a file, in the unit that the environment has."""

    name: str
    factor: float = 1.0


class Layout(NamedTuple):
    """Where everything is in a table."""

    observation: tuple[Column, ...]  # [O]
    control: tuple[Column, ...]  # [U]
    time: Column | None
    episode: str | None


def mapped(columns: Sequence[str], names: Names) -> dict[str, Column]:
    """What a map says: name of the environment -> column. Raises ConfigError for one that says too little or too much.

    An entry is COLUMN, COLUMN*FACTOR or NAME=COLUMN; those without a name are the observation in order, then the
    controls. NAME may be t or episode too.
    """
    known = (*names.observation, *names.control)
    found: dict[str, Column] = {}
    rest: list[Column] = []
    for entry in columns:
        name, equals, text = entry.rpartition("=")
        column = _column(entry, text)
        if equals and name not in (*known, "t", EPISODE):
            raise ConfigError(f"{SETTING}: {name} is no name of the environment; {did_you_mean(name, (*known, 't'))}")
        if equals and name in found:
            raise ConfigError(f"{SETTING}={shown(list(columns))} names {name} twice")
        rest += [] if equals else [column]
        found |= {name: column} if equals else {}
    open_ = [name for name in known if name not in found]
    if columns and len(rest) != len(open_):
        raise ConfigError(
            f"{SETTING}={shown(list(columns))} has {len(rest)} columns without a name; expected {len(open_)}, for"
            f" {', '.join(open_) or 'nothing'}"
        )
    return found | dict(zip(open_, rest, strict=False))


def _column(entry: str, text: str) -> Column:
    name, star, factor = text.rpartition("*")
    if not star:
        return Column(text)
    try:
        return Column(name, float(factor))
    except ValueError:
        raise ConfigError(f"{SETTING}: {entry} is not COLUMN*FACTOR; for example x0=angle*0.0174533") from None


def layout(table: Table, names: Names, columns: Sequence[str]) -> tuple[Layout, str]:
    """Where everything is in a table, and a note where that was decided by the columns' order, or "".

    By the map; else by the names; else the observation in order, then the controls. Raises ConfigError where it cannot
    be told.
    """
    said, known = mapped(columns, names), (*names.observation, *names.control)
    own = matched([name for name in table.names if name not in {*TIMES, EPISODE} - {*known}], known)
    taken = {column.name for column in said.values()} or {*own.values()}
    time = said.get("t") or _time(table.names, taken)
    episode = said[EPISODE].name if EPISODE in said else EPISODE if EPISODE in table.names else None
    note = ""
    if not said:
        rest = [name for name in table.names if name not in (episode, time and time.name)]
        if not own:
            if len(rest) != len(known):
                raise ConfigError(
                    f"{table.source} has {len(rest)} columns, {', '.join(rest)}; expected {len(known)}:"
                    f" {', '.join(known)}; {SETTING}=[...] says which is which"
                )
            said = {name: Column(column) for name, column in zip(known, rest, strict=True)}
            note = f"by their order, {', '.join(rest)} are {', '.join(known)}"
        else:
            said = {name: Column(own.get(name, name)) for name in known}
    for column in (*said.values(), *([time] if time else [])):
        if column.name not in table.names:
            raise ConfigError(
                f"{table.source} has no column {column.name}, it has {', '.join(table.names)};"
                f" {SETTING}=[...] says which is which"
            )
    return Layout(
        tuple(said[name] for name in names.observation), tuple(said[name] for name in names.control), time, episode
    ), note


def matched(columns: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Name -> the column of that name, units aside; else the one that differs in case or has _ for a space.

    A column that some name has exactly is no other's, and of two that are alike neither is taken.
    """
    exact = {plain(column): column for column in columns}
    found = {name: exact[name] for name in names if name in exact}
    alike: dict[str, list[str]] = {}
    for column in columns:
        if column not in found.values():
            alike.setdefault(_loose(plain(column)), []).append(column)
    for name in names:
        if name not in found and len(alike.get(_loose(name), ())) == 1:
            found[name] = alike[_loose(name)].pop()
    return found


def _time(columns: Sequence[str], taken: set[str]) -> Column | None:
    """The column of the time [s], or None. T, which may be a torque or a temperature, is time where it is first."""
    found = [name for name in TIMES if name in columns]
    found += [name for name in columns if name.casefold() == "time"] + [name for name in columns[:1] if name == "T"]
    return next((Column(name) for name in found if name in TIMES or name not in taken), None)


def _loose(name: str) -> str:
    return name.casefold().replace("_", " ")


def numbers(table: Table, column: Column) -> np.ndarray:
    """The numbers [N] of a column. Raises ConfigError, with its row, for a text that is none."""
    place = table.names.index(column.name)
    for row, at in table.texts:
        if at == place:
            text = table.texts[row, at]
            raise ConfigError(f"{table.where(row)}: {column.name} is {text!r}; expected a number")
    return table.rows[:, place] * column.factor
