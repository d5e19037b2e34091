"""Which policy of a run is the best, and by which of its episodes, as the rows of trials.jsonl tell."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pegasus_jax.runs.store import cost_since


def best_trial(rows: list[dict[str, Any]], last_episode: dict[str, Any] | None = None, first: int = 1) -> int:
    """The trial after which the best policy was learned, judged by the rows of trials.jsonl, of which there is one.

    Where every policy was evaluated, that with the highest success rate, and of these with the lowest mean cost. Else
    by its own episodes on the plant: that of which most succeeded, of these the one that broke a constraint least
    often, and of these the one with the lowest mean cost; `last_episode` is one more than there are rows. A policy that
    never ran is chosen only where none ran: the last one. Among equals it is the latest. With `first` 0 one that was
    learned before the first episode is among them. Costs are compared with costs of the same function only: the newest.
    """
    since = cost_since(rows[-1])
    known = [row for row in rows if cost_since(row) == since]
    if all(row["mean_cost"] is not None and row["success_rate"] is not None for row in known):
        return max(known, key=lambda row: (row["success_rate"], -row["mean_cost"], row["trial"]))["trial"]
    ran = [*known, *([last_episode | {"cost_since": since}] if last_episode else [])]
    own = {p: [*map(_verdict, judging(ran, p))] for p in {row["policy"] for row in ran} if p >= first}
    return min((p for p in own if own[p]), key=lambda p: (*np.mean(own[p], 0), -p), default=rows[-1]["trial"])


def _verdict(row: dict[str, Any]) -> tuple[float, float, float]:
    """How an episode went, the less the better: failed, broke the constraint, cost."""
    return 1.0 - row["episode_success"], float(row.get("constraint_broken", False)), row["episode_cost"]


def judging(rows: Sequence[dict[str, Any]], policy: int) -> list[dict[str, Any]]:
    """The rows whose episodes tell how good a policy is, 0 that of before the first trial.

    None that a fault or a person cut short, and none whose cost is of another function than the newest.
    """
    from pegasus_jax.episode import CUT  # slow to import

    since = cost_since(rows[-1])
    ran = (row for row in rows if row.get("policy") == policy and (policy or ran_first(row)))
    told = (row for row in ran if row["episode_cost"] is not None and row.get("ended") not in CUT)
    return [row for row in told if cost_since(row) == since]


def ran_first(row: dict[str, Any]) -> bool:
    """Whether a row's episode was of the policy that there was before the first trial: logs are of none."""
    return row["policy"] == 0 and not row["random"] and "logs" not in row
