"""Notes on runs that may need a person's help: a control at its limit, early ends that imagined episodes lack."""

from collections.abc import Sequence
from typing import Any

from pegasus_jax.task import Task

AT_LIMITS = 0.95  # of the periods of an episode
FAILED = 0.5  # an episode that costs more on average: where full controls are right, as in a race, the cost is small
AS_BAD = 0.8  # what was imagined of it cost at least this fraction of what happened


def stuck(before: Sequence[dict[str, Any]], now: Sequence[dict[str, Any]]) -> list[str]:
    """A line where a control stayed at a limit in two trials of one seed, whose rows these are, and both failed.

    With the likely cause: `now` ran the policy that `before` ended with, so what that trial imagined can be compared.
    Of several seeds nothing is said: who studies them has their curves.
    """
    if len(before) != 1 or len(now) != 1:
        return []
    first, second = before[0], now[0]
    each = [row.get("saturated_controls") or {"": row["saturated"]} for row in (first, second)]
    pushing = [name for name in each[1] if min(shares.get(name) or 0.0 for shares in each) >= AT_LIMITS]
    if not pushing or any(row["random"] or row["episode_cost"] < FAILED for row in (first, second)):
        return []
    imagined, cost = first["objective_fresh"], second["episode_cost"]
    if imagined is None or imagined >= AS_BAD * cost:
        why = (
            "the search has found nothing better; go on for some trials. If it stays so, the cost may be flat where the"
            " plant is, so let it fall from farther away (docs/robot.md), the limits may be too narrow for the task, or"
            " another seed= gets around it"
        )
    else:
        why = (
            f"imagined was {imagined:.2f}: the model is wrong there, and these episodes teach it; go on for some trials"
        )
    trials = f"trials {first['trial']} and {second['trial']}"
    who = "the controls" if len(pushing) == len(each[1]) else ", ".join(pushing)
    return [f"note: {who} stayed at a limit in {trials}, and the episodes failed (cost {cost:.2f}); {why}"]


def unforeseen(now: Sequence[dict[str, Any]], task: Task) -> list[str]:
    """A line where the plant ended the one seed's episode early, and imagined episodes go on: no `stop` was given."""
    ended = [row for row in now if row.get("ended") == "terminated"]
    if len(now) != 1 or not ended or task.stop is not None or ended[0]["steps"] >= task.horizon:
        return []
    when = f"the episode of trial {ended[0]['trial']} was over after {ended[0]['steps']} of {task.horizon} periods"
    return [f"note: {when}; imagined ones do not end there, unless stop=module:function says where (docs/simulator.md)"]
