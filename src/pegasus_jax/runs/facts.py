"""The facts of a task as JSON values: all of it but its plant, its cost and other code.

They lie in a run's folder, so that whoever looks at the run needs neither a robot nor the files of its user.
"""

from __future__ import annotations

import inspect
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from pegasus_jax.checks import RunError
from pegasus_jax.math.units import rate_of

if TYPE_CHECKING:
    from pegasus_jax.task import Task

TEXTS = ("state_names", "control_names")
ENTRIES = ("angles", "rates")  # of the state
STATE = ("start_mean", "start_std", "sensor_std")  # one number a state
CONTROL = ("control_low", "control_high")  # one number a control
NUMBERS = ("dt", "success", "stop_cost")


def of_task(task: Task) -> dict[str, Any]:
    """The facts of a task; of one made of an MJCF file also the SHA-256 of its compiled model."""
    from pegasus_jax.tasks import mjcf_digest

    digest = mjcf_digest(task)
    return {
        "name": task.name,
        "horizon": int(task.horizon),
        **{name: list(getattr(task, name)) for name in TEXTS},
        **{name: [int(entry) for entry in getattr(task, name)] for name in ENTRIES},
        **{name: np.asarray(getattr(task, name), float).tolist() for name in (*STATE, *CONTROL)},
        **{name: float(getattr(task, name)) for name in NUMBERS},
        **({"circles": [list(pair) for pair in task.circles]} if task.circles else {}),
        **asked(task),
        **({"constraint_bound": float(task.constraint.bound)} if task.constraint else {}),
        **({} if digest is None else {"mjcf_digest": digest}),
    }


def asked(task: Task) -> dict[str, Any]:
    """What a cost takes beside the state: names, a reference as its values along an episode, the sizes of goals."""
    import jax
    import jax.numpy as jnp

    from pegasus_jax.tasks.signals import times
    from pegasus_jax.tasks.terms import terms_of

    terms = terms_of(task.cost.of_state) if task.terms is None else task.terms
    if not terms:
        return {}
    told: dict[str, Any] = {"terms": list(terms)}
    if task.reference is not None:
        told["reference"] = np.asarray(jax.vmap(task.reference.value)(jnp.asarray(times(task))), float).tolist()
    if task.goal is not None:
        told["goal"] = list(task.goal.units)
    return told


def to_task(found: Any, where: str) -> Task:
    """The task of such facts, without a plant; its cost raises RunError. So do facts that are none; `where` is said."""
    try:
        states, controls = len(found["state_names"]), len(found["control_names"])
        known = {
            "name": _text(found["name"]),
            "horizon": _whole(found["horizon"], 1, 10**9),
            **{name: tuple(map(_text, found[name])) for name in TEXTS},
            **{name: tuple(_whole(entry, 0, states - 1) for entry in found[name]) for name in ENTRIES},
            **{name: _numbers(found[name], states) for name in STATE},
            **{name: _numbers(found[name], controls) for name in CONTROL},
            **{name: float(_numbers([found[name]], 1)[0]) for name in NUMBERS},
            "circles": tuple(_pair(pair, states + len(found["circles"])) for pair in found.get("circles", ())),
        }
        bound = _numbers([found["constraint_bound"]], 1)[0] if "constraint_bound" in found else None
    except (KeyError, TypeError, ValueError) as error:
        raise RunError(f"{where} is damaged: its task has no usable {str(error) or 'facts'}") from error
    from pegasus_jax.imagine.limits import Constraint
    from pegasus_jax.task import Task
    from pegasus_jax.types import Cost

    if bound is not None:
        known["constraint"] = Constraint(unknown_cost, bound)
    task = Task(plant=None, cost=Cost(unknown_cost, unknown_cost), **known)
    return _asking(task, found, where) if "terms" in found else task


def _asking(task: Task, found: Any, where: str) -> Task:
    """The task of the facts that `asked` has written; its goals are all 0."""
    import jax.numpy as jnp

    from pegasus_jax.task import Signal
    from pegasus_jax.tasks.signals import of_times, table, times
    from pegasus_jax.tasks.terms import TERMS
    from pegasus_jax.types import Cost

    try:
        terms = [_text(term) for term in found["terms"]]
        if not {*terms} <= {*TERMS}:
            raise TypeError("terms")
        if "reference" in found:
            along = times(task)
            rows = np.array([_numbers(row, len(found["reference"][0])) for row in found["reference"]])
            task = task._replace(reference=of_times(table(along, rows[: len(along)]), along))
        if "goal" in found:
            units = tuple(_numbers(found["goal"], len(found["goal"])).tolist())
            task = task._replace(goal=Signal(lambda key: jnp.zeros(len(units)), units))
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise RunError(f"{where} is damaged: its task has no usable {str(error) or 'facts'}") from error

    def unknown(*_: Any, **__: Any) -> Any:
        unknown_cost()

    words = [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in ("x", *terms)]
    unknown.__signature__ = inspect.Signature(words)  # type: ignore[attr-defined]
    return task._replace(cost=Cost(unknown))


def unknown_cost(*_: Any) -> Any:
    """Raises RunError: what was read from a folder has no cost."""
    raise RunError("the cost of this task is code of its user, which was not imported; pegasus-eval imports it")


def difference(stored: dict[str, Any], made: dict[str, Any], pairs: bool) -> str | None:
    """In what two tasks differ, in words, or None. A model that was only renamed is the same one.

    `pairs` says whether the run's model looks at which rate is of which coordinate.
    """
    moved = {"name"} if "mjcf_digest" in stored and stored["mjcf_digest"] == made.get("mjcf_digest") else set()
    for name in sorted({*stored, *made} - moved, key=lambda name: name != "mjcf_digest"):
        one, other = stored.get(name), made.get(name)
        # An earlier version kept rates without their coordinates, or in another order.
        unused = name == "rates" and not pairs
        if not unused and not _same(one, other):
            return f"its {name} was {_short(one)} and now is {_short(other)}"
    return None


def of_today(found: Any) -> Any:
    """The facts of a task with today's names: of an earlier version the rate of "x [m]" was one "of x [m]"."""
    names = found.get("state_names") if isinstance(found, dict) else None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return found
    before = {f"rate of {name}": rate_of(name) for name in names}
    return found | {"state_names": [before.get(name, name) for name in names]}


def _same(one: Any, other: Any) -> bool:
    """Equal, or numbers that differ by rounding."""
    if one == other or not all(isinstance(value, float | list) for value in (one, other)):
        return one == other
    both = [np.asarray(value) for value in (one, other)]
    return all(a.dtype.kind in "fi" for a in both) and both[0].shape == both[1].shape and np.allclose(*both, rtol=1e-6)


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) < 60 else f"{text[:16]}..."


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError("texts")
    return value


def _whole(value: Any, low: int, high: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise TypeError("whole numbers")
    return value


def _pair(value: Any, observed: int) -> tuple[int, ...]:
    if len(value) != 2:
        raise TypeError("circles")
    return tuple(_whole(entry, 0, observed - 1) for entry in value)


def _numbers(values: Any, count: int) -> np.ndarray:
    if len(values) != count or not all(type(v) in (int, float) and math.isfinite(v) for v in values):
        raise TypeError("numbers")
    return np.array(values, float)
