"""Whether a user's cost can be learned from: what is wrong with it is said in one line, before anything moves."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from pegasus_jax.checks import ConfigError
from pegasus_jax.math.circles import Circles, to_observation
from pegasus_jax.task import Task
from pegasus_jax.tasks.terms import box
from pegasus_jax.tasks.user_code import blamed, definition, place_of

UNBOUNDED = 1e6  # limits of an observation beyond this are none
AROUND = 100  # random points
FLAT = 1e-3  # a cost that changes by less than this leads nowhere
NEAR = 1e-3  # of an entry's scale: as near to a point as tells whether the cost is continuous there


class Facts(NamedTuple):
    """What is known of a task's state [D] when its cost is checked."""

    start_mean: np.ndarray  # [D]
    start_std: np.ndarray  # [D]
    angles: tuple[int, ...]
    low: np.ndarray  # [D] least values, -inf where not known
    high: np.ndarray  # [D]
    seen: np.ndarray  # [N, D] states, maybe none
    success: float = 0.2
    circles: Circles = ()  # of the observation that the user's cost gets
    remembered: tuple[str, ...] = ()  # names of the last entries, which are of x' and not of x


def beside(facts: Facts, task: Task) -> Facts:
    """The facts of x' [D + M], from those of x and what is known of the task's memory."""
    names = task.memory.names
    if not names:
        return facts
    mean, std, low, high = box(task)
    return facts._replace(
        start_mean=np.concatenate([facts.start_mean, mean]),
        start_std=np.concatenate([facts.start_std, std]),
        low=np.concatenate([facts.low, low]),
        high=np.concatenate([facts.high, high]),
        seen=np.zeros((0, len(facts.start_mean) + len(names))),
        remembered=names,
    )


def notes(
    cost: Callable[[Any], Any], facts: Facts, what: str, seen: Callable[[], Callable[[Any], Any]] | None = None
) -> list[str]:
    """What its owner should know of a cost. Raises ConfigError, beginning with `what`, if it cannot be learned from.

    It is traced once, and evaluated with its gradient at the start, at zero and at 100 points around them. Where it is
    flat, `seen` () makes the cost that a search begins with, wider, which may not be flat.
    """
    size = len(facts.start_mean)
    traced(cost, size, size - len(facts.remembered) + len(facts.circles), what)
    points, values, slopes = _evaluated(cost, facts, what)
    least, most = int(np.argmin(values)), int(np.argmax(values))
    if values[least] < -1e-5 * max(1, np.abs(values).max()):
        raise ConfigError(
            f"{what} is {values[least]:.3g}, negative, at {_text(points[least], facts)}{_at(cost)}; is it a reward?"
            " A cost is 0 at the goal and grows away from it, to 1"
        )
    if not slopes.any():
        raise ConfigError(
            f"{what} has a gradient of 0 at each of {len(points)} points{_at(cost)}, so a search has nothing to follow;"
            " for example 1 - jnp.exp(-d**2 / 2), where d is the distance from the goal"
        )
    found = []
    if values[most] > 1 + 1e-3:
        found.append(
            f"{what} is {values[most]:.4g} at {_text(points[most], facts)}, more than 1: success then means an episode"
            f" whose last five steps cost less than success={facts.success:g} on average; 1 - jnp.exp(-cost) is below 1"
        )
    flat = (change := np.ptp(_around(cost, facts))) < FLAT < values[0]
    if flat and (seen is None or np.ptp(_around(seen(), facts)) < FLAT):
        found.append(
            f"{what} is {values[0]:.3g} where episodes start and changes by {change:.1g} around there: a search finds"
            " nothing to follow; let it fall from the start to the goal, as a wider exp does"
        )
    return found


def _around(cost: Callable[[Any], Any], facts: Facts) -> np.ndarray:
    """The cost [AROUND] within the size of each entry around the start: angles within a quarter of a turn."""
    size = scales(facts)
    size[list(facts.angles)] = np.pi / 2
    away = np.random.default_rng(2).uniform(-1, 1, (AROUND, len(size)))
    points = np.asarray(facts.start_mean) + size * away
    return np.asarray(jax.vmap(lambda x: jnp.asarray(cost(x), float))(jnp.asarray(points, float)), np.float64)


