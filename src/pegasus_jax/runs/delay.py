"""pegasus-delay: how many periods pass from a control to what is observed of it. It moves the robot, a little."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pegasus_jax import tasks
from pegasus_jax.checks import SIZES, ConfigError, check_range, shown
from pegasus_jax.config import Config, Sensors
from pegasus_jax.episode import drive
from pegasus_jax.math.delays import MOST, Delay, delay_of, enough, rows_of
from pegasus_jax.memory import resting
from pegasus_jax.policies.rate_limited import largest_change
from pegasus_jax.runs.collect import failed
from pegasus_jax.task import Task
from pegasus_jax.tasks.remembered import limited_by

EPISODES = 20  # at most, that end too early to have a row
LONGER = 3  # times the periods that were asked for, at most, where episodes end early
# The probability from which on a delay is an answer. A single reading in N rows never gives more than 1 - 1 / sqrt(N).
SURE = 0.9
# Two encoders of a flexible shaft, 60 seeds of 200 periods: by .1 five were sure of a wrong delay, by .2 none.
AMPLITUDE = 0.2
ALL = SIZES["periods"]  # at most


class Plan(NamedTuple):
    """What will be sent to an environment that has not moved yet."""

    config: Config
    task: Task
    asked: np.ndarray  # [2, U] the controls below and above rest that an amplitude means within the range
    sent: np.ndarray  # [2, U] those that the limit on their rate of change leaves of them
    amplitude: float  # as a fraction of half the range
    periods: int
    most: int  # periods of delay that are looked for


class Measured(NamedTuple):
    """A delay that was measured on an environment."""

    plan: Plan
    delay: Delay


def planned(config: Config, amplitude: float = AMPLITUDE, periods: int = 200, most: int = MOST) -> Plan:
    """What a config's environment will be driven by, for so many control periods; nothing moves, no cost is needed.

    Each control is, in each period by a new draw, one of two values: `amplitude` of half the control range above or
    below rest, which is 0 or the limit next to it, and within the range. Where the controls' rate of change is limited,
    both are drawn in towards rest until one may follow the other; whole numbers are rounded. Raises ConfigError for
    what cannot be.
    """
    check_range("amplitude", amplitude, 0, 1, open_low=True)
    check_range("most", most, 1, 100)
    task = _of_environment(config)
    check_range("periods", periods, most + enough(len(task.control_names), most), ALL)
    check_range("horizon", task.horizon, most + 1)
    whole = np.issubdtype(tasks.environment(config).action_space.dtype, np.integer)
    asked, sent = controls_of(task, amplitude, whole)
    for i in np.flatnonzero(np.ptp(sent, axis=0) == 0)[:1]:
        moving = [a / 20 for a in range(1, 21) if np.ptp(controls_of(task, a / 20, whole)[1], axis=0).all()]
        raise ConfigError(
            f"amplitude={amplitude:g} is too small for whole numbers: {task.control_names[i]} of {sent[0, i]:g} only; "
            + (f"type amplitude={moving[0]:g}" if moving else "no amplitude up to 1 is enough")
        )
    return Plan(config, task, asked, sent, amplitude, periods, most)


def controls_of(task: Task, amplitude: float, whole: bool) -> tuple[np.ndarray, np.ndarray]:
    """`asked` and `sent` [2, U] of a plan; of whole numbers as an environment rounds them."""
    low, high, rest = np.asarray(task.control_low), np.asarray(task.control_high), resting(task)
    asked = np.clip(rest + np.outer([-1, 1], amplitude * (high - low) / 2), low, high)
    allowed = largest_change(task) / np.ptp(asked, axis=0)
    # What is less than rounding is no limit.
    sent = np.where(allowed < 1 - 1e-6, rest + np.minimum(allowed, 1.0) * (asked - rest), asked)
    return (np.rint(asked) + 0.0, np.rint(sent) + 0.0) if whole else (asked, sent)  # and no -0


def measure(plan: Plan) -> Measured:
    """The delay of a plan's environment, which is driven, and then closed.

    An episode ends with a period of rest. Where episodes end early others follow until there are enough rows, for at
    most LONGER times the periods. Raises ConfigError for too few rows even so, and RunError where the environment
    fails.
    """
    config, task, most = plan.config, plan.task, plan.most
    rest, size = resting(task), len(task.control_names)
    # Of another stream than an environment's noise, which has the same seed: the controls must not depend on it.
    draw, episodes = np.random.default_rng([config.seed, 1]), []
    try:
        while horizon := _to_come(plan, lengths := [len(u) for _, u in episodes]):
            above = draw.choice([False, True], (horizon, size))
            controls = np.concatenate([np.where(above, plan.sent[1], plan.sent[0]), rest[None]])
            ran = drive(config.seed + len(episodes), lambda t, x, u=controls: u[t], task._replace(horizon=horizon + 1))
            failed(ran, task, kept=False)
            episodes.append((np.asarray(ran.trajectory.x), np.asarray(ran.trajectory.u)))
    finally:
        tasks.close(task)
    if rows_of(lengths, most) < enough(size, most):
        raise ConfigError(_too_few(plan, lengths))
    return Measured(plan, delay_of(episodes, config.angles, most))


def _to_come(plan: Plan, lengths: Sequence[int]) -> int:
    """The periods of the episode after those of these lengths; 0 after the last one."""
    driven, most = sum(lengths), plan.most
    missing = enough(len(plan.task.control_names), most) - rows_of(lengths, most)
    left = max(plan.periods - driven, most + max(missing, 0))
    # As many as `most` have no row of their own; and where what is allowed cannot be enough, nothing moves.
    useless = left <= most or left > LONGER * plan.periods - driven
    return 0 if useless or sum(n <= most + 1 for n in lengths) >= EPISODES else min(plan.task.horizon, left)


def _too_few(plan: Plan, lengths: Sequence[int]) -> str:
    """Why episodes of these lengths tell no delay, and what would."""
    size, most = len(plan.task.control_names), plan.most
    # The greatest that would have been enough in these episodes.
    nearest = next((m for m in range(most - 1, 0, -1) if rows_of(lengths, m) >= enough(size, m)), None)
    return (
        f"{plan.task.name}: its {len(lengths)} episodes end too early, the longest after {max(lengths)} periods:"
        f" {rows_of(lengths, most)} of their periods have {most} before them, and {enough(size, most)} are needed; type"
        f" {'' if nearest is None else f'most={nearest}, or '}amplitude={plan.amplitude / 2:g} for longer ones"
    )


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


def announced(plan: Plan) -> str:
    """The controls that will be sent, in one line; in a second one what a limit on their rate of change takes away."""
    task, (low, high), moves = plan.task, plan.sent, np.ptp(plan.asked, axis=0)
    values = ", ".join(
        f"{name} of {a:.4g} or {b:.4g}" for name, a, b in zip(task.control_names, low, high, strict=True)
    )
    lines = [
        f"{task.name}: sends {values}, a new draw in each of {plan.periods} periods of {task.dt:g} s, up to"
        f" {LONGER * plan.periods} if episodes end early"
    ]
    if faster := _faster(plan):
        less = ", ".join(
            f"{name} change by {allowed:.4g} a period, not {move:.4g}"
            for name, allowed, move in zip(task.control_names, high - low, moves, strict=True)
            if allowed < move
        )
        lines.append(
            f"note: {_rate(task.control_rate)} lets {less}, which amplitude={plan.amplitude:g} asks for; type {faster},"
            " or leave it out"
        )
    return "\n".join(lines)


def _faster(plan: Plan) -> str:
    """The word with which controls may change as much as the amplitude asks for; none where they do."""
    if np.array_equal(plan.sent, plan.asked) or plan.task.control_rate is None:
        return ""
    return _rate(np.maximum(plan.task.control_rate, np.ptp(plan.asked, axis=0) / plan.task.dt))


def _rate(rates: np.ndarray) -> str:
    """The word of these rates of change [U], of three digits, rounded up; of one number where all have the same."""
    step = 10.0 ** (np.floor(np.log10(rates)) - 2)
    # What is less than rounding must not make an 80.1 of 80.
    values = [float(rate) for rate in step * np.ceil(rates / step - 1e-6)]
    return f"control_rate={shown(values[0] if len({*values}) == 1 else values)}"


def told(measured: Measured) -> str:
    """What was measured, in one line, and the word to give; or, where that is not sure, the words to try next."""
    task, delay, chances = measured.plan.task, measured.delay, measured.delay.probabilities
    echoes = ", ".join(task.state_names[i] for i in delay.echoes)
    note = f"; not looked at, because it repeats a control: {echoes}" if echoes else ""
    outcomes = [*(f"{count} {'period' if count == 1 else 'periods'}" for count in range(len(chances) - 1)), "no change"]
    best, *others = [int(i) for i in np.argsort(-chances, kind="stable")]
    also = "".join(f", {outcomes[i]} with {chances[i]:.2f}" for i in others if chances[i] >= 0.01)
    if chances[best] < SURE:
        found = (
            f"the delay is not sure yet: {outcomes[best]} with probability {chances[best]:.2f}{also}"
            f" ({delay.rows} periods){_more(measured.plan)}"
        )
    elif delay.periods is None:
        found = f"no change follows from the controls in {delay.rows} periods{_more(measured.plan)}"
    else:
        sure = f"probability {chances[best]:.2f}{also}; {delay.rows} periods"
        give = f"give sensors.delay={best}" if best else "no sensors.delay= is needed"
        found = f"delay {outcomes[best]}, {best * task.dt:g} s ({sure}); {give}"
    return f"{task.name}: {found}{note}"


def _more(plan: Plan) -> str:
    """The words that tell more: periods, which are gentler on a robot, and as many as larger controls are worth."""
    stronger = _faster(plan) or (f"amplitude={min(1.0, 2 * plan.amplitude):g}" if plan.amplitude < 1 else "")
    longer = f"periods={min(4 * plan.periods, ALL)}" if plan.periods < ALL else ""
    words = ", and if that is not enough ".join(word for word in (longer, stronger) if word)
    return f"; type {words}" if words else ""
