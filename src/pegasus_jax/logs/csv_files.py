"""Text files of rows of numbers, CSV, as tables."""

import csv
import math
from pathlib import Path

import numpy as np

from pegasus_jax.checks import ConfigError
from pegasus_jax.logs.table import Table, reason


def of_csv(path: Path) -> Table:
    """The table of a text file, cells apart by commas, semicolons or tabs; a first line that is no numbers is a header.

    Between semicolons or tabs a comma is a decimal one. Empty lines, and those that begin with #, are left out. Of the
    latter the last before the first row is a header too if it can be, as NumPy writes it. Raises ConfigError, with
    the line, for a row of another length.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is not in UTF-8, and has bytes at {error.start} that are not; save it so") from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read: {reason(error)}") from error
    kept = [(number, line) for number, line in enumerate(lines, 1) if line.strip() and line[0] != "#"]
    if not kept:
        raise ConfigError(f"{path} is empty; expected a header and rows of numbers")
    for number, line in kept:
        if len(line) > csv.field_size_limit():
            raise ConfigError(f"{path} line {number} has {len(line):,} letters; expected a row of numbers")
    delimiter = _delimiter([line for _, line in kept])
    cells = [_cells(f"{path} line {number}", line, delimiter) for number, line in kept]
    while len({*map(len, cells)}) == 1 < len(cells[0]) and not any(row[-1] for row in cells):  # of a comma at its end
        cells = [row[:-1] for row in cells]
    remarks = [line for line in lines[: kept[0][0] - 1] if line[:1] == "#"]
    above = [cell.strip() for cell in remarks[-1].lstrip("#").split(delimiter)] if remarks else []
    names, header = _header(cells[0], above, cells[1] if len(cells) > 1 else cells[0], delimiter)
    body, places = cells[header:], np.array([number for number, _ in kept][header:], int)
    if not body:
        raise ConfigError(f"{path} has a header and no rows; expected rows of numbers")
    if twice := [name for name in names if names.count(name) > 1]:
        raise ConfigError(f"{path} has two columns called {twice[0]!r}; expected names that differ")
    if wrong := [(line, row) for line, row in zip(places, body, strict=True) if len(row) != len(names)]:
        line, row = wrong[0]
        raise ConfigError(f"{path} line {line} has {len(row)} columns; expected {len(names)}, as in its first row")
    numbers = [[_number(cell, delimiter) for cell in row] for row in body]
    texts = {
        (i, j): body[i][j]
        for i, row in enumerate(numbers)
        for j, value in enumerate(row)
        if value is None and body[i][j]
    }
    rows = np.array([[math.nan if v is None else v for v in row] for row in numbers]).reshape(-1, len(names))
    return Table(str(path), names, rows, places, "line", texts)


def _cells(where: str, line: str, delimiter: str) -> list[str]:
    row = next(csv.reader([line + "\n"], delimiter=delimiter))
    if row[-1].endswith("\n"):  # the quote goes on
        raise ConfigError(f"{where}: a quote is not closed on its line; expected each cell on one line")
    return [cell.strip() for cell in row]


def _delimiter(lines: list[str]) -> str:
    """The delimiter of lines: a semicolon, a tab or a comma, in this order, as a comma may be a decimal mark.

    The first that gives all lines as many cells, more than one, and the last line numbers; else one that the first has.
    """
    for delimiter in ";\t,":
        rows = [next(csv.reader([line], delimiter=delimiter), []) for line in (*lines[:2], lines[-1])]
        last = [cell.strip() for cell in rows[-1]]
        numbers = not any(cell and _number(cell, delimiter) is None for cell in last)
        if numbers and len(last) > 1 and {*map(len, rows)} == {len(last)}:
            return delimiter
    return next((delimiter for delimiter in ",;\t" if delimiter in lines[0]), ",")


def _header(first: list[str], above: list[str], second: list[str], delimiter: str) -> tuple[tuple[str, ...], bool]:
    """The names of the columns, of the first row and the remark above it, and whether that row is them and no data."""
    numbered = [str(i) for i in range(len(first))]
    # Pandas writes the numbers of an array's columns behind an empty cell, which is over those of its rows.
    of_array = not first[0] and bool(second[0]) and all(cell.isdecimal() for cell in first[1:])
    if of_array or any(cell and _number(cell, delimiter) is None for cell in first):
        return tuple(first), True
    if len(above) == len(first) and all(cell and _number(cell, delimiter) is None for cell in above):
        return tuple(above), False
    return tuple(numbered), first == numbered  # as pandas writes the columns of an array


def _number(cell: str, delimiter: str) -> float | None:
    """A cell's number, None where it is none. Its decimal mark may be a comma unless that is the delimiter."""
    try:
        return float(cell if delimiter == "," or cell.endswith(",") else cell.replace(",", "."))
    except ValueError:
        return None
