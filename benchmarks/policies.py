"""Is the policy that a run calls its best as good as every other of its policies?

    python -m benchmarks.policies NAME RUN [RUN ...] [episodes=20]

Runs the policy after each trial of each run for 20 episodes that are not data, all from the same starts. Writes
benchmarks/results/policies-NAME.json and prints, a run a line, how many episodes of each trial's policy succeeded, and
which one `trial=best` is.
"""

import json
import shlex
import sys
from pathlib import Path
from typing import Any

from benchmarks.study import RESULTS
from pegasus_jax.runs import checkpoint, config_io, store
from pegasus_jax.runs.evaluation import evaluate_run
from pegasus_jax.runs.machine import about
from pegasus_jax.runs.programs import share_processors
from pegasus_jax.runs.restore import best


def policies(run: Path, episodes: int) -> dict[str, Any]:
    """Success rate and mean cost of the policy after each trial of a run, by trial."""
    found = {trial: evaluate_run(run, episodes, 0, trial) for trial in sorted(checkpoint.available(run))}
    rows = store.trials(run)
    return {
        "run": run.name,
        "best": best(run),
        "trials": list(found),
        "success_rate": [row["success_rate"] for row in found.values()],
        "mean_cost": [round(row["mean_cost"], 4) for row in found.values()],
        "rows": [{k: row[k] for k in ("policy", "episode_cost", "ended", "steps", "objective_fresh")} for row in rows],
        "incumbent": [row["objective_incumbent"] for row in rows],
        "replaced": [row["replaced"] for row in rows],
    }


def line(found: dict[str, Any]) -> str:
    """A run in one line."""
    rates = " ".join(f"{rate:4.0%}" for rate in found["success_rate"])
    costs = " ".join(f"{cost:.2f}" for cost in found["mean_cost"])
    return f"{found['run']:>20}  best {found['best']:>2}  {rates}  | {costs}"


def main(words: list[str]) -> None:
    """The command line of this module."""
    options, _ = config_io.split([word for word in words if "=" in word], ("episodes",))
    name, *runs = [word for word in words if "=" not in word]
    share_processors(1)
    results = []
    for run in map(Path, runs):
        results.append(policies(run, int(options.get("episodes", "20"))))
        print(line(results[-1]), flush=True)
        made = about(shlex.join(["python", "-m", "benchmarks.policies", *words]))
        (RESULTS / f"policies-{name}.json").write_text(json.dumps({"runs": results, "about": made}, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
