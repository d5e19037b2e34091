"""What a cost takes beside the state, by the names of its parameters, and the memory that holds it.

A cost of the state x_{t+1} gets the control u_t that led to it, the one before, the time of x_{t+1}, the reference at
that time, and the episode's goal. In a task all of them are functions of x' (memory.py).
"""

import inspect
from collections.abc import Callable
from functools import wraps
from typing import Any

import jax.numpy as jnp
import numpy as np

from pegasus_jax import memory as recall
from pegasus_jax.checks import ConfigError, did_you_mean, shown
from pegasus_jax.imagine.costs import blind_to_memory
from pegasus_jax.task import Task
from pegasus_jax.tasks import user_code
from pegasus_jax.tasks.signals import AHEAD, draws
from pegasus_jax.types import Array, Cost, Memory

TERMS = ("u", "previous_u", "t", "reference", "goal")
CLOCK = "t [s]"
SETTINGS = {"reference": "reference=file.csv", "goal": "goal_low= and goal_high="}


def terms_of(cost: Callable[..., Any]) -> tuple[str, ...]:
    """Which of TERMS a cost takes after its first parameter, the state. Raises ConfigError for another name.

    A parameter with a default and another name is its owner's, and so is one that `functools.partial` has bound.
    """
    try:
        parameters = [*inspect.signature(cost).parameters.values()][1:]
    except (TypeError, ValueError):  # what is written in C tells nothing
        return ()
    single = [p for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    for p in single:
        if p.name not in TERMS and p.default is p.empty:
            place = f" ({place})" if (place := user_code.definition(cost)) else ""
            raise ConfigError(
                f"cost={shown(inspect.unwrap(cost))} takes {p.name}, which nothing gives it;"
                f" {did_you_mean(p.name, TERMS)}{place}"
            )
    bound = {p.name for p in single if p.kind == p.KEYWORD_ONLY and p.default is not p.empty}
    return tuple(p.name for p in single if p.name in TERMS and p.name not in bound)


def agree(cost: Callable[..., Any], reference: Any, goal: Any) -> tuple[str, ...]:
    """`terms_of`. Raises ConfigError also where the cost takes a reference or a goal that is None, or leaves it out."""
    terms, name = terms_of(cost), shown(inspect.unwrap(cost))
    for term, there in (("reference", reference), ("goal", goal)):
        if term in terms and there is None:
            raise ConfigError(f"cost={name} takes a {term}, and there is none; give {SETTINGS[term]}")
        if there is not None and term not in terms:
            raise ConfigError(f"the {term} is of no use: cost={name} has no parameter {term}")
    return terms


def augmented(task: Task, cost: Cost | None = None) -> Task:
    """The task whose cost (or `cost`), `stop` and constraint are functions of the augmented state x' [D + M].

    Its memory gets what they take. A task that is augmented already stays as it is. Raises ConfigError for a cost that
    takes what the task does not have, or leaves out what it has.
    """
    if cost is None and task.terms is not None:
        return task
    given, states = cost or task.cost, len(task.state_names)
    terms = agree(given.of_state, task.reference, task.goal)
    if terms and given.expected is not None:
        raise ConfigError(f"a cost that takes {terms[0]} has its expectation by nodes; leave its expected out")
    known = {*task.memory.names}
    memory = recall.combined(task.memory, *(new for new in memories(task, terms) if not {*new.names} <= known))
    task = task._replace(terms=terms, memory=memory)
    if not memory.names:
        return task._replace(cost=given)
    stop, limits = task.stop, task.constraint
    return task._replace(
        constraint=None if limits is None else limits._replace(of_state=lambda x: limits.of_state(x[:states])),
        cost=of_terms(task, given.of_state) if terms else blind_to_memory(given, states),
        stop=None if stop is None else wraps(stop)(lambda x: stop(x[:states])),
    )


def of_terms(task: Task, function: Callable[..., Array]) -> Cost:
    """The cost of x' that a function of x and of the task's terms is."""
    states, places = len(task.state_names), {name: i for i, name in enumerate(task.memory.names)}

    def entries(names: tuple[str, ...]) -> np.ndarray:
        return np.array([states + places[name] for name in names], int)

    def time(x: Array) -> Array:
        return x[states + places[CLOCK]]

    reads: dict[str, Callable[[Array], Array]] = {
        "u": lambda x: x[entries(past(task, 1))],
        "previous_u": lambda x: x[entries(past(task, 2))],
        "t": time,
        "reference": lambda x: task.reference.value(time(x)),  # type: ignore[union-attr]
        "goal": lambda x: x[entries(goal_names(task))],
    }

    @wraps(function)
    def of_state(x: Array) -> Array:
        return function(x[:states], **{term: reads[term](x) for term in task.terms or ()})

    return Cost(of_state)


def alone(task: Task) -> Callable[[Array], Array]:
    """The cost of a task that is not augmented yet, as a function of x [D] alone: all that it takes beside x is 0."""
    controls, cost = jnp.zeros(len(task.control_names)), task.cost.of_state
    rest = {"u": controls, "previous_u": controls, "t": jnp.zeros(())}
    for name, signal in (("reference", task.reference), ("goal", task.goal)):
        rest[name] = jnp.zeros(0 if signal is None else len(signal.units))
    terms = agree(cost, task.reference, task.goal)
    return lambda x: cost(x, **{term: rest[term] for term in terms})


def past(task: Task, before: int) -> tuple[str, ...]:
    """The names in a memory of the controls of so many periods ago."""
    return tuple(f"{name} {before} before" for name in task.control_names)


def goal_names(task: Task) -> tuple[str, ...]:
    """The names in a memory of an episode's goal."""
    return () if task.goal is None else tuple(f"goal {i}" for i in range(len(task.goal.units)))


def reference_names(task: Task, ahead: int) -> tuple[str, ...]:
    """The names of a reference so many periods from now, among what a memory shows."""
    later = f" in {ahead * task.dt:g} s" if ahead else ""
    return () if task.reference is None else tuple(f"reference {i}{later}" for i in range(len(task.reference.units)))


def asked_names(task: Task) -> tuple[str, ...]:
    """What a policy sees of its memory that somebody sets: the time, a reference, a goal, in their order there."""
    references = [name for ahead in AHEAD for name in reference_names(task, ahead)]
    return tuple(name for name in task.memory.shown if name in (CLOCK, *references, *goal_names(task)))


def memories(task: Task, terms: tuple[str, ...]) -> list[Memory]:
    """What has to be remembered for these terms, and what of it the policy sees: all that it can act upon."""
    found = []
    if "u" in terms or "previous_u" in terms:
        found.append(controls(task, 2 if "previous_u" in terms else 1))
    if "t" in terms or "reference" in terms:
        found.append(clock(task, "t" in terms))
    if "goal" in terms and task.goal is not None:
        names, units = goal_names(task), task.goal.units
        found.append(recall.constant(names, task.goal.value)._replace(shown_units=units))
    return found


def controls(task: Task, count: int) -> Memory:
    """The newest `count` controls, which the policy does not see; before an episode they were 0, or what is nearest."""
    return recall.past_controls(task.control_names, recall.resting(task), count, shown=False)


def clock(task: Task, timed: bool) -> Memory:
    """The time, which the policy sees if the cost is `timed`, and the reference of now and soon after.

    The same in every episode, so that particles are matched as they are without it.
    """
    begun, signal = recall.clock(task.dt), task.reference
    shown, units = ([CLOCK], [task.horizon * task.dt]) if timed else ([], [])
    if signal is not None:
        shown += [name for ahead in AHEAD for name in reference_names(task, ahead)]
        units += signal.units * len(AHEAD)

    def show(m: Array, o: Array) -> Array:
        soon = [] if signal is None else [signal.value(m[0] + ahead * task.dt) for ahead in AHEAD]
        return jnp.concatenate([m if timed else m[:0], *soon]).astype(o.dtype)

    return begun._replace(shown=tuple(shown), show=show, shown_units=tuple(units), matched=True)


def box(task: Task) -> np.ndarray:
    """Mean, standard deviation, least and greatest value [4, M] of what a task remembers, as far as a cost takes it."""
    low, high = np.asarray(task.control_low, float), np.asarray(task.control_high, float)
    known = {CLOCK: (0.0, task.horizon * task.dt)}
    for before in range(1, len(task.memory.names) + 1):
        known |= dict(zip(past(task, before), zip(low, high, strict=True), strict=True))
    if task.goal is not None:
        seen = draws(task.goal.value)
        known |= dict(zip(goal_names(task), zip(seen.min(0), seen.max(0), strict=True), strict=True))
    ends = np.array([known.get(name, (-np.inf, np.inf)) for name in task.memory.names], float).reshape(-1, 2)
    bounded = np.isfinite(ends).all(1, keepdims=True)
    finite = np.where(bounded, ends, [-2.0, 2.0])  # else a mean of 0 and a deviation of 1
    return np.stack([finite.sum(1) / 2, np.ptp(finite, 1) / 4, *ends.T])