def _evaluated(cost: Callable[[Any], Any], facts: Facts, what: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(points [P, D], cost [P], gradient [P, D]). Raises ConfigError where one of a possible state is not finite."""
    points = probes(facts)
    both = jax.jit(jax.vmap(jax.value_and_grad(lambda x: jnp.asarray(cost(x), float))))
    with blamed(what, cost):
        values, slopes = (np.asarray(part, np.float64) for part in both(jnp.asarray(points, float)))
    possible = np.ones(len(points), bool)
    for i in np.flatnonzero(~np.isfinite(np.column_stack([values, slopes])).all(1)):
        if i < len(points) - AROUND and not _continuous(cost, points[i], facts, values):
            possible[i] = False  # arctan2(0, 0) of a cosine and a sine
        elif not np.isfinite(values[i]):
            raise ConfigError(
                f"{what} is {values[i]:g} at {_text(points[i], facts)}{_at(cost)}; expected a finite number"
            )
        else:
            slope = slopes[i][~np.isfinite(slopes[i])][0]
            raise ConfigError(
                f"{what} has a gradient that is {slope:g} at {_text(points[i], facts)}{_at(cost)}; a root or a norm has"
                " none at 0, jnp.sqrt(s + 1e-6) has"
            )
    return points[possible], values[possible], slopes[possible]


def probes(facts: Facts) -> np.ndarray:
    """Points [P, D] at which a cost is looked at: the start, zero and what is between, then 100 around them.

    Angles go around the full circle; others up to ten times what is known of their size, within the limits.
    """
    draws = np.random.default_rng(0)
    size, mean = len(facts.start_mean), np.asarray(facts.start_mean, float)
    low, high = (np.where(np.abs(limit) < UNBOUNDED, limit, np.nan) for limit in (facts.low, facts.high))
    at_zero = mean * (1 - np.eye(size))  # each entry of the start at 0, one after the other
    special = np.stack([mean, np.zeros(size), *at_zero[:32]])
    centres = np.repeat([mean, np.zeros(size)], AROUND // 2, axis=0)
    factors = np.resize([0.01, 0.1, 1.0, 10.0], (AROUND, 1))
    spread = centres + factors * scales(facts) * draws.normal(size=(AROUND, size))
    within = low + (high - low) * draws.uniform(size=(AROUND, size))
    spread = np.where(np.isfinite(within) & (factors >= 1), within, spread)
    angles = list(facts.angles)
    spread[:, angles] = draws.uniform(-np.pi, np.pi, (AROUND, len(angles)))
    return np.clip(np.concatenate([special, spread]), np.nan_to_num(low, nan=-np.inf), np.nan_to_num(high, nan=np.inf))


def scales(facts: Facts) -> np.ndarray:
    """The size [D] of each entry of the observation as far as it is known, 1 where nothing is."""
    known = np.abs(np.concatenate([[facts.start_mean, 3 * np.asarray(facts.start_std)], facts.seen])).max(0)
    return np.where(known > 0, known, 1.0)


def traced(cost: Callable[[Any], Any], size: int, observed: int, what: str) -> None:
    """Raises ConfigError unless JAX can trace the cost of x' [size] to one number, and it reads no entry beyond."""

    def one(x: Any) -> Any:
        value = cost(x)
        _number(value, cost, what)
        return jnp.asarray(value)

    within(one, (size,), observed, what, cost)


def within(
    function: Callable[..., Any],
    sizes: Sequence[int],
    observed: int,
    what: str,
    blame: Callable[..., Any] | None = None,
) -> None:
    """Raises ConfigError where a JAX function of vectors of these sizes reads an entry that is not there.

    `observed` is how many the user's x has; `blame` is the user's function, where it is another one.
    """
    with blamed(what, blame or function):
        program = jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct((n,), jnp.zeros(()).dtype) for n in sizes))
    for index, length, line in beyond(program):
        of_x = f"; x has {observed}, 0 to {observed - 1}, and rates behind them with sensors.velocity="
        raise ConfigError(
            f"{what} reads entry {index} of an array of {length}{_in(line)}{of_x if length >= observed else ''}"
        )


def _number(value: Any, cost: Callable[[Any], Any], what: str) -> None:
    """Raises ConfigError unless the value that a cost returned is one real number that can change gradually."""
    kind = None
    if value is None:
        kind = "nothing; its return is missing"
    elif not isinstance(value, jax.Array | np.ndarray | np.generic | bool | int | float | complex):
        kind = f"a {type(value).__name__}; expected one number"
    elif np.shape(value):
        kind = f"an array of shape {np.shape(value)}; expected one number, as jnp.sum makes of it"
    elif isinstance(value, float):
        kind = f"{value:g} whatever the state is; expected a number that falls towards the goal"
    elif jnp.iscomplexobj(value):
        kind = "a complex number; expected a real one"
    elif not jnp.issubdtype(jnp.result_type(value), jnp.floating):
        kind = "a whole number or true or false, whose gradient is 0; expected a number that falls towards the goal"
    if kind:
        raise ConfigError(f"{what} returns {kind}{_at(cost)}")


