"""The interquartile mean of seeds, and how uncertain it is (Agarwal et al., NeurIPS 2021)."""

import numpy as np
from scipy.stats import bootstrap, trim_mean


def iqm(values: np.ndarray, axis: int = 0) -> np.ndarray:
    """The interquartile mean over seeds, the first axis."""
    return trim_mean(values, 0.25, axis=axis)


def interval(*samples: np.ndarray, paired: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """The 95 % bootstrap interval of the interquartile mean over seeds [S, ...]; of two samples, of the difference.

    `paired` says that both samples have the same seeds, in one order. Unbounded for a single seed, which says nothing
    of the others.
    """
    if min(map(len, samples)) < 2:
        return np.full(samples[0].shape[1:], -np.inf), np.full(samples[0].shape[1:], np.inf)

    def statistic(first: np.ndarray, *second: np.ndarray, axis: int) -> np.ndarray:
        return iqm(first, axis) - sum(iqm(other, axis) for other in second)

    options: dict = dict(axis=0, n_resamples=2000, method="percentile", paired=paired, rng=np.random.default_rng(0))
    found = bootstrap(samples, statistic, **options).confidence_interval
    return found.low, found.high
