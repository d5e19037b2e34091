"""pegasus-check: what a task is like, and what would go wrong, before anything moves; pegasus-train asks it first."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from pegasus_jax import tasks
from pegasus_jax.assembly.experiments import build, set_precision
from pegasus_jax.assembly.schedules import at_starts, width_of
from pegasus_jax.checks import ConfigError, shown, some
from pegasus_jax.config import Config, Search, first_search, uses
from pegasus_jax.imagine import costs
from pegasus_jax.logs.read import Logged
from pegasus_jax.math.circles import entries
from pegasus_jax.math.units import parted
from pegasus_jax.memory import seen_names
from pegasus_jax.policies.rate_limited import largest_change
from pegasus_jax.runs import begin, first
from pegasus_jax.runs.logged import read_config
from pegasus_jax.task import Task
from pegasus_jax.tasks import assumed, constrained, cost_check, guide, signals, user_code

RESETS = 20  # of an environment that may be reset without need
LONG = 600  # [s] of an episode from which on its period may be in other units
EXACT = 1e-4  # of an entry's spread: what is left of it is rounding


def checked(asked: Config, config: Config, mesh: Mesh | None = None) -> tuple[Task, list[Logged], list[str]]:
    """The task of a new run's config, its logs, and what to say of them, one line each; `asked` is not resolved yet.

    Raises ConfigError, in one line, for whatever cannot be learned: all that is known before the first episode.
    """
    task = build(first.loaded(config), mesh).task
    resets = 1 if asked.start_mean else RESETS  # who says where episodes start has nobody reset a robot
    logs, read = read_config(config, task)
    said = begin.checked(config, task) + first.checked(config, task) + unsaid(asked, config, task)
    return task, logs, said + before_training(config, task, resets) + read


def before_training(config: Config, task: Task, resets: int = 1) -> list[str]:
    """Notes on a task of the user's, one line each; opens its environment and resets it so many times.

    Raises ConfigError, in one line, for a cost that cannot be learned from and readings that cannot be right. The cost
    is looked at first: a mistake in it moves no robot.
    """
    guide.check(config, task)
    rates = [*unlearned(config), *slow(task), *filtering(config, task), *lasting(task)]
    if config.cost is None and task.constraint is None:
        return rates
    low, high = tasks.observation_limits(config, task)
    facts = cost_check.Facts(
        np.asarray(task.start_mean, float),
        np.asarray(task.start_std, float),
        task.angles,
        low,
        high,
        np.zeros((0, len(task.state_names))),
        task.success,
        task.circles,
    )
    limits = constrained.notes(task.constraint, facts, f"constraint={shown(config.constraint)}")
    if config.cost is None:
        return [*rates, *limits]
    beside = cost_check.beside(facts, task)
    seen = lambda: costs.widened(task.cost, width(config, at_starts(task))).of_state  # noqa: E731
    notes = [*cost_check.notes(task.cost.of_state, beside, f"cost={shown(config.cost)}", seen), *limits]
    stopping(config, task)
    tasks.compared(config, task)
    readings = tasks.readings(config, task, resets)
    # A rate that is computed is 0 after a reset, and no sensor's.
    seen_at = [i for i in range(len(task.state_names)) if config.sensors.velocity == "none" or i not in task.rates]
    return [
        *rates,
        *notes,
        *turning(facts, task.state_names),
        *plausible(readings, facts, task.state_names),
        *alike(
            readings[:, seen_at],
            tuple(seen_at.index(i) for i in task.angles if i in seen_at),
            tuple(task.state_names[i] for i in seen_at),
        ),
    ]


def unlearned(config: Config) -> list[str]:
    """The note on a run that ends before a policy is searched for the first time: one line, or none."""
    random = config.explore.trials
    if first_search(config) <= config.trials:
        return []
    return [
        f"trials={config.trials} ends before the {random} random episodes of explore.trials={random} do: no policy will"
        f" be learned; give trials={random + 1} or more, or explore.trials={config.trials}"
    ]


def slow(task: Task) -> list[str]:
    """Notes on limits of how fast a control changes that never matter, or that leave an episode too short."""
    notes = []
    for name, change, low, high in zip(
        task.control_names, largest_change(task), task.control_low, task.control_high, strict=True
    ):
        way, rate = f"{name} from {low:g} to {high:g}", change / task.dt
        if np.isfinite(change) and change >= high - low:
            notes.append(f"control_rate={rate:g} lets {way} in one period: it limits nothing")
        elif (periods := (high - low) / change) > task.horizon:
            notes.append(f"control_rate={rate:g} lets {way} in {periods:.0f} periods; an episode has {task.horizon}")
    return notes


def filtering(config: Config, task: Task) -> list[str]:
    """The note on a filter of computed rates whose cutoff is above half of the control rate: one line, or none."""
    cutoff, most = config.sensors.cutoff, 0.5 / task.dt
    if cutoff is None or cutoff <= most:
        return []
    return [f"sensors.cutoff={cutoff:g} is above half of the control rate, {most:g} Hz: it hardly filters"]


def lasting(task: Task) -> list[str]:
    """The note on an episode that takes so long that its period may be in milliseconds: one line, or none."""
    if (seconds := task.horizon * task.dt) < LONG:
        return []
    return [f"an episode of {task.horizon} periods of {task.dt:g} s takes {seconds:g} s; is dt in seconds?"]


def unsaid(given: Config, known: Config, task: Task) -> list[str]:
    """Notes on what the user did not say of an environment, and what is taken for it; `known` is what is."""
    return (
        assumed.notes(given)
        + assumed.length(given, task)
        + assumed.rotations(given, task)
        + assumed.actuators(given, task)
        + assumed.goals(given, task)
        + circles_found(given, known)
        + assumed.networks(given.model, len(task.state_names))
    )


def circles_found(given: Config, known: Config) -> list[str]:
    """The note that pairs of cosines and sines were found, where the user said nothing of them: one line, or none."""
    if given.circles is not None or not known.circles:
        return []
    called = known.state_names or tuple(f"x{i}" for i in range(len(known.start_mean)))
    pairs = ", and ".join(f"{called[c]} and {called[s]} are cosine and sine of one angle" for c, s in known.circles)
    found = f"circles={shown(known.circles)} found: {pairs}, which is learned instead of them"
    return [f"{found}; cost= still gets the observation; circles=[] switches this off"]


def stopping(config: Config, task: Task) -> None:
    """Raises ConfigError unless the task's `stop` is one probability of x, and no episode ends where it starts."""
    if task.stop is None:
        return
    what = f"stop={shown(config.stop)}"
    cost_check.within(task.stop, (len(task.state_names) + len(task.memory.names),), task.observed, what)
    with user_code.blamed(what, task.stop):
        value = jnp.asarray(task.stop(jnp.asarray(task.start_mean, float)))
    if value.shape != ():
        raise ConfigError(f"{what} returns an array of shape {value.shape}; expected one number in [0, 1], or a bool")
    if not 0 <= float(value) <= 1:
        raise ConfigError(f"{what} is {float(value):g} at the start; expected a probability in [0, 1], or a bool")
    if float(value) > 0.5:
        raise ConfigError(f"{what} is {float(value):g} at the start: every episode would end there")