def beyond(traced: Any) -> list[tuple[int, int, str | None]]:
    """(index, length, file.py:line) of each read beyond an array's end, by an index that the inputs do not change.

    JAX does not refuse these: it takes the nearest entry, or NaN. Indices are followed through the program's integers.
    """
    consts = [None if isinstance(value, Tracer) else value for value in traced.consts]  # of a trace around this one
    with jax.ensure_compile_time_eval():
        return _walk(traced.jaxpr, consts, [None] * len(traced.jaxpr.invars))[0]


def _walk(jaxpr: Any, consts: Sequence[Any], given: Sequence[Any]) -> tuple[list[Any], list[Any]]:
    """(reads beyond the end, values of the outputs) of a program whose inputs have these values; None: not known."""
    known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *given], strict=True))
    found: list[Any] = []

    def value(atom: Any) -> Any:
        return atom.val if hasattr(atom, "val") else known.get(atom)

    for eqn in jaxpr.eqns:
        values = [value(atom) for atom in eqn.invars]
        inner = eqn.params.get("jaxpr") or eqn.params.get("call_jaxpr")
        outputs: list[Any] = [None] * len(eqn.outvars)
        if inner is not None and len(getattr(inner, "in_avals", ())) == len(values):
            more, outputs = _walk(inner.jaxpr, inner.consts, values)
            found += more
        elif all(v is not None for v in values) and all(_counts(out.aval) for out in eqn.outvars):
            made = eqn.primitive.bind(*values, **eqn.params)
            outputs = made if eqn.primitive.multiple_results else [made]
        found += [(*read, _line(eqn)) for read in _outside(eqn, values)]
        known |= dict(zip(eqn.outvars, outputs, strict=True))
    return found, [value(atom) for atom in jaxpr.outvars]


def _counts(aval: Any) -> bool:
    """Whether values of this type are integers or booleans, which indices are made of."""
    return jnp.issubdtype(aval.dtype, jnp.integer) or aval.dtype == bool


def _outside(eqn: Any, values: Sequence[Any]) -> list[tuple[int, int]]:
    """(index, length) of what one step of a program reads beyond the end of its array."""
    if eqn.primitive.name == "dynamic_slice":
        starts, dimensions = values[1:], range(len(values) - 1)
    elif eqn.primitive.name == "gather" and "CLIP" not in str(eqn.params["mode"]):
        dimensions = eqn.params["dimension_numbers"].start_index_map
        starts = [None if values[1] is None else np.asarray(values[1])[..., i] for i in range(len(dimensions))]
    else:
        return []
    found = []
    for start, dimension in zip(starts, dimensions, strict=True):
        length = eqn.invars[0].aval.shape[dimension]
        last = length - eqn.params["slice_sizes"][dimension]
        for index in [] if start is None else np.ravel(start):
            if not 0 <= index <= last:
                found.append((int(index) if index > last else int(index) - length, length))
    return found


def _line(eqn: Any) -> str | None:
    """`file.py:line` of the user's code that made this step of a program."""
    frames = getattr(eqn.source_info.traceback, "frames", ())
    return place_of([(frame.file_name, frame.line_num) for frame in reversed(frames)])


def _continuous(cost: Callable[[Any], Any], point: np.ndarray, facts: Facts, values: np.ndarray) -> bool:
    """Whether the cost goes to one value as x goes to the point: else it tells of a direction there, not of a state."""
    directions = np.random.default_rng(1).normal(size=(32, len(point)))
    near = point + NEAR * scales(facts) * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    found = np.asarray(jax.vmap(lambda x: jnp.asarray(cost(x), float))(jnp.asarray(near, float)), np.float64)
    known = values[np.isfinite(values)]
    span = np.ptp(known) if known.size else 0.0
    return not np.ptp(found) > 0.05 * span if np.isfinite(found).all() else True


def _at(cost: Callable[[Any], Any]) -> str:
    """Where the cost is defined, as the end of a sentence."""
    place = definition(cost)
    return f" ({place})" if place else ""


def _in(place: str | None) -> str:
    return f" at {place}" if place else ""


def _text(state: np.ndarray, facts: Facts) -> str:
    states = len(state) - len(facts.remembered)
    x = to_observation(state[:states], facts.circles)
    others = [f", {name}={v:.3g}" for name, v in zip(facts.remembered, state[states:], strict=True)]
    more = "".join(others[:4]) + (", ..." if len(others) > 4 else "")
    return f"x=[{', '.join(f'{v:.3g}' for v in x[:6])}{', ...' if len(x) > 6 else ''}]{more}"
