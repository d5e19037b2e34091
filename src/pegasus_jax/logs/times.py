"""Which column of a log is its time, and which one looks as if it were."""

import math
import re
from collections.abc import Callable, Sequence

import numpy as np

from pegasus_jax.logs.table import EPISODE, TIMES, Table
from pegasus_jax.logs.units import factor, of_header
from pegasus_jax.math.units import parted

UNITS = ("s", "ms", "us", "ns")
NAMED = {"t", "time", "timestamp", "stamp", "clock", "sec", "secs", "seconds", "msec", "usec", "millis", "micros"}
NAMED |= {*UNITS}
SHARE = 0.9  # of the rows of a time that rise, and of one without a name that rise alike
EVEN = 0.5  # of the median step, by which others may differ from it

Named = tuple[str, float]  # a column, and what makes seconds of its numbers


def known(columns: Sequence[str], taken: set[str]) -> Named | None:
    """The column of the time, or None. T, which may be a torque or a temperature, is time where it is first.

    Of one with a unit of time in brackets, as "t [ms]", seconds are made.
    """
    found = [(name, 1.0) for name in TIMES if name in columns]
    found += [(name, 1.0) for name in columns if name.casefold() == "time"]
    found += [(name, 1.0) for name in columns[:1] if name == "T"]
    for name in columns:
        bare = re.sub(r"\([^()]*\)$", "", parted(name)[0]).strip().casefold()
        if bare in TIMES and (scale := factor(of_header(name, "s") or "", "s")):
            found.append((name, scale))
    return next((one for one in found if one[0] in TIMES or one[0] not in taken), None)


def alike(table: Table, unused: Sequence[str], dt: float) -> Named | None:
    """The one of the unused columns that looks like time, or None: it rises, and is named like time or rises evenly.

    Where its name says no unit, that is taken in which rows are nearest to dt [s] apart.
    """
    steps = {name: np.diff(table.rows[:, table.names.index(name)]) for name in unused if name != EPISODE}
    named = [name for name in steps if {*_words(name)} & NAMED and _share(steps[name], lambda step: step > 0) > SHARE]
    even = [name for name in steps if _even(steps[name]) and not counts(table, name)]
    for name in [*named, *even][:1]:
        units = [scale for word in _words(name) if word != "t" and (scale := factor(word, "s"))]
        return name, units[-1] if units else nearest(float(np.nanmedian(steps[name])), dt)
    return None


def counts(table: Table, name: str) -> bool:
    """Whether a column looks like the number of its row, 0, 1, 2, ...; of rows that were kept of more, from any on."""
    numbers = table.rows[:, table.names.index(name)]
    return _share(np.diff(numbers), lambda step: step == 1) > SHARE and float(numbers[0]).is_integer()


def _even(steps: np.ndarray) -> bool:
    usual = np.nanmedian(steps) if np.isfinite(steps).any() else 0.0
    return bool(usual > 0) and _share(steps, lambda step: np.abs(step / usual - 1) < EVEN) > SHARE


def _share(steps: np.ndarray, holds: Callable[[np.ndarray], np.ndarray]) -> float:
    """Of the steps [N-1] of a column those, from 0 to 1, for which something holds."""
    return float(np.mean(holds(steps))) if len(steps) > 1 else 0.0


def nearest(step: float, dt: float) -> float:
    """The unit of time [s] in which rows that are a `step` apart are nearest to dt [s] apart."""
    scales = [scale for unit in UNITS if (scale := factor(unit, "s"))]
    return min(scales, key=lambda scale: abs(math.log(step * scale / dt)))


def _words(name: str) -> list[str]:
    """Its words in small letters: of "Time_ms", "TimeMs" and "time (ms)", time and ms."""
    return re.findall(r"[a-zµ]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", name).casefold())
