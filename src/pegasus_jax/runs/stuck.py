"""What a person is told of a policy that does nothing but push at its limits: so it stays without help."""

from collections.abc import Sequence
from typing import Any

AT_LIMITS = 0.95  # of the controls of an episode
FAILED = 0.5  # an episode that costs more on average: where full controls are right, as in a race, the cost is small
AS_BAD = 0.8  # what was imagined of it cost at least this fraction of what happened


def stuck(before: Sequence[dict[str, Any]], now: Sequence[dict[str, Any]]) -> list[str]:
    """A line where the one seed's policy was at its limits in two trials, whose rows these are, and failed in both.

    With the likely cause: `now` ran the policy that `before` ended with, so what that trial imagined can be compared.
    Of several seeds nothing is said: who studies them has their curves.
    """
    if len(before) != 1 or len(now) != 1:
        return []
    first, second = before[0], now[0]
    if any(row["random"] or row["saturated"] < AT_LIMITS or row["episode_cost"] < FAILED for row in (first, second)):
        return []
    imagined, cost = first["objective_fresh"], second["episode_cost"]
    if imagined is None or imagined >= AS_BAD * cost:
        why = (
            "the search finds nothing better: the cost may be flat where the plant is, so let it fall from farther away"
            " (docs/robot.md), or the limits may be too narrow for the task"
        )
    else:
        why = (
            f"imagined was {imagined:.2f}: the model is wrong there, and these episodes teach it; go on for some trials"
        )
    trials = f"trials {first['trial']} and {second['trial']}"
    return [f"note: the controls of {trials} were at their limits, and the episodes failed (cost {cost:.2f}); {why}"]