def turning(facts: cost_check.Facts, names: tuple[str, ...]) -> list[str]:
    """Notes on entries whose unit is an angle's and that are not said to be angles, and the other way round."""
    places = entries(len(facts.start_mean) + len(facts.circles), facts.circles)
    units = [parted(name)[1] for name in names]
    free = [i for i, unit in enumerate(units) if unit == "rad" and i not in facts.angles]
    notes = []
    if free:
        which = some([names[i] for i in free])
        said = {places[i] for i in facts.angles} - {min(pair) for pair in facts.circles}
        angles = shown(sorted(said | {places[i] for i in free}))
        if_so = "is not in angles=; if it can turn" if len(free) == 1 else "are not in angles=; if they can turn"
        notes.append(f"{which} {if_so} around, give angles={angles}")
    wrong = [i for i in facts.angles if units[i] not in (None, "rad")]
    return notes + [f"angles=[{places[i]}]: {names[i]} is said to be an angle, and its unit is not rad" for i in wrong]


def plausible(readings: np.ndarray, facts: cost_check.Facts, names: tuple[str, ...]) -> list[str]:
    """Notes on angles that are large for radians. Raises ConfigError for those that must be degrees.

    readings: [N, D] of resets; names: [D] of the entries
    """
    notes = []
    for entry in facts.angles:
        seen = [*readings[:, entry], facts.start_mean[entry]]
        largest = float(max(seen, key=abs))
        theirs = entries(len(facts.start_mean) + len(facts.circles), facts.circles)[entry]
        text = f"angles=[{theirs}]: {names[entry]} is {largest:.4g} at the start"
        if abs(largest) > 4 * np.pi:
            raise ConfigError(f"{text}, more than two turns in radians; degrees? Return np.deg2rad of it")
        if abs(largest) > 2 * np.pi:
            notes.append(f"{text}, more than a turn in radians; are these degrees?")
    return notes


