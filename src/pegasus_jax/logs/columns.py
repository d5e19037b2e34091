"""Which columns of a table are the observation, the controls, the time and the episode."""

import re
from collections.abc import Callable, Mapping, Sequence, Set
from typing import Any, NamedTuple

import numpy as np

from pegasus_jax.checks import ConfigError, did_you_mean, shown, some
from pegasus_jax.logs import times, units
from pegasus_jax.logs.table import EPISODE, TIMES, Names, Table, loose, plain

SETTING = "data_columns"
ENDS = {"terminal", "terminals", "terminated", "truncated", "timeout", "timeouts", "done", "dones"}
TRUTHS = {"true": 1, "false": 0}


class Column(NamedTuple):
    """A column of a file, in the unit that the environment has."""

    name: str
    factor: float = 1.0
    said: bool = False  # whether its user gave the factor

    def __str__(self) -> str:
        return f"{self.name}*{self.factor:.12g}" if self.said or self.factor != 1 else self.name


class Layout(NamedTuple):
    """Where everything is in a table."""

    observation: tuple[Column, ...]  # [O]
    control: tuple[Column, ...]  # [U]
    time: Column | None
    episode: str | None
    ends: tuple[str, ...] = ()  # true in the last row of an episode


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
        return Column(name, float(factor), said=True)
    except ValueError:
        raise ConfigError(f"{SETTING}: {entry} is not COLUMN*FACTOR; for example x0=angle*0.0174533") from None


def layout(table: Table, names: Names, columns: Sequence[str], dt: float) -> tuple[Layout, str]:
    """Where everything is in a table, and a note where columns' order or a map that names others decided it, or "".

    By the map; else by the names; else the observation in order, then the controls. Raises ConfigError where it cannot
    be told; rows dt [s] apart tell what in it may be the time.
    """
    said, known = mapped(columns, names), (*names.observation, *names.control)
    own = matched([name for name in table.names if name not in {*TIMES, EPISODE} - {*known}], known)
    taken = {column.name for column in said.values()} or {*own.values()}
    found = times.known(table.names, taken)
    time = said.get("t") or (found and Column(*found))
    episode = said[EPISODE].name if EPISODE in said else _episode(table, taken)
    over = [name for name in table.names if loose(name) in ENDS and name not in taken]
    ends = tuple(name for name in over if np.isfinite(truths(table, name)).all())
    called = {column: name for name, column in own.items()}
    other = [f"{c.name} is taken for {n}" for n, c in said.items() if called.get(c.name, n) != n]
    note = f"by {SETTING}=, {', and '.join(other)}" if other else ""
    if not said:
        rest = [name for name in table.names if name not in (episode, time and time.name, *ends)]
        if not own:
            if len(rest) != len(known):
                raise ConfigError(
                    f"{table.source} has {len(rest)} columns, {some(rest)}; expected {len(known)}:"
                    f" {', '.join(known)}; {_beside(table, rest, names, None if time else dt)}"
                )
            said = {name: Column(column) for name, column in zip(known, rest, strict=True)}
            note = f"by their order, {some(rest)} are {', '.join(known)}"
            note += f"; {some(rest[:1])} looks like a row number (0, 1, 2, ...)" if times.counts(table, rest[0]) else ""
        else:
            said = {name: Column(own.get(name, name)) for name in known}
    for column in (*said.values(), *([time] if time else [])):
        if column.name not in table.names:
            raise ConfigError(
                f"{table.source} has no column {column.name}, it has {', '.join(table.names)};"
                f" {SETTING}=[...] says which is which"
            )
    _same_units(table, said, names)
    observation, control = (tuple(said[name] for name in known) for known in (names.observation, names.control))
    return Layout(observation, control, time, episode, ends), note


def _episode(table: Table, taken: Set[str]) -> str | None:
    """The column that tells episodes apart, if there is one. Written in capitals it may be labels, which are none."""
    alike = [name for name in table.names if name.casefold() == EPISODE and name not in taken]
    labels = {table.names[column] for _, column in table.texts}
    return EPISODE if EPISODE in alike else next((name for name in alike if name not in labels), None)


