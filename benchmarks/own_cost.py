"""A learning study whose search knows the task's cost as one of a user's: neither its expectation nor its width.

    python -m benchmarks.own_cost NAME seeds=0-49 task=cartpole model=log_normal trials=15

Words and file as in benchmarks.study; `search.cost_estimator=particles` follows the cost of each particle.
"""

from functools import partial
from typing import Any

from benchmarks import command, study
from pegasus_jax import tasks
from pegasus_jax.types import Cost

POSED = tasks.of_plant


def of_plant(name: str, plant: Any) -> Any:
    """The task that a plant poses to someone who knows its cost only as a function."""
    task = POSED(name, plant)
    return task._replace(cost=Cost(task.cost.of_state))


if __name__ == "__main__":
    tasks.of_plant = of_plant
    command(partial(study.main, module="benchmarks.own_cost"), __doc__)
