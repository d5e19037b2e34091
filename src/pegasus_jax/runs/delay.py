"""pegasus-delay: how many periods pass from a control to what is observed of it. It moves the robot, a little."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pegasus_jax import tasks
from pegasus_jax.checks import ConfigError, check_range
from pegasus_jax.config import Config, Sensors
from pegasus_jax.episode import drive
from pegasus_jax.math.delays import MOST, Delay, delay_of, enough
from pegasus_jax.memory import resting
from pegasus_jax.policies.rate_limited import largest_change
from pegasus_jax.runs.collect import failed
from pegasus_jax.task import Task
from pegasus_jax.tasks.remembered import limited_by

EPISODES = 20  # at most, of an environment whose episodes end early


class Measured(NamedTuple):
    """A delay that was measured on an environment."""

    task: Task
    delay: Delay
    amplitude: float  # of the controls, as a fraction of half their range


def measure(config: Config, amplitude: float = 0.1, periods: int = 200, most: int = MOST) -> Measured:
    """The delay of a config's environment, which is driven by random controls for so many periods, and then closed.

    Each control is, in each period by a new draw, one of two values: `amplitude` of half the control range above or
    below rest, which is 0 or the limit next to it. An episode ends with a period of rest. No cost is needed. Raises
    ConfigError for what cannot be, before anything moves, and RunError where the environment fails.
    """
    check_range("amplitude", amplitude, 0, 1, open_low=True)
    check_range("most", most, 1, 100)
    task = _of_environment(config)
    check_range("periods", periods, most + enough(len(task.control_names), most), 10**6)
    low, high = np.asarray(task.control_low), np.asarray(task.control_high)
    rest = resting(task)
    # From one value to the other is twice this.
    size = np.minimum(amplitude * (high - low) / 2, largest_change(task) / 2)
    draw, episodes = np.random.default_rng(config.seed), []
    try:
        while (left := periods - sum(len(u) for _, u in episodes)) > 0 and len(episodes) < EPISODES:
            horizon = min(task.horizon, left)
            signs = draw.choice([-1.0, 1.0], (horizon, len(low)))
            controls = np.concatenate([np.clip(rest + size * signs, low, high), rest[None]])
            ran = drive(config.seed + len(episodes), lambda t, x, u=controls: u[t], task._replace(horizon=horizon + 1))
            failed(ran, task, kept=False)
            episodes.append((np.asarray(ran.trajectory.x), np.asarray(ran.trajectory.u)))
    finally:
        tasks.close(task)
    try:
        return Measured(task, delay_of(episodes, config.angles, most), amplitude)
    except ValueError as error:
        raise ConfigError(f"periods={periods} in {len(episodes)} episodes of {task.name}: {error}") from error


def _of_environment(config: Config) -> Task:
    """The task of a config's environment, that nothing resets yet and no cost is asked of."""
    if config.env is None:
        raise ConfigError("pegasus-delay drives an environment; for example env=robot:Arm-v0")
    still = (0.0,) * tasks.environment(config).observation_space.shape[0]  # where episodes start is of no interest
    bare = replace(config, goals=None, goal_low=(), goal_high=(), reference=None, sensors=Sensors(), history=1)
    task = tasks.of_config(replace(bare, cost=_nothing, stop=None, circles=(), start_mean=still, starts=()))
    return task._replace(control_rate=limited_by(config, task))


def _nothing(x: object) -> float:
    return 0.0


def told(measured: Measured) -> str:
    """What was measured, in one line, and the word to give."""
    task, delay, amplitude = measured
    name = f"{task.name}: "
    echoes = ", ".join(task.state_names[i] for i in delay.echoes)
    note = f"; not looked at, because it repeats a control: {echoes}" if echoes else ""
    if delay.periods is None:
        return (
            f"{name}no change follows from the controls in {delay.rows} periods; the nearest is"
            f" amplitude={min(1.0, 2 * amplitude):g}{note}"
        )
    count, chance = delay.periods, delay.probabilities
    others = [f"{d} with {chance[d]:.2f}" for d in np.argsort(-chance[:-1]) if d != count and chance[d] >= 0.01]
    sure = f"probability {chance[count]:.2f}{''.join(f', {other}' for other in others)}; {delay.rows} periods"
    return (
        f"{name}delay {count} {'period' if count == 1 else 'periods'}, {count * task.dt:g} s ({sure});"
        f" {f'give sensors.delay={count}' if count else 'no sensors.delay= is needed'}{note}"
    )
