"""Which table the settings of a search and the starts of a task ask for."""

from collections.abc import Callable

import jax
import numpy as np

from pegasus_jax import config as settings
from pegasus_jax.checks import ConfigError
from pegasus_jax.imagine import costs
from pegasus_jax.learn.schedule import SearchTable, search_table
from pegasus_jax.learn.widening import SEEN, holding
from pegasus_jax.memory import begin, join
from pegasus_jax.task import Task
from pegasus_jax.tasks.starts import examples
from pegasus_jax.types import Array, Key

STARTS = 256  # at which the cost is looked at
LEAST_REST = 1e-7  # of 1 - cost: less is rounding in single precision
ROUNDS, SHORTEST_ROUND = 4, 50  # of a refinement, at most, and its iterations, at least: docs/decisions.md 0032


def table_of(search: settings.Search, width: float) -> SearchTable:
    """What the configured search does, visit by visit, where the cost begins `width` times as wide."""
    first = round((1 - search.refine_fraction) * search.steps)
    most = ROUNDS if search.num_starts == 1 else 1  # of policies side by side none ends before the others
    table = search_table(
        search.steps,
        init=init_of(search),
        refine=rounds_from(first, search.steps, most) if search.refine_fraction else None,
        cost_width_start=width,
        decay=search.decay,
        anneal_trials=search.anneal_trials,
        warm_restart=search.warm_restart,
        warm_limit_factor=search.warm_limit_factor,
    )
    return holding(table) if search.cost_width_start is None else table


def init_of(search: settings.Search) -> str:
    """What a search starts from: of policies side by side, others are fresh."""
    return "previous" if search.num_starts > 1 else search.init


def rounds_from(refine: int, steps: int, most: int) -> list[int]:
    """The iterations with which the rounds of a refinement begin: at most so many, as long as each other, not short."""
    rounds = max(1, min(most, (steps - refine) // SHORTEST_ROUND))
    return [refine + (steps - refine) * number // rounds for number in range(rounds)]


def width_of(search: settings.Search, begun: Callable[[], np.ndarray]) -> float:
    """The factor of the cost's width with which a search begins: as configured, or what the costs `begun` [N] ask for.

    They are asked for only where they decide.
    """
    return width_for(begun()) if search.cost_width_start is None else search.cost_width_start


def at_starts(task: Task) -> np.ndarray:
    """The costs [256] of states with which episodes start."""

    def first(x: Array, key: Key) -> Array:
        return costs.of(task.cost, join(x, begin(task.memory, key, x)))

    def all_of(x: Array) -> Array:
        return jax.vmap(first)(x, jax.random.split(jax.random.key(0), STARTS))

    # One program, where operation by operation would be twenty; it may be wanted while another one is traced.
    x = examples(task, STARTS)
    program = jax.jit(all_of).trace(x)
    if len(program.jaxpr.jaxpr.invars) > 1:  # beside the states
        raise ConfigError(
            "the cost depends on a number that jit, vmap or grad traces, and search.cost_width_start=null looks at what"
            " it is where episodes start; search.cost_width_start=1 does not"
        )
    return np.asarray(program.lower().compile()(x))


def scale_for(found: np.ndarray) -> float:
    """The largest of the costs `found` [N] where episodes start, if that is above 1, where a cost should end."""
    return max(1.0, float(np.max(found)))


def width_for(found: np.ndarray) -> float:
    """The factor by which a cost is to be `widened` that is `found` [N] in [0, 1] where episodes start.

    With it their mean is at most `SEEN`, so that a search sees a slope towards the goal; 1 where that is so already.
    """
    rest = np.clip(1 - np.mean(found, dtype=np.float64), LEAST_REST, 1)
    return max(1.0, float(np.sqrt(np.log(rest) / np.log(1 - SEEN))))