def alike(readings: np.ndarray, angles: tuple[int, ...] = (), names: tuple[str, ...] = ()) -> list[str]:
    """Notes on entries of readings [N, D] that never change, and on those that follow from others."""
    count, size = readings.shape
    if count < 3:
        return []
    names = names or tuple(f"x{i}" for i in range(size))
    spread = np.ptp(readings, axis=0)
    still = spread <= 1e-6 * np.maximum(1, np.abs(readings).max(0))
    notes = []
    if still.any():
        same = some([names[i] for i in np.flatnonzero(still)])
        notes.append(
            f"the same after each of {count} resets: {same}; right for a rate at rest, else a sensor may be dead"
        )
    for i in range(size):
        earlier = {names[j]: readings[:, j] for j in range(i) if not still[j]}
        earlier |= {f"{f.__name__}({names[a]})": f(readings[:, a]) for a in angles if a != i for f in (np.sin, np.cos)}
        if not still[i] and (others := _explained(readings[:, i], earlier)):
            notes.append(f"{names[i]} follows from {others} in all of {count} resets; one of them is enough")
    return notes


def _explained(column: np.ndarray, others: dict[str, np.ndarray]) -> str:
    """The one of the others [N], or all of them, of which a column [N] is a linear function; "" where it is none."""
    every = [[name] for name in others] + ([list(others)] if len(column) > len(others) + 2 else [])
    for names in every:
        basis = np.column_stack([np.ones(len(column)), *(others[name] - others[name].mean() for name in names)])
        rest = column - basis @ np.linalg.lstsq(basis, column, rcond=None)[0]
        if np.ptp(rest) < EXACT * np.ptp(column):
            return ", ".join(names)
    return ""


def report(config: Config) -> list[str]:
    """What a task is like, line by line. Its environment is opened, reset, not driven, and closed.

    Raises ConfigError, in one line, for what cannot be learned.
    """
    set_precision(config)
    asked, config = config, tasks.resolve(config)
    task, _, notes = checked(asked, config)
    wide = width(config, begun := at_starts(task))
    facts: dict[str, Any] = {
        "task": " ".join([config.task, *([task.name] if task.name != config.task else [])]),
        **tasks.described(config),
        "observation": ", ".join(task.state_names),
        **understood(config, task),
        "angles": ", ".join(task.state_names[i] for i in task.angles) or "none",
        "control": ", ".join(
            f"{name} from {low:g} to {high:g}"
            + ("" if np.isinf(change) else f", changing by at most {change / task.dt:g} in a second")
            for name, low, high, change in zip(
                task.control_names, task.control_low, task.control_high, largest_change(task), strict=True
            )
        ),
        "time": f"{task.horizon} periods of {task.dt:g} s an episode, {task.horizon * task.dt:g} s"
        + ("; horizon= changes that" if asked.horizon is None and uses(asked.task, "horizon") else ""),
        "start": f"mean {_numbers(task.start_mean)}, standard deviation {_numbers(task.start_std)}",
        "cost at start": f"{np.mean(begun):.4g} on average; below {task.success:g} is success"
        + (f"; searches begin with a cost {wide:.2g} times as wide" if wide > 1.05 else ""),
    }
    verdict = "no error" + ("; read the notes" if notes else "")
    lines = [*facts.items(), *(("note", note) for note in notes), ("result", verdict)]
    return [f"{name:>17}  {value}" for name, value in lines]


def understood(config: Config, task: Task) -> dict[str, str]:
    """What the words of sensors, goals and a constraint have made of a task: nothing of what nobody asked for."""
    found = {}
    if (seen := seen_names(task)) != task.state_names:
        found["policy sees"] = ", ".join(seen)
    if task.goal is not None:
        drawn = signals.draws(task.goal.value)
        low, high = (config.goal_low, config.goal_high) if config.goal_low else (drawn.min(0), drawn.max(0))
        found["goals"] = f"from {_numbers(low)} to {_numbers(high)}"
    if task.constraint is not None:
        found["constraint"] = (
            f"{shown(config.constraint)}, broken by at most {task.constraint.bound:.3g} of the episodes"
        )
    return found


def width(config: Config, begun: np.ndarray) -> float:
    """How much wider than the task's the cost is where a search begins, by what it is `begun` [N] where episodes do."""
    return width_of(config.search, lambda: begun) if isinstance(config.search, Search) else 1.0


def _numbers(values: Any) -> str:
    return "[" + ", ".join(f"{value:.4g}" for value in values) + "]"
