"""A table cut into episodes, checked, and brought to the task's control period."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from pegasus_jax.checks import ConfigError
from pegasus_jax.logs.columns import SETTING, Column, Layout, numbers, truths, untimed
from pegasus_jax.logs.table import Table, names_of
from pegasus_jax.logs.times import nearest
from pegasus_jax.math.circles import to_state
from pegasus_jax.memory import coordinates, measured
from pegasus_jax.task import Task

JITTER = 0.05  # of a period, by which rows may come early or late without being interpolated
BACK = 1.5  # periods from the first time of a log to that with which another episode of it begins, at most
GAP = 3.0  # periods without a row that end an episode
RARE = 5.0  # control periods from row to row that no interpolation fills
ROUNDING = 1e-3  # of a control's range, by which a file's numbers may be beyond it
ROUND = 0.1  # by which a cosine and a sine may miss the unit circle
TURNS = 4 * np.pi  # [rad] an angle at the start of an episode that is greater must be in degrees

Note = Callable[[str], None]


class Segment(NamedTuple):
    """Rows of one episode that follow each other without a gap."""

    t: np.ndarray  # [L+1] [s]
    x: np.ndarray  # [L+1, D] states, as far as they are measured
    u: np.ndarray  # [L, U] what was sent at the times 0..L-1
    begins: bool = True  # whether its first row is its episode's
    first: bool = False  # whether that is the first row of the table, as it is there


def segments(table: Table, where: Layout, task: Task, control: str, note: Note) -> Iterator[Segment]:
    """The episodes of a table, apart where its `episode` changes, one ends, its time goes back, or rows are missing.

    With `control` "before" a row's controls are those sent before it, else at its time. Raises ConfigError, with the
    row, for what cannot be an episode of the task. `note` hears of everything that was decided.
    """
    observed = np.column_stack([numbers(table, column) for column in where.observation])
    sent = np.column_stack([numbers(table, column) for column in where.control])
    t = np.arange(len(observed)) * task.dt if where.time is None else numbers(table, where.time)
    for row in np.flatnonzero(~np.isfinite(t)):
        raise ConfigError(f"{table.where(row)}: its time is missing")
    if where.time is None:
        note(untimed(table, where, names_of(task), task.dt))
    _within_limits(table, sent, where, task)
    begins = np.diff(t) < 0
    for row in np.flatnonzero(begins & (t[1:] > t[0] + BACK * task.dt)):  # not to a beginning
        note(
            f"{table.where(row + 1)}: time goes back from {t[row]:g} to {t[row + 1]:g} s, and another episode begins;"
            " sort the rows where they are of one"
        )
    if where.episode is not None:
        begins |= np.diff(numbers(table, Column(where.episode))) != 0
    for name in where.ends:
        begins |= truths(table, name)[:-1] == 1
    episodes = np.split(np.arange(len(t)), np.flatnonzero(begins) + 1)
    alone = [rows[0] for rows in episodes if len(rows) == 1]
    if alone and len(alone) < len(episodes):  # else the file has no rows that follow each other, which is said of it
        others = f" ({len(alone)} such)" if len(alone) > 1 else ""
        note(
            f"{table.unit} {table.lines[alone[0]]} is an episode of one row{others}: nothing follows from it; left out"
        )
    for rows in episodes:
        if len(rows) > 1:
            u = sent[rows] if control == "sent" else np.vstack([sent[rows[1:]], np.full_like(sent[:1], np.nan)])
            _radians(table, rows, observed[rows], where, task)
            cuts = _cuts(table, rows, t[rows], (observed[rows], u), task, note)
            for part in np.split(np.arange(len(rows)), cuts):
                if len(part) > 1:
                    x = to_state(observed[rows][part], task.circles)
                    first = bool(rows[part[0]] == 0)
                    begun = bool(part[0] == 0) and (table.begins or not first)
                    yield Segment(t[rows][part], x, u[part[:-1]], begun, first)


def _cuts(
    table: Table, rows: np.ndarray, t: np.ndarray, seen: tuple[np.ndarray, np.ndarray], task: Task, note: Note
) -> np.ndarray:
    """Where an episode is cut: before the rows at which time has jumped, and around those that lack numbers."""
    steps = np.diff(t)
    for i in np.flatnonzero(steps <= 0):
        raise ConfigError(f"{table.where(rows[i + 1])}: time stands still at {t[i]:g} s")
    usual = float(np.median(steps))
    if usual > RARE * task.dt:
        raise ConfigError(
            f"{table.where(rows[0])}: a row every {usual:g} s is too rare for dt={task.dt:g}; in other units?"
            f" {SETTING}=[t=COLUMN*{nearest(usual, task.dt):g},...] makes seconds of them"
        )
    whole: np.ndarray = np.all(np.isfinite(seen[0]), axis=1)
    known: np.ndarray = np.all(np.isfinite(seen[1]), axis=1)
    gaps = steps > GAP * max(usual, task.dt)
    for i in np.flatnonzero(gaps)[:1]:
        note(f"{table.unit} {table.lines[rows[i + 1]]} comes {steps[i]:.3g} s after the one before it; cut there")
    unsent = whole & ~known
    unsent[-1] = False  # nothing follows from the last one
    for bad, what in ((~whole, "observation"), (unsent, "control")):
        if bad.any():
            first = table.lines[rows[np.argmax(bad)]]
            note(f"{table.unit} {first} lacks a number of the {what} ({bad.sum()} such rows); cut there")
    return np.flatnonzero(gaps | ~whole[1:] | ~whole[:-1] | ~known[:-1]) + 1


def _radians(table: Table, rows: np.ndarray, observed: np.ndarray, where: Layout, task: Task) -> None:
    """Raises ConfigError for an angle that cannot be in radians, and for a pair that is no cosine and sine.

    An angle that starts within two turns and never jumps may be one of degrees, or of an encoder that goes on and on.
    """
    for pair in task.circles:
        radius = np.hypot(*observed[:, pair].T)
        for row in np.flatnonzero(np.abs(radius - 1) > ROUND)[:1]:
            names = " and ".join(where.observation[entry].name for entry in pair)
            raise ConfigError(
                f"{table.where(rows[row])}: {names} are no cosine and sine of an angle: the root of the sum of their"
                f" squares is {radius[row]:.3g}"
            )
    for entry in np.flatnonzero(names_of(task).turning):
        angle = np.where(np.isfinite(observed[:, entry]), observed[:, entry], np.nan)  # else the episode is cut there
        jumps = np.abs(np.diff(angle))
        odd = (jumps > np.pi) & (np.abs(jumps - 2 * np.pi) > np.pi / 2)  # neither a move nor a seam at 180 degrees
        odd &= np.abs(angle[1:]) > TURNS
        first = [0] if np.abs(angle[0]) > TURNS else [*(np.flatnonzero(odd) + 1)]
        for row in first[:1]:
            name = where.observation[entry].name
            raise ConfigError(
                f"{table.where(rows[row])}: {name} is {angle[row]:g}, which looks like degrees; angles are in radians:"
                f" {SETTING}=[...] may say {name}*0.0174533"
            )


def _within_limits(table: Table, sent: np.ndarray, where: Layout, task: Task) -> None:
    """Clips what rounding left beyond the limits. Raises ConfigError for controls [N, U] that really are beyond."""
    low, high = np.asarray(task.control_low, float), np.asarray(task.control_high, float)
    slack = ROUNDING * (high - low)
    for row, i in np.argwhere((sent < low - slack) | (sent > high + slack))[:1]:
        raise ConfigError(
            f"{table.where(row)}: {where.control[i].name} is {sent[row, i]:g}, beyond its limits {low[i]:g} to"
            f" {high[i]:g}"
        )
    np.clip(sent, low, high, out=sent)


def periods(one: Segment, task: Task, note: Note) -> Segment | None:
    """The segment at the task's control period; None where it is shorter than one.

    As it is where its rows come a period apart. Else states are interpolated linearly, angles the shorter way, and
    controls are those held at the middle of each period: one that is sent late still acts for most of its own.
    """
    steps = np.diff(one.t)
    if np.abs(steps / task.dt - 1).max() <= JITTER:
        return one
    slack = 1e-3 * task.dt
    count = int((one.t[-1] - one.t[0] + slack) / task.dt)
    if count == 0:
        note("a piece is shorter than a period; left out")
        return None
    grid = one.t[0] + task.dt * np.arange(count + 1)
    turning = [i in task.angles for i in measured(task)]
    inside = np.minimum(grid, one.t[-1])  # the last may be later by a rounding
    x = np.column_stack([interpolated(inside, one.t, *pair) for pair in zip(one.x.T, turning, strict=True)])
    held = np.searchsorted(one.t, grid[:-1] + task.dt / 2, side="right") - 1
    within = np.minimum((one.t[:-1] - one.t[0] + slack) // task.dt, count - 1).astype(int)  # the period of each row
    note(f"a row every {np.median(steps):.3g} s or so: resampled to dt={task.dt:g}")
    if np.any(one.u != one.u[held][within]):
        note(f"controls change within periods of dt={task.dt:g}; those at their middle are taken")
    return Segment(grid, x, one.u[held], one.begins)


def with_rates(x: np.ndarray, task: Task) -> np.ndarray:
    """States [L+1, D] of what is measured of them; their rates are differences from row to row."""
    places = list(measured(task))
    if len(places) == len(task.state_names):
        return x
    whole = np.zeros((len(x), len(task.state_names)))
    whole[:, places] = x
    for i, rate in zip(coordinates(task), task.rates, strict=True):
        change = np.diff(whole[:, i])
        change = np.arctan2(np.sin(change), np.cos(change)) if i in task.angles else change
        whole[1:, rate] = change / task.dt
        whole[0, rate] = whole[1, rate]
    return whole


def interpolated(
    grid: np.ndarray, t: np.ndarray, values: np.ndarray, turning: bool, turn: float = 2 * np.pi
) -> np.ndarray:
    """Values at the times `grid`, linear between those at t; NaN outside. An angle's keep to the range that it had.

    `turn` is a whole turn in the values' unit.
    """
    straight, there = values.astype(float), np.isfinite(values)
    if turning:  # a number that is missing is on no side of a seam, and what follows it is
        straight[there] = np.unwrap(values[there], period=turn)
    found = np.interp(grid, t, straight, left=np.nan, right=np.nan)
    if np.array_equal(straight, values, equal_nan=True):
        return found
    low = -turn / 2 if values[there].min() < 0 else 0.0
    return (found - low) % turn + low