def _beside(table: Table, columns: Sequence[str], names: Names, dt: float | None) -> str:
    """What to do about columns that are not as many as names: if what is too many can be told, what to type.

    The first may be the number of its row, as pandas writes it, and one the time, where none is known and dt is there.
    """
    known = (*names.observation, *names.control)
    first = [name for name in columns[:1] if times.counts(table, name)]
    rest = [name for name in columns if name not in first]
    time = times.alike(table, rest, dt) if dt and len(rest) == len(known) + 1 else None
    rest = [name for name in rest if time is None or name != time[0]]
    if len(rest) != len(known):
        return f"{SETTING}=[...] says which is which"
    typed = word(dict(zip(known, map(Column, rest), strict=True)) | ({"t": Column(*time)} if time else {}), names)
    if not first:
        return f"if {some(time[:1]) if time else ''} is the time, {typed} says so"
    also = f", and {some(time[:1])} like the time" if time else ""
    return (
        f"the first column looks like a row number (0, 1, 2, ...){also}: leave it out, with index=False where pandas"
        f" writes it, or with {typed}"
    )


def _same_units(table: Table, said: Mapping[str, Column], names: Names) -> None:
    """Raises ConfigError, with what to type, for a column whose header says another unit than the environment's."""
    known = {**names.units, "t": "s"}
    other = {
        name: unit
        for name, column in said.items()
        if name in known and not column.said and (unit := units.of_header(column.name, known[name]))
        if units.factor(unit, known[name]) != 1
    }
    for name, unit in [*other.items()][:1]:
        scales = {name: units.factor(unit, known[name]) for name, unit in other.items()}
        entries = {name: f"{said[name].name}*{f'{by:.6g}' if by else 'FACTOR'}" for name, by in scales.items()}
        unknown = (
            "" if scales[name] else f" if it is the right column, FACTOR being how many {known[name]} are 1 {unit}"
        )
        raise ConfigError(
            f"{table.source}: the column {said[name].name} is in {unit}, and {name} is to be in {known[name]};"
            f" {word({**said, **entries}, names)} makes it so{unknown}; *1 says that the header is wrong"
        )


def word(entries: Mapping[str, Any], names: Names) -> str:
    """What to type for a map: name of the environment, t or episode -> an entry; in quotes where it has to be."""
    known = (*names.observation, *names.control)
    texts = [str(entries[name]) for name in known] + [
        f"{name}={entries[name]}" for name in entries if name not in known
    ]
    quoted = [text if re.fullmatch(r"[\w./*=+-]+", text) else f'"{text}"' for text in texts]
    all_ = f"{SETTING}=[{','.join(quoted)}]"
    return all_ if quoted == texts else f"'{all_}'"


def untimed(table: Table, where: Layout, names: Names, dt: float) -> str:
    """The note on a table without a time: which of its columns nothing uses, and what to type if one looks like it."""
    said = dict(zip((*names.observation, *names.control), (*where.observation, *where.control), strict=True))
    used = {where.episode, *where.ends, *(column.name for column in said.values())}
    unused = [name for name in table.names if name not in used]
    note = f"no column t or time: rows are taken to be dt={dt:g} s apart"
    note += f"; nothing uses {some(unused)}" if unused else ""
    if (found := times.alike(table, unused, dt)) is None:
        return note
    return f"{note}; if {some(found[:1])} is the time, {word({**said, 't': Column(*found)}, names)}"


def matched(columns: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Name -> the column of that name; else the one that differs in its unit, else in case, or has _ for a space.

    A column that is some name exactly is no other's. Of two columns that are alike none is taken, nor for two names.
    """
    found = {name: name for name in names if name in columns}
    for form in (plain, loose):
        open_ = _alone([name for name in names if name not in found], form)
        left = _alone([column for column in columns if column not in found.values()], form)
        found |= {open_[text]: left[text] for text in open_ if text in left}
    return found


def _alone(texts: Sequence[str], form: Callable[[str], str]) -> dict[str, str]:
    """Form -> the text that has it, of forms that one text has alone."""
    forms = [*map(form, texts)]
    return {one: text for one, text in zip(forms, texts, strict=True) if forms.count(one) == 1}


def truths(table: Table, name: str) -> np.ndarray:
    """1 or 0 [N] for the truths of a column, 1, 0, true or false; NaN for anything else. What is missing is 0."""
    place = table.names.index(name)
    found = np.nan_to_num(table.rows[:, place])
    for (row, at), text in table.texts.items():
        if at == place:
            found[row] = TRUTHS.get(text.casefold(), np.nan)
    return np.where(np.isin(found, (0, 1)), found, np.nan)


def numbers(table: Table, column: Column) -> np.ndarray:
    """The numbers [N] of a column. Raises ConfigError, with its row, for a text that is none."""
    place = table.names.index(column.name)
    for row, at in table.texts:
        if at == place:
            text = table.texts[row, at]
            raise ConfigError(f"{table.where(row)}: {column.name} is {text!r}; expected a number")
    return table.rows[:, place] * column.factor
