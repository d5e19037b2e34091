"""How many control periods pass from a control to the first change that is observed: a test of every lag at once."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

EXACT = 1e-6  # of an entry's variance: what is left of it is rounding
REPEATS = 0.9999  # the correlation with a control from which on a reading is that control, maybe rounded
MOST = 8  # periods of delay that are looked for
ENOUGH = 50  # rows from which an estimate can be made, besides one for each number that is fitted


class Delay(NamedTuple):
    """An estimate of a delay in whole control periods."""

    periods: int | None
    """the most probable one; None: no change that follows from the controls was found"""
    probabilities: np.ndarray
    """[most + 2] of a delay of 0, 1, ..., `most` periods, and of none that was found"""
    rows: int
    """control periods that it was made from"""
    echoes: tuple[int, ...]
    """the entries of the observation that repeat a control, which say nothing of a delay"""


def delay_of(episodes: Sequence[tuple[np.ndarray, np.ndarray]], angles: Sequence[int] = (), most: int = MOST) -> Delay:
    """The delay in episodes of random controls, each (x [L + 1, D], u [L, U]): u[t] is sent after x[t] was read.

    A delay of d periods means that x[t + 1] depends on u[t - d] and on those before it, but on no later one; 0 is a
    plant that answers within the period. The change of every entry is regressed on the last two observations and on
    the controls from lag d to lag `most`. Each d has the probability that its Bayesian information criterion gives it
    (Schwarz, "Estimating the dimension of a model", Annals of Statistics 6, 1978, with equal odds beforehand). As the
    controls are drawn independently of everything before them, one of a shorter lag cannot seem to matter, however
    wrong the regression is; so controls of a policy will not do. `angles` are the entries in radians that wrap.

    Raises ValueError for too few rows.
    """
    if not episodes:
        raise ValueError("there are no episodes")
    used = [(np.asarray(x, float), np.asarray(u, float)) for x, u in episodes if len(u) > most + 1]
    rows, needed = rows_of([len(u) for _, u in used], most), enough(np.shape(episodes[0][1])[1], most)
    if rows < needed:
        raise ValueError(f"{rows} rows that have {most} controls before them are too few; {needed} are enough")
    lags = np.concatenate([_lagged(u, most) for _, u in used])  # [N, most + 1, U]
    after = np.concatenate([x[most + 1 :] for x, _ in used])
    echoes = tuple(i for i in range(after.shape[1]) if _repeats(after[:, i], lags.reshape(rows, -1)))
    pairs = [_rows(x, [i for i in range(x.shape[1]) if i not in echoes], angles, most) for x, _ in used]
    past, changes = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    moving = np.ptp(changes, axis=0) > 0
    base = np.column_stack([np.ones(rows), past])
    scores = np.array([_criterion(changes[:, moving], base, lags[:, d:].reshape(rows, -1)) for d in range(most + 2)])
    weights = np.exp(-0.5 * (scores - scores.min())) if moving.any() else np.eye(most + 2)[-1]  # what stands is sure
    probabilities = weights / weights.sum()
    best = int(np.argmax(probabilities))
    return Delay(best if best <= most else None, probabilities, rows, echoes)


def enough(controls: int, most: int) -> int:
    """Rows that have `most` controls before them, of so many entries each, from which an estimate can be made."""
    return ENOUGH + controls * (most + 1)


def rows_of(lengths: Sequence[int], most: int) -> int:
    """Rows that have `most` controls before them in episodes of so many periods; one row alone is not used."""
    return sum(length - most for length in lengths if length > most + 1)


def _rows(x: np.ndarray, entries: Sequence[int], angles: Sequence[int], most: int) -> tuple[np.ndarray, np.ndarray]:
    """What an episode has for each period from the one numbered `most` on: what was read [N, P], and changes [N, E]."""
    change = np.diff(x, axis=0)
    turning = [i for i in entries if i in angles]
    change[:, turning] = np.angle(np.exp(1j * change[:, turning]))
    change, plain = change[:, list(entries)], x[:, [i for i in entries if i not in angles]]
    seen = np.column_stack([plain, np.sin(x[:, turning]), np.cos(x[:, turning])])
    return np.column_stack([seen[most:-1], change[most - 1 : -1]]), change[most:]


def _lagged(u: np.ndarray, most: int) -> np.ndarray:
    """The controls [N, most + 1, U] of each period from the one numbered `most` on, and of those before it."""
    return np.stack([u[most - lag : len(u) - lag] for lag in range(most + 1)], axis=1)


def _repeats(level: np.ndarray, controls: np.ndarray) -> bool:
    """Whether a reading [N] is a linear function of one of the controls [N, C], maybe rounded."""
    if np.ptp(level) == 0:
        return False
    moving = controls[:, np.ptp(controls, axis=0) > 0]
    return bool(moving.size and np.max(np.abs(np.corrcoef(level, moving, rowvar=False)[0, 1:])) > REPEATS)


def _criterion(changes: np.ndarray, base: np.ndarray, controls: np.ndarray) -> float:
    """The Bayesian information criterion of the changes [N, D] as a linear function of what is known.

    Of all entries at once, by their covariance: what the regression misses, several of them miss together.
    """
    (count, size), known = changes.shape, np.column_stack([base, controls])
    rest = (changes - known @ np.linalg.lstsq(known, changes, rcond=None)[0]) / np.std(changes, axis=0)
    spread = np.linalg.slogdet(rest.T @ rest / count + EXACT * np.eye(size))[1]
    return float(count * spread + size * known.shape[1] * np.log(count))
