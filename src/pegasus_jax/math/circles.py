"""A cosine and a sine that are observed are one angle of the state: the way there, back, and how such pairs are found.

The user's observation [O] holds the pairs; the state [D], D = O - pairs, is what models, policies and searches see.
An angle takes the place of the earlier entry of its pair; everything else keeps its order.
"""

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np

Circles = tuple[tuple[int, ...], ...]  # (entry of the cosine, entry of the sine) of each pair

TOLERANCE = 1e-6  # of x^2 + y^2 = 1: some roundings of single precision
SPREAD = 1e-4  # that x^2 has at least, so that no two constants pass for a circle
SAMPLES = 100  # observations at least


def to_state(x: Any, circles: Circles) -> Any:
    """States [..., D] of observations [..., O], arrays of NumPy or JAX; the angles are in [-pi, pi] rad."""
    if not circles:
        return x
    xp, pair_at, columns = x.__array_namespace__(), _pair_at(circles), []
    for i in entries(x.shape[-1], circles):
        cosine, sine = pair_at.get(i, (i, i))
        columns.append(xp.atan2(x[..., sine], x[..., cosine]) if i in pair_at else x[..., i])
    return xp.stack(columns, -1)


def to_observation(x: Any, circles: Circles) -> Any:
    """Observations [..., O] of states [..., D]: every pair lies on the unit circle, whatever was read."""
    if not circles:
        return x
    xp, pair_at = x.__array_namespace__(), _pair_at(circles)
    columns: dict[int, Any] = {}
    for place, i in enumerate(entries(x.shape[-1] + len(circles), circles)):
        if i in pair_at:
            cosine, sine = pair_at[i]
            columns |= {cosine: xp.cos(x[..., place]), sine: xp.sin(x[..., place])}
        else:
            columns[i] = x[..., place]
    return xp.stack([columns[i] for i in range(len(columns))], -1)


def places(of: Sequence[int], size: int, circles: Circles) -> tuple[int, ...]:
    """Where these entries of an observation of `size` are in the state."""
    kept = entries(size, circles)
    return tuple(kept.index(entry) for entry in of)


def names(observed: Sequence[str], circles: Circles) -> tuple[str, ...]:
    """Names of the state's entries, of those of the observation."""
    pair_at = _pair_at(circles)
    return tuple(
        f"atan2({observed[pair_at[i][1]]}, {observed[pair_at[i][0]]})" if i in pair_at else observed[i]
        for i in entries(len(observed), circles)
    )


def angle_places(size: int, circles: Circles) -> tuple[int, ...]:
    """The entries of the state that are angles of circles."""
    return places([*_pair_at(circles)], size, circles)


def find(seen: np.ndarray, others: Sequence[int] = ()) -> Circles:
    """The pairs of a cosine and a sine among the entries of observations [N, O], of which there are at least 100.

    x_i^2 + x_j^2 = 1 within 1e-6 in each row, and x_i^2 varies a hundred times as much: no accident, and no constants.
    An entry is of one pair at most, and none of `others`. The earlier entry is taken for the cosine: were it the sine,
    the angle would be counted from elsewhere and the other way round, which changes nothing for who learns it.
    """
    free = set(range(seen.shape[1])) - {*others}
    square = np.asarray(seen, np.float64) ** 2
    found: list[tuple[int, ...]] = []
    for i, j in combinations(sorted(free), 2) if len(seen) >= SAMPLES else ():
        on_circle = np.abs(square[:, i] + square[:, j] - 1).max() < TOLERANCE and np.ptp(square[:, i]) > SPREAD
        if on_circle and {i, j} <= free:
            found.append((i, j))
            free -= {i, j}
    return tuple(found)


def around(x: np.ndarray, angles: Sequence[int]) -> np.ndarray:
    """Rows [N, D] with every angle within half a turn of their circular mean: no cloud is torn at 180 degrees."""
    x = np.array(x, np.float64)
    for i in angles:
        middle = np.angle(np.mean(np.exp(1j * x[:, i])))
        x[:, i] = middle + np.angle(np.exp(1j * (x[:, i] - middle)))
    return x


def entries(size: int, circles: Circles) -> list[int]:
    """The entries of an observation of `size` that have a place in the state, in its order: of a pair, the earlier."""
    gone = {max(pair) for pair in circles}
    return [i for i in range(size) if i not in gone]


def _pair_at(circles: Circles) -> dict[int, tuple[int, ...]]:
    """The pair whose angle takes the place of an entry of the observation."""
    return {min(pair): pair for pair in circles}
