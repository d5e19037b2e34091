"""The native return of each policy of a run: the environment's own reward, time limit, starts and end.

    python -m benchmarks.plants_suite.native RUN ENV [EPISODES]

prints one JSON row for each trial: the returns and the lengths of 10 to EPISODES episodes (50), whose resets have fixed
seeds. The best return may depend on the start: that of dm_control's pendulum is 790 from ten of its starts, 846 from
all of them.
"""

import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from benchmarks import command, number
from pegasus_jax import controller
from pegasus_jax.checks import ConfigError
from pegasus_jax.runs import checkpoint, config_io, store

FIRST_RESET, STEPS = 10_000, 10_000  # STEPS: after which there are enough episodes
MOST = 50


def returns(control: Any, env: Any, least: int = 10, most: int = MOST) -> tuple[list[float], list[int]]:
    """The return and the length of each episode of `control`, observation -> control."""
    totals, lengths = list[float](), list[int]()
    while len(totals) < least or (len(totals) < most and sum(lengths) < STEPS):
        x, _ = env.reset(seed=FIRST_RESET + len(totals))
        total, length, over = 0.0, 0, False
        while not over:
            x, reward, terminated, truncated, _ = env.step(control(x).astype(env.action_space.dtype))
            total, length, over = total + float(reward), length + 1, terminated or truncated
        totals.append(round(total, 3))
        lengths.append(length)
    return totals, lengths


def scores(run: Path, name: str, most: int = MOST) -> list[dict[str, Any]]:
    """One row for each trial that has a policy and a row of its own."""
    env, rows, judged = gymnasium.make(name), [], dict[int, tuple[list[float], list[int]]]()
    seen = list(config_io.load(run / "config.yaml").sensors.measured) or slice(None)
    for row in store.trials(run):
        if row["trial"] not in checkpoint.available(run):
            continue
        learned = row.get("policy_next") or row["trial"]  # after which trial: a policy may go on, or come back
        if learned not in judged:
            control = controller(run, trial=row["trial"])
            judged[learned] = returns(lambda x, control=control: control(x[seen]), env, most=most)
        totals, lengths = judged[learned]
        told = {key: row[key] for key in ("trial", "plant_seconds", "policy", "episode_cost", "objective_fresh")}
        rows.append(told | {"native": round(float(np.mean(totals)), 3), "returns": totals, "lengths": lengths})
    return rows


def main(words: list[str]) -> None:
    """The command line of this module. Raises ConfigError for what it cannot use."""
    if len(words) not in (2, 3):
        raise ConfigError(f"name a run and an environment, and at most how many episodes, not {len(words)} words")
    most = number(dict(zip(["episodes"], words[2:], strict=False)), "episodes", MOST)
    print(json.dumps(scores(Path(words[0]), words[1], most)))


if __name__ == "__main__":
    command(main, __doc__)
