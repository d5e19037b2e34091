"""Whether a file is the policy: its controls beside the policy's own."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax import memory as recall
from pegasus_jax.checks import RunError
from pegasus_jax.exports.learned import Learned, controlling
from pegasus_jax.runs import store
from pegasus_jax.runs.restore import precision
from pegasus_jax.task import Task
from pegasus_jax.tasks import sensed, terms
from pegasus_jax.types import Array

OBSERVATIONS = 1000  # half of them stored, as far as there are so many
EPISODE = 20  # observations between two resets of a controller that remembers
ALLOWED = 1e-5  # of the control range, beside what the policy and the file round


class Parity(NamedTuple):
    """How far a file's controls are from the policy's, as fractions of the control range."""

    observations: int
    stored: int  # of these, from the run's episodes; the others are random
    largest_difference: float
    # From the policy to itself in double precision, with the same weights: what its own numbers cannot tell. 1e-7 for a
    # network; up to 1e-5 for radial basis functions in single precision, whose large weights cancel.
    rounding: float

    @property
    def allowed(self) -> float:
        """The most that `largest_difference` may be: both, the policy and the file, round."""
        return ALLOWED + 2 * self.rounding


def observations(run: Path, task: Task) -> tuple[np.ndarray, int]:
    """Observations [1000, O], the first of which were stored by the run, and how many.

    The others are uniform in the box of these states, widened by half its width on each side. Goals, references and
    times are not stored: they are uniform up to twice their unit.
    """
    draw = np.random.default_rng(0)
    episodes = [store.load_episode(run, trial) for trial in store.numbered(run / "episodes", ".npz")]
    seen = [np.asarray(episode.trajectory.x, float) for episode in episodes if episode is not None]
    start, std = np.asarray(task.start_mean, float), np.asarray(task.start_std, float)
    every = np.concatenate([*seen, [start - std, start + std]])
    # One that remembers is given them in their order.
    stored = (every[:-2] if task.memory.names else draw.permutation(every[:-2]))[: OBSERVATIONS // 2]
    low, high = every.min(0), every.max(0)
    margin = (high - low) / 2
    others = draw.uniform(low - margin, high + margin, (OBSERVATIONS - len(stored), len(low)))
    given = sensed.observation(np.concatenate([stored, others]), task)
    units = dict(zip(task.memory.shown, recall.units(task.memory), strict=True))
    sizes = np.array([units[name] for name in terms.asked_names(task)])
    return np.concatenate([given, sizes * draw.uniform(-2, 2, (len(given), len(sizes)))], 1), len(stored)


def compared(run: Callable[[np.ndarray, int], np.ndarray], learned: Learned, folder: Path) -> Parity:
    """What `run`, the file, makes of observations [N, O] of the run in `folder`, beside what the policy does.

    One that remembers is reset every `EPISODE` observations. Raises RunError where the difference is more than allowed.
    """
    task = learned.task
    given, stored = observations(folder, task)
    given = given.astype(learned.dtype)
    found, shape = run(given, EPISODE), (len(given), len(task.control_names))
    if found.shape != shape:
        raise RunError(f"the file returns controls {[*found.shape]}, the policy {[*shape]}; it was not kept")
    with precision(learned.config):
        expected = controls_of(learned, given, found)
    with jax.enable_x64(True):
        exact = controls_of(learned, given.astype(np.float64), found.astype(np.float64))
    span = np.asarray(task.control_high) - np.asarray(task.control_low)
    difference = np.abs(found.astype(float) - expected) / span
    rounding = np.abs(expected - exact) / span
    parity = Parity(len(given), stored, float(difference.max()), float(rounding.max()))
    if not parity.largest_difference <= parity.allowed:  # NaN is none
        worst = given[int(np.argmax(np.where(np.isnan(difference), np.inf, difference).max(-1)))]
        raise RunError(
            f"the file's controls differ from the policy's by {parity.largest_difference:.2g} of the control range, at"
            f" {worst.tolist()}; at most {parity.allowed:.2g} is allowed, and it was not kept"
        )
    return parity


def controls_of(learned: Learned, given: np.ndarray, sent: np.ndarray) -> np.ndarray:
    """The controls [N, U] of a policy for observations [N, O], each after those that were `sent` [N, U] before.

    A policy that sees its past controls is given those that the file sent: else rounding errors would add up.
    """
    act = controlling(learned)

    def episode(observations: Array, sent: Array) -> Array:
        def step(kept: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
            u, kept = act(row[0], kept, row[1])
            return kept, u

        begun = jnp.zeros(len(learned.remembered), observations.dtype)
        return jax.lax.scan(step, begun, (observations, sent))[1]

    rows = [values.reshape(-1, EPISODE, values.shape[-1]) for values in (given, sent)]
    return np.asarray(jax.jit(jax.vmap(episode))(*rows)).reshape(sent.shape)
