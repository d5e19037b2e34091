"""A controller as StableHLO in the container of jax.export, of any policy: JAX runs it without this package."""

from pathlib import Path

import jax
import numpy as np
from jax import export as jax_export

from pegasus_jax.exports.learned import Learned, controlling, driven
from pegasus_jax.runs.restore import precision

PLATFORMS = ("cpu", "cuda")


def write(learned: Learned, name: str) -> bytes:
    """The function of an observation [O], its weights inside; of one that remembers, of its memory [M] too."""
    act, sizes = controlling(learned), (len(learned.observation), len(learned.remembered))

    def alone(observation: jax.Array) -> jax.Array:
        return act(observation, observation[:0])[0]

    function = act if learned.remembered else alone
    function.__name__ = name
    with precision(learned.config):
        shapes = [jax.ShapeDtypeStruct((size,), learned.dtype) for size in sizes if size]
        return bytes(jax_export.export(jax.jit(function), platforms=PLATFORMS)(*shapes).serialize())


def run(path: Path, observations: np.ndarray, episode: int) -> np.ndarray:
    """What the file at `path` does for observations [N, O], of so many an episode: controls [N, U]."""
    with jax.enable_x64(observations.dtype == np.float64):
        exported = jax_export.deserialize(bytearray(path.read_bytes()))
        act = jax.jit(exported.call)
        if len(exported.in_avals) == 1:
            return np.stack([np.asarray(act(x)) for x in observations])
        return driven(act, observations, exported.in_avals[1].shape[0], episode)
