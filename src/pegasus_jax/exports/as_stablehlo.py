"""A controller as StableHLO in the container of jax.export, of any policy: JAX runs it without this package."""

from pathlib import Path

import jax
import numpy as np
from jax import export as jax_export

from pegasus_jax.exports.layers import forgetful
from pegasus_jax.exports.learned import Learned, function
from pegasus_jax.runs.restore import precision

PLATFORMS = ("cpu", "cuda")


def write(learned: Learned, name: str) -> bytes:
    """The function of one observation [O], its weights inside."""
    forgetful(learned, "stablehlo")
    act = function(learned)
    act.__name__ = name
    with precision(learned.config):
        shape = jax.ShapeDtypeStruct((len(learned.observation),), learned.dtype)
        return bytes(jax_export.export(jax.jit(act), platforms=PLATFORMS)(shape).serialize())


def run(path: Path, observations: np.ndarray) -> np.ndarray:
    """What the file at `path` does for observations [N, O]: controls [N, U]."""
    with jax.enable_x64(observations.dtype == np.float64):
        act = jax.jit(jax_export.deserialize(bytearray(path.read_bytes())).call)
        return np.stack([np.asarray(act(x)) for x in observations])
