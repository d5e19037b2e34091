"""How far a picture of an episode and of its imagined particles reaches."""

import numpy as np

CENTRAL = (5, 95)  # quantiles of the particles [%]
AROUND = 4.0  # how far a picture goes beyond its episode at most, in heights of the episode
MARGIN = 0.06  # below and above, in heights of the picture


def window(real: np.ndarray | None, particles: np.ndarray | None, *levels: float) -> tuple[float, float] | None:
    """Limits of an axis for an episode [L], particles [H, K] and levels; None where none of these is a finite number.

    The whole episode is inside. So are the central particles of each period, unless they fly so far away that the
    episode would be a flat line. Of an episode in which nothing moves, the height is that of the first particles.
    """
    rows = _finite(real)
    low, high, central = _quantiles(particles)
    if not low.size:
        inside = rows
    elif rows.size:
        inside = _between(low, high, rows, AROUND * max(np.ptp(rows), (high - low)[:2].max()))
    else:
        inside = _between(low, high, central, np.ptp(central))
    ends = np.concatenate([inside, levels])
    if not ends.size:
        return None
    margin = MARGIN * np.ptp(ends) or 0.1 * max(abs(ends[0]), 1.0)
    return float(ends.min() - margin), float(ends.max() + margin)


def _between(low: np.ndarray, high: np.ndarray, core: np.ndarray, reach: float) -> np.ndarray:
    """The ends of the core, and as much of what lies from low to high as is within reach of it."""
    bottom, top = core.min(), core.max()
    return np.array([min(bottom, max(low.min(), bottom - reach)), max(top, min(high.max(), top + reach))])


def _quantiles(particles: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Low [H] and high [H] quantiles of each period, and both [2] of all periods together; empty without particles."""
    known = np.zeros((0, 1)) if particles is None else np.asarray(particles, float)
    known = known[np.isfinite(known).all(1)]
    if not known.size:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    return *np.percentile(known, CENTRAL, axis=1), np.percentile(known, CENTRAL)


def _finite(values: np.ndarray | None) -> np.ndarray:
    found = np.zeros(0) if values is None else np.asarray(values, float)
    return found[np.isfinite(found)]
