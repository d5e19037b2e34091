"""What a controller remembers of sensors that are late, or measure no rates, and what is known afterwards."""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from pegasus_jax.checks import ConfigError, shown
from pegasus_jax.config import Config
from pegasus_jax.math.angles import difference, encode
from pegasus_jax.math.units import rate_of
from pegasus_jax.memory import combined, coordinates, past_controls, resting
from pegasus_jax.task import Task
from pegasus_jax.types import Array, Hindsight, Memory

WINDOW, ORDER = 5, 3  # rows of the local polynomial that tells rates afterwards, and its degree


def remembering(config: Config, task: Task) -> Task:
    """The task with what its controller remembers, and its states as they are known afterwards, by the settings.

    What it remembers already, as the task of an experiment does, it remembers once.
    """
    task = task._replace(control_rate=limited_by(config, task))
    kept, memories, known = kept_by(config, task), list[Memory](), {*task.memory.names}
    if kept.controls:
        memories.append(history(task, rows=1 + kept.rows, delay=config.sensors.delay, controls=kept.controls))
    if kept.rates:
        memories.append(velocities(task, kept.weight))
        task = task._replace(hindsight=Hindsight(partial(smoothed, task=task), 1))
    new = (memory for memory in memories if not {*memory.names} <= known)
    return task._replace(memory=combined(task.memory, *new))


class Kept(NamedTuple):
    """What a controller keeps of an episode."""

    controls: int  # the last ones
    rows: int  # the last observations before the newest
    rates: bool  # are computed
    weight: float  # of the newest difference in them


def kept_by(config: Config, task: Task) -> Kept:
    """What the controller keeps by the settings: every control whose effect the observations do not tell yet."""
    sensors, rows = config.sensors, config.history - 1
    rates, weight = sensors.velocity != "none", 1.0
    if sensors.velocity == "filter":  # a low-pass of first order
        weight = float(1 - np.exp(-2 * np.pi * (sensors.cutoff or 0.2 / task.dt) * task.dt))
    # A difference is the rate half a period ago: what has acted since then, one more control tells.
    controls = max(sensors.delay + rows + rates, int(task.control_rate is not None))
    return Kept(controls, rows, rates, weight)


def limited_by(config: Config, task: Task) -> np.ndarray | None:
    """The largest rate of change [U] of each control by the settings. Raises ConfigError for another number of them."""
    rates, names = config.control_rate, task.control_names
    if not rates:
        return task.control_rate
    if len(rates) not in (1, len(names)):
        raise ConfigError(
            f"control_rate={shown(rates)} must be one number for all, or {len(names)}, of {', '.join(names)}"
        )
    return np.broadcast_to(np.array(rates), (len(names),))


def history(task: Task, *, rows: int, delay: int, controls: int) -> Memory:
    """The last `rows` observations and controls, of which the newest acts `delay` periods after it was given.

    The policy sees the observations before the newest, and the last `controls`. The model is given the control that
    acts now, those of the rows before, and these rows' observations, angles as sines and cosines.
    """
    size, states, past_rows = len(task.control_names), len(task.state_names), rows - 1
    past = past_controls(task.control_names, resting(task), controls, shown=True)
    kept = len(past.names)
    times = range(1, rows)
    names = tuple(f"{name} {i} before" for i in times for name in task.state_names)
    turning = tuple(states * i + a for i in range(past_rows) for a in task.angles)

    def given(m: Array, u: Array) -> Array:
        controls = jnp.concatenate([u, m[:kept]])[size * delay : size * (delay + rows)]
        return jnp.concatenate([controls, encode(m[kept:], turning)]) if past_rows else controls

    def advance(m: Array, o: Array, u: Array) -> Array:
        return jnp.concatenate([past.advance(m[:kept], o, u), *([o, m[kept:]] if past_rows else [])])[: len(m)]

    return Memory(
        names=(*past.names, *names),
        start=lambda key, o: jnp.concatenate([past.start(key, o), jnp.tile(o, past_rows)]),
        advance=advance,
        shown=(*past.names, *names),
        show=lambda m, o: m,
        shown_angles=tuple(kept + i for i in turning),
        applied=given,
    )


def velocities(task: Task, weight: float) -> Memory:
    """Rates of the task's coordinates, as a robot computes them: differences, of which the filter takes in `weight`.

    With weight 1 they are the differences themselves; with less, v + weight (difference - v), a low-pass of first
    order. The policy sees the coordinates and these rates, never rates that an observation has.
    """
    measured = tuple(coordinates(task))
    positions, n = np.array(measured), len(measured)
    turning = tuple(place for place, i in enumerate(measured) if i in task.angles)
    names = tuple(task.state_names[i] for i in measured)
    rates = tuple(map(rate_of, names))

    def filtered(m: Array, o: Array) -> Array:
        now = difference(o[positions], m[:n], turning) / task.dt
        return now if weight == 1 else m[n:] + weight * (now - m[n:])

    def advance(m: Array, o: Array, u: Array) -> Array:
        return jnp.concatenate([o[positions], *([filtered(m, o)] if weight < 1 else [])])

    return Memory(
        names=(*(f"{name} 1 before" for name in names), *(f"filtered {rate}" for rate in rates * (weight < 1))),
        start=lambda key, o: jnp.concatenate([o[positions], jnp.zeros(n * (weight < 1), o.dtype)]),
        advance=advance,
        shown=tuple(f"measured {rate}" for rate in rates),
        show=filtered,
        measured=measured,
    )


def smoothed(rows: Array, last: Array | int, controls: Array, *, task: Task) -> tuple[Array, Array]:
    """The states [H+1, D] of an episode whose observations [H+1, D] tell positions, up to row `last`.

    Rates are those of polynomials through the positions around each row, Savitzky and Golay's, after the fact: a filter
    that runs on the robot knows only the rows before. Positions are as measured. The second value [H, 1] is 1 in the
    row that begins the episode, and 0: a fit filters along the rows behind it (`models.innovations`).
    """
    positions = np.array(coordinates(task))
    turning = tuple(place for place, i in enumerate(positions) if i in task.angles)
    weights = polynomials(task.dt)
    rows = jnp.asarray(rows)
    steps = difference(rows[1:, positions], rows[:-1, positions], turning)
    q = jnp.concatenate([jnp.zeros_like(steps[:1]), jnp.cumsum(steps, 0)])  # no turn is lost at 180 degrees
    times = jnp.arange(len(rows))
    first = jnp.clip(times - WINDOW // 2, 0, jnp.maximum(last - WINDOW + 1, 0))
    around, place = first[:, None] + jnp.arange(WINDOW), jnp.clip(times - first, 0, WINDOW - 1)
    # Of an episode shorter than a window the rows beyond its end go on as its last ones did: the plant did not stop.
    beyond = jnp.maximum(around - last, 0)[..., None] * (q[last] - q[jnp.maximum(last - 1, 0)])
    windows = q[jnp.minimum(around, last)] + beyond
    rates = jnp.einsum("tw,twn->tn", jnp.asarray(weights, q.dtype)[place], windows)
    begins = (times[:-1, None] == 0).astype(q.dtype)
    return rows.at[:, np.array(task.rates)].set(rates), begins


def polynomials(dt: float) -> np.ndarray:
    """For each place in a window of rows [WINDOW]: the weights of all its rows' positions in the rate there."""
    from scipy.signal import savgol_coeffs  # slow to import

    every = range(WINDOW)
    return np.stack([savgol_coeffs(WINDOW, ORDER, deriv=1, delta=dt, pos=place, use="dot") for place in every])
