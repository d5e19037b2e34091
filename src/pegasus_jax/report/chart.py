"""Charts as inline SVG: a list of marks in, HTML out. Colors come from the page's style sheet, so they can be dark."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import NamedTuple
from zlib import crc32

from matplotlib.ticker import LogLocator, MaxNLocator

Numbers = Sequence[float | None]
LEFT, RIGHT, TOP, BOTTOM = 66, 12, 10, 42  # of the axes inside a chart [pixels]


class Line(NamedTuple):
    """A line through points; it has a gap where a value is None or not finite."""

    x: Sequence[float]
    y: Numbers
    style: str  # classes of the style sheet: a color, "thin", "dashed", "dotted"
    label: str = ""  # in the legend; "": not there
    dots: Sequence[str] | None = None  # what each point says when a person points at it; None: no points


class Band(NamedTuple):
    """The area between two lines."""

    x: Sequence[float]
    low: Numbers
    high: Numbers
    style: str
    label: str = ""


class Level(NamedTuple):
    """A horizontal line: a limit, or the best that can be."""

    y: float
    label: str = ""


class Axes(NamedTuple):
    """Where numbers lie in a chart."""

    x: tuple[float, float]
    y: tuple[float, float]
    log: bool
    whole: bool  # whether x counts something
    width: int
    height: int

    def across(self, x: float) -> float:
        """Pixels from the left."""
        low, high = self.x
        return LEFT + (x - low) / (high - low) * (self.width - LEFT - RIGHT)

    def down(self, y: float) -> float:
        """Pixels from the top, at most a little outside of the chart."""
        low, high, at = (math.log10(max(v, 1e-9)) if self.log else v for v in (*self.y, y))
        fraction = min(max((at - low) / (high - low), -1.0), 2.0)
        return self.height - BOTTOM - fraction * (self.height - TOP - BOTTOM)


Mark = Line | Band | Level


def chart(
    title: str,
    across: str,
    up: str,
    marks: Sequence[Mark],
    *,
    x: tuple[float, float] | None = None,
    y: tuple[float, float] | None = None,
    log: bool = False,
    small: bool = False,
) -> str:
    """A figure with its axes' names and units, a legend and a caption. `x` and `y` are limits.

    Without them the marks decide: x begins at 0, or counts something where it is whole numbers.
    """
    axes = _axes(marks, x, y, log, (330, 205) if small else (860, 300))
    clip = f"clip-{crc32(repr((title, across, up, marks)).encode()):x}"
    inner = (axes.width - LEFT - RIGHT, axes.height - TOP - BOTTOM)
    drawn = "".join(_drawn(mark, axes) for mark in sorted(marks, key=lambda mark: not isinstance(mark, Band)))
    svg = (
        f'<svg viewBox="0 0 {axes.width} {axes.height}" role="img" aria-label="{escape(f"{title}: {up}")}">'
        f'<clipPath id="{clip}"><rect x="{LEFT}" y="{TOP - 5}" width="{inner[0] + 6}" height="{inner[1] + 10}"/>'
        f'</clipPath>{_grid(axes, across, up)}<g clip-path="url(#{clip})">{drawn}</g></svg>'
    )
    words = f"<figcaption><b>{escape(title)}</b></figcaption>"
    return f'<figure class="{"small" if small else "wide"}">{words}{svg}{"" if small else legend(marks)}</figure>'


def legend(marks: Sequence[Mark]) -> str:
    """What the lines and bands are; small charts, which are drawn side by side, share one."""
    keys = "".join(_key(mark) for mark in marks if not isinstance(mark, Level) and mark.label)
    return f'<div class="legend">{keys}</div>' if keys else ""


def unit(marks: Sequence[Mark]) -> tuple[float, float]:
    """Limits from 0 to 1, or as far as the marks go: most costs are between, and are compared from chart to chart."""
    heights = [v for mark in marks for v in _heights(mark)]
    return min([0.0, *heights]), 1.04 * max([1.0, *heights])


def sparkline(values: Numbers, width: int = 110, height: int = 26) -> str:
    """A line without axes, for a table: from its first value to its last."""
    known = _known(values)
    axes = Axes((0.0, max(len(values) - 1, 1)), (min([*known, 0.0]), max([*known, 1e-9])), False, True, width, height)

    def place(i: int, v: float) -> str:
        up = (v - axes.y[0]) / (axes.y[1] - axes.y[0])
        return f"{2 + i / axes.x[1] * (width - 4):.1f},{height - 3 - up * (height - 6):.1f}"

    points = " ".join(place(i, v) for i, v in enumerate(values) if v is not None and math.isfinite(v))
    return f'<svg class="spark" viewBox="0 0 {width} {height}"><polyline class="real" points="{points}"/></svg>'


def _axes(
    marks: Sequence[Mark],
    x: tuple[float, float] | None,
    y: tuple[float, float] | None,
    log: bool,
    size: tuple[int, int],
) -> Axes:
    xs = [v for mark in marks if not isinstance(mark, Level) for v in mark.x] or [0.0, 1.0]
    ys = [v for mark in marks for v in _heights(mark) if not log or v > 0] or [0.0, 1.0]
    low, high = y or (min(ys), max(ys))
    if log:
        low, high = min(low, 0.5) / 1.2, max(high, 2.0) * 1.2
    elif y is None:
        margin = 0.06 * (high - low) or max(abs(high), 1.0) * 0.1
        low, high = low - margin, high + margin
    whole = x is not None or all(isinstance(v, int) for v in xs)
    across = x or ((min(xs) - 0.5, max(xs) + 0.5) if whole else (min(0.0, *xs), max(xs) or 1.0))
    return Axes(across, (low, high), log, whole, *size)


def _heights(mark: Mark) -> list[float]:
    values = [mark.y] if isinstance(mark, Level) else [*mark.low, *mark.high] if isinstance(mark, Band) else mark.y
    return _known(values)


def _known(values: Numbers) -> list[float]:
    return [v for v in values if v is not None and math.isfinite(v)]


def _grid(axes: Axes, across: str, up: str) -> str:
    bottom, right = axes.height - BOTTOM, axes.width - RIGHT
    count = 5 if axes.width < 500 else 9
    parts = []
    for x in _ticks(axes.x, count, whole=axes.whole):
        at = axes.across(x)
        parts.append(f'<line class="grid" x1="{at:.1f}" y1="{TOP}" x2="{at:.1f}" y2="{bottom}"/>')
        parts.append(f'<text x="{at:.1f}" y="{bottom + 15}" text-anchor="middle">{_number(x)}</text>')
    for y in _ticks(axes.y, 5, axes.log):
        at = axes.down(y)
        parts.append(f'<line class="grid" x1="{LEFT}" y1="{at:.1f}" x2="{right}" y2="{at:.1f}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{_number(y)}</text>')
    middle = (TOP + bottom) / 2
    parts.append(
        f'<text class="name" x="{(LEFT + right) / 2:.0f}" y="{axes.height - 6}" text-anchor="middle">{escape(across)}'
        f'</text><text class="name" transform="translate(11 {middle:.0f}) rotate(-90)" text-anchor="middle">'
        f"{escape(up)}</text>"
    )
    return "".join(parts)


def _ticks(limits: tuple[float, float], count: int, log: bool = False, whole: bool = False) -> list[float]:
    if log:
        found = LogLocator(subs=(1.0, 2.0, 5.0) if limits[1] / limits[0] < 100 else (1.0,)).tick_values(*limits)
    else:
        found = MaxNLocator(count, steps=[1, 2, 2.5, 5, 10], integer=whole).tick_values(*limits)
    inside = [float(v) for v in found if limits[0] - 1e-12 <= v <= limits[1] + 1e-12]
    return [v for v in inside if v == round(v)] if whole else inside


def _number(value: float) -> str:
    return f"{value:.6g}".replace("-", "\N{MINUS SIGN}")


def _drawn(mark: Mark, axes: Axes) -> str:
    if isinstance(mark, Level):
        at = axes.down(mark.y)
        words = f'<text class="level" x="{axes.width - RIGHT - 4}" y="{at - 4:.1f}" text-anchor="end">'
        line = f'<line class="level" x1="{LEFT}" y1="{at:.1f}" x2="{axes.width - RIGHT}" y2="{at:.1f}"/>'
        return line + (f"{words}{escape(mark.label)}</text>" if mark.label else "")
    if isinstance(mark, Band):
        rows = [(x, a, b) for x, a, b in zip(mark.x, mark.low, mark.high, strict=False) if _known([a, b]) == [a, b]]
        edge = [*((x, a) for x, a, _ in rows), *((x, b) for x, _, b in reversed(rows))]
        points = " ".join(_point(axes, x, v) for x, v in edge if v is not None)
        return f'<polygon class="band {mark.style}" points="{points}"/>' if rows else ""
    drawn = "".join(f'<polyline class="{mark.style}" points="{" ".join(run)}"/>' for run in _pieces(mark, axes))
    return drawn + "".join(_dots(mark, axes))


def _pieces(line: Line, axes: Axes) -> list[list[str]]:
    """The points of a line, a list for each part without a gap."""
    pieces: list[list[str]] = [[]]
    for x, y in zip(line.x, line.y, strict=False):
        if y is None or not math.isfinite(y):
            pieces.append([])
        else:
            pieces[-1].append(_point(axes, x, y))
    return [piece for piece in pieces if len(piece) > 1]


def _dots(line: Line, axes: Axes) -> list[str]:
    return [
        f'<circle class="{line.style}" cx="{axes.across(x):.1f}" cy="{axes.down(y):.1f}" r="3.5">'
        f"<title>{escape(words)}</title></circle>"
        for x, y, words in zip(line.x, line.y, line.dots or (), strict=False)
        if y is not None and math.isfinite(y)
    ]


def _point(axes: Axes, x: float, y: float) -> str:
    return f"{axes.across(x):.1f},{axes.down(y):.1f}"


def _key(mark: Line | Band) -> str:
    kind = "band " if isinstance(mark, Band) else ""
    shape = '<rect y="3" width="22" height="10"' if kind else '<line x1="0" y1="8" x2="22" y2="8"'
    dot = f'<circle class="{mark.style}" cx="11" cy="8" r="3.5"/>' if isinstance(mark, Line) and mark.dots else ""
    drawn = f'<svg viewBox="0 0 22 16" class="key">{shape} class="{kind}{mark.style}"/>{dot}</svg>'
    return f"<span>{drawn}{escape(mark.label)}</span>"
