"""What a policy search does, written down before it begins: a table in NumPy, one row a visit of the objective."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from pegasus_jax.checks import check_range, choice
from pegasus_jax.config import INITS
from pegasus_jax.math.decay import half_cosine

EVALUATE, STEP = range(2)  # what a row does with the candidate whose cost and gradient it computes
CURRENT, FRESH, OTHER, LEADER, START, COARSE = range(6)  # which parameters it visits: see `SearchTable.candidate`
RACED = 0.25  # of the iterations before the refinement, for each policy of a race: docs/decisions.md 0041
REFINED = 0.03  # the step size at the end of a round of refinement, as a fraction of the search's
JUDGED = 0.25  # the last part of a round, in which the steps are small, whose objectives say what it has gained


class SearchTable(NamedTuple):
    """R rows, those of a search of N iterations in the order of their visits, and their factors in T searches.

    The factors of a search are those of its number, from 0; the last serve every later one. NumPy's arrays or JAX's.
    """

    iteration: Any  # [R] the iteration that the row belongs to, 0..N-1: N iterations can be cut anywhere
    scenarios: Any  # [R] the iteration whose scenarios it is under: after the last step of a phase, the next one
    action: Any  # [R] STEP goes on from the candidate, along its gradient; EVALUATE compares costs
    # [R] CURRENT: the search's own policy. A row that evaluates another one may put it in the place of CURRENT, which
    # the row before has evaluated. FRESH, an untrained policy: if it costs no more, and always where the last search
    # gained nothing or the given policy works. OTHER and LEADER, the second policy of a race and the first as it was
    # (learn/race.py): LEADER if it costs less, or CURRENT's cost is NaN. START, what the search was given, and COARSE,
    # what the refinement started from: if they cost no more, or a cost is NaN.
    candidate: Any
    refine: Any  # [R] whether the objective is the refining one
    counts: Any  # [R] whether a step's objective counts in the mean of its round of refinement
    ends: Any  # [R] whether a round of refinement ends with the row: the search is over if it has gained nothing
    holds: Any  # [R] whether a step's cost is held wider where it is too flat: learn/widening.py
    cost_width: Any  # [T, R] factor of the cost's width
    step_size: Any  # [T, R] factor of the optimizer's update
    limit: Any  # [T, R] factor of the limit on a particle's gradient


def search_table(
    steps: int,
    *,
    init: str = "previous",
    refine: int | Sequence[int] | None = None,
    cost_width_start: float = 1.0,
    decay: float = 1.0,
    anneal_trials: int = 1,
    warm_restart: float = 0.0,
    warm_limit_factor: float = 1.0,
) -> SearchTable:
    """The table of searches of `steps` iterations each.

    init: what a search starts from: the `previous` policy, a `fresh` one, the `better` of both, or of both after a race
    of RACED of the iterations before `refine` each (`raced`; the `better` where that is none).
    refine: the iteration from which it refines the better of what it found and what it was given, or those with which
    rounds of that begin, each of which may be the last (learn/rounds.py); None: never.
    cost_width_start: the cost's width at the start; it falls to 1, geometrically, by half of the coarse iterations.
    decay: the step size at the end of the coarse iterations, which falls from 1 as half a cosine.
    anneal_trials: searches over which width and step size fall once.
    warm_restart, warm_limit_factor: after those each search's step size falls from `warm_restart` to `decay` of it,
    under `warm_limit_factor` times the limit; with warm_restart=0 both stay as they are.

    Raises ConfigError for another `init`, and for a `refine` that is not from 0 to `steps`.
    """
    choice("init", init, INITS)
    bounds = [] if refine is None else sorted({*np.atleast_1d(refine).tolist(), steps})
    for begins in bounds:
        check_range("refine", begins, 0, steps)
    race = int(RACED * bounds[0]) if bounds and init == "raced" else 0  # iterations of each policy of a race
    compares = init == "better" or (init == "raced" and not race)
    rows = [(0, 0, EVALUATE, CURRENT), (0, 0, EVALUATE, FRESH)] if compares else []
    for i in range(steps):
        begins = OTHER if race and i == race else FRESH if i == 0 and (race or init == "fresh") else CURRENT
        rows += [(i, i, STEP, begins)]
        if race and i + 1 == 2 * race:
            rows += [(i, i + 1, EVALUATE, CURRENT), (i, i + 1, EVALUATE, LEADER)]
        if i + 1 in bounds:
            given = START if i + 1 == bounds[0] else COARSE
            rows += [(i, i + 1, EVALUATE, CURRENT), (i, i + 1, EVALUATE, given)]
    iteration, scenarios, action, candidate = np.array(rows, np.int32).reshape(-1, 4).T
    number = np.arange(anneal_trials + 1 if anneal_trials > 1 else 1)[:, None]
    i = number * steps + scenarios - race * (iteration >= race)  # [T, R] over all searches; one policy of a race counts
    coarse = (bounds[0] if bounds else anneal_trials * steps) - race
    width = cost_width_start ** np.maximum(0, 1 - i / (coarse / 2)) if coarse else np.ones(i.shape)
    refines = scenarios >= (bounds[0] if bounds else steps + 1)
    passed = np.interp(scenarios, bounds or [0], range(len(bounds) or 1)) % 1  # [R] of a round
    annealed = (number < anneal_trials) | (warm_restart == 0)
    step_size = np.where(refines, half_cosine(passed, REFINED), half_cosine(i / max(coarse, 1), decay))
    step_size = np.where(annealed, step_size, warm_restart * half_cosine(scenarios / max(steps, 1), decay))
    limit = np.where(annealed, np.ones(i.shape), warm_limit_factor)
    counts, ends = refines & (action == STEP) & (passed >= 1 - JUDGED), (candidate == COARSE) & (action == EVALUATE)
    flags = refines, counts, ends, np.zeros(len(rows), bool)
    return SearchTable(iteration, scenarios, action, candidate, *flags, width, step_size, limit)
