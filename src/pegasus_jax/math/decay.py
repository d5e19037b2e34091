"""How a step size falls."""

from typing import Any

import numpy as np


def half_cosine(fraction: Any, decay: float) -> np.ndarray:
    """A factor that falls from 1 to `decay` as the fraction goes from 0 to 1, and stays there."""
    return (1 - decay) * (1 + np.cos(np.pi * np.minimum(fraction, 1))) / 2 + decay
