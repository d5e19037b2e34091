"""Settings that say what a task is, where there is a task beside them: it counts, and they may not say otherwise."""

from typing import Any

from jax.core import Tracer

from pegasus_jax.checks import ConfigError, shown
from pegasus_jax.config import Config
from pegasus_jax.task import Task


def agree(config: Config, task: Task) -> None:
    """Raises ConfigError for a setting that says what the task is, where the task is otherwise."""
    for setting, value in {"data": config.data, "init": config.init}.items():
        if value:
            raise ConfigError(
                f"the Config has {setting}={shown(value)}, and compose reads no files: leave it out of the Config;"
                " train(config) begins with it, load_logs reads logs"
            )
    for setting, field in otherwise(config, task):
        alone = setting in ("sensors.measured", "sensors.velocity")  # of these the plant, starts and cost are, too
        raise ConfigError(
            f"the Config has {setting}=, and the task {task.name} has {field}={shown(getattr(task, field))}, which is"
            f" what counts: leave it out of the Config; {'' if alone else f'task._replace({field}=...) changes it, '}"
            "tasks.of_config(config) makes a task"
        )


def otherwise(config: Config, task: Task) -> list[tuple[str, str]]:
    """(setting, field of the task) wherever the config says one thing and the task is another."""
    sensors, states = config.sensors, len(task.state_names)
    measured, computed = len(sensors.measured), sensors.velocity != "none"

    def lacks(value: Any, field: str) -> bool:
        return value is not None and getattr(task, field) is None

    def differs(name: str) -> bool:
        its = getattr(task, name)
        return not isinstance(its, Tracer) and getattr(config, name) not in (getattr(Config, name), its)

    # An angle has the names of its cosine and its sine; of what is measured, circles and rates may be left out.
    named = any(name in str(task.state_names) for name in config.state_names)
    facts: list[tuple[str, str, Any]] = [
        *((name, name, lacks(getattr(config, name), name)) for name in ("stop", "constraint", "prior", "reference")),
        ("starts", "starts", lacks(config.starts or None, "starts")),
        ("goals", "goal", lacks(config.goals or config.goal_low or None, "goal")),
        ("explore.policy", "guide", lacks(config.explore.policy, "guide")),
        *((name, name, differs(name)) for name in ("horizon", "dt", "success", "stop_cost")),
        ("circles", "circles", config.circles and not (task.circles or measured)),
        ("rates", "rates", config.rates and not (task.rates or measured)),
        ("state_names", "state_names", config.state_names and not named),
        ("control_names", "control_names", config.control_names not in ((), tuple(task.control_names))),
        (
            "sensors.measured",
            "state_names",
            measured and states != (measured - len(task.circles)) * (1 + computed),
        ),
        ("sensors.velocity", "rates", computed and 2 * len(task.rates) != states),
        ("sensors.delay", "late", task.plant is not None and sensors.delay not in (0, task.late)),
    ]
    return [(setting, field) for setting, field, wrong in facts if wrong]
