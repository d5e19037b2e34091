"""A task seen through the sensors that there are: some entries, late, and without rates. One function, Task -> Task."""

from collections.abc import Sequence
from functools import wraps
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax import memory
from pegasus_jax.checks import ConfigError
from pegasus_jax.config import Sensors
from pegasus_jax.math.circles import Circles, to_observation, to_state
from pegasus_jax.math.units import rate_of
from pegasus_jax.memory import coordinates, resting
from pegasus_jax.task import Task
from pegasus_jax.tasks.terms import alone
from pegasus_jax.types import Cost

FAR = (1.0, 10.0, 100.0, 1000.0)  # factors of states at which an early end is looked for


def sensed(task: Task, sensors: Sensors) -> Task:
    """The task whose state is what can be known of it: what is measured, and its rates where they are computed.

    A simulation of ours gets the delay; an environment has it, and its episodes get rates. Raises ConfigError, in one
    line, for sensors that the task cannot have.
    """
    if sensors.delay >= task.horizon:
        raise ConfigError(
            f"sensors.delay={sensors.delay} is no less than the episode, horizon={task.horizon}: no control would act;"
            f" the nearest is {task.horizon - 1}"
        )
    computed = sensors.velocity != "none"
    if task.environment is not None:
        return with_rates(task) if computed else task
    kept = measured = entries(task, sensors)
    if computed:
        rate_at = dict(zip(coordinates(task), task.rates, strict=True))
        kept = sorted({*measured, *(rate_at[i] for i in measured)})
    if len(kept) < len(task.state_names):
        task = reduced(task, kept)
    return delayed(task, sensors.delay) if sensors.delay and task.plant is not None else task


def entries(task: Task, sensors: Sensors) -> list[int]:
    """The entries that are measured. Raises ConfigError where they are not there, or are rates to be computed."""
    names, measured = task.state_names, list(sensors.measured or range(len(task.state_names)))
    for entry in measured:
        if not 0 <= entry < len(names):
            raise ConfigError(f"sensors.measured={entry} is not an entry; choose from 0 to {len(names) - 1}")
    if sensors.velocity == "none":
        return measured
    if not task.rates and task.environment is None:  # of an environment it is known what rates= says
        raise ConfigError(
            f"sensors.velocity={sensors.velocity} needs to know which entries are rates, and of task={task.name} it is"
            " not known; the nearest is sensors.velocity=none history=3"
        )
    if rates := [entry for entry in measured if entry in task.rates]:
        positions = coordinates(task)
        raise ConfigError(
            f"sensors.velocity={sensors.velocity} computes the rates of all that is measured, and {names[rates[0]]} is"
            f" a rate itself; the nearest is sensors.measured=[{','.join(map(str, positions))}]"
        )
    return measured


def reduced(task: Task, kept: Sequence[int]) -> Task:
    """The task of some of its entries; the cost and `stop` still get all of them, the others as 0.

    A constraint, a simulator and a first controller are made of the task that this gives. Raises ConfigError where the
    cost or `stop` depends on an entry that is left out.
    """
    states, kept = len(task.state_names), list(kept)
    place, plant, stop = np.array(kept), task.plant, task.stop
    _blind(task, [i for i in range(states) if i not in kept])

    def whole(x: jax.Array) -> jax.Array:
        return jnp.zeros(states, x.dtype).at[place].set(x)

    return task._replace(
        plant=plant._replace(observe=lambda state: plant.observe(state)[place]),
        cost=_of(task.cost, whole, place),
        stop=None if stop is None else lambda x: stop(whole(x)),
        **_picked(task, kept),
    )


def _of(cost: Cost, whole: Any, place: np.ndarray) -> Cost:
    """The cost of some of the entries of a state, the others being 0."""
    expected, widen = cost.expected, cost.widen

    def moments(mean: jax.Array, cov: jax.Array) -> jax.Array:
        assert expected is not None
        all_of = whole(mean)
        wide = jnp.zeros((all_of.size, all_of.size), cov.dtype).at[place[:, None], place].set(cov)
        return expected(all_of, wide)

    return Cost(
        wraps(cost.of_state)(lambda x, **terms: cost.of_state(whole(x), **terms)),
        None if expected is None else moments,
        None if widen is None else lambda factor: _of(widen(factor), whole, place),
    )


def _blind(task: Task, missing: Sequence[int]) -> None:
    """Raises ConfigError where the cost of some states, or an end there, changes with an entry that is missing."""
    draw = np.random.default_rng(0)
    mean, std = np.asarray(task.start_mean, float), np.asarray(task.start_std, float) + 1.0
    states = jnp.asarray(mean + std * draw.normal(size=(32, len(mean))))
    cost = alone(task)
    slopes = jax.vmap(jax.grad(lambda x: cost(x).astype(float)))(states)
    for entry in missing:
        depends = {"cost": np.any(np.asarray(slopes)[:, entry] != 0), "stop": _stops_by(task, states - mean, entry)}
        for what in (name for name, does in depends.items() if does):
            raise ConfigError(
                f"the {what} depends on {task.state_names[entry]}, entry {entry}, which is not measured; measure it, or"
                f" give a {what} of what is"
            )


def _stops_by(task: Task, around: jax.Array, entry: int) -> bool:
    """Whether an early end depends on an entry: it has no gradient, so states from near to far are compared."""
    if task.stop is None:
        return False
    x = jnp.concatenate([scale * around for scale in FAR])
    ends = jax.vmap(task.stop)
    return bool(np.any(np.asarray(ends(x)) != np.asarray(ends(x.at[:, entry].set(0.0)))))


def delayed(task: Task, delay: int) -> Task:
    """The task whose plant gets a control `delay` periods after it was given; until then it is at rest."""
    plant, rest = task.plant, resting(task)

    def step(state: tuple[Any, jax.Array], u: jax.Array) -> tuple[Any, jax.Array]:
        inner, waiting = state
        return plant.step(inner, waiting[0]), jnp.concatenate([waiting[1:], u[None]])

    late = plant._replace(
        reset=lambda key: (plant.reset(key), jnp.tile(jnp.asarray(rest, float), (delay, 1))),
        step=step,
        observe=lambda state: plant.observe(state[0]),
    )
    films = (
        {"substates": lambda state, u: plant.substates(state[0], state[1][0])} if "substates" in plant._fields else {}
    )
    return task._replace(plant=late._replace(**films), late=delay)


def chosen(task: Task, sensors: Sensors, circles: Circles) -> tuple[Task, Circles]:
    """The task of an environment of which some entries are measured, all of them where none is named; and circles.

    What its user wrote is of these entries, in this order. Raises ConfigError as `entries`.
    """
    keep = entries(task, sensors)
    if not sensors.measured:
        return task, circles
    place, environment = np.array(keep), task.environment

    def step(control: np.ndarray) -> tuple[Any, ...]:
        x, *rest = environment.step(control)
        return x[place], *rest

    task = task._replace(
        environment=environment._replace(reset=lambda seed: environment.reset(seed)[place], step=step),
        **_picked(task, keep),
    )
    return task, tuple((keep.index(i), keep.index(j)) for i, j in circles if {i, j} <= {*keep})


def state(x: Any, task: Task) -> Any:
    """The state [..., D] of an observation [..., O] as a controller is given it; what that does not tell is 0."""
    x, places = to_state(x, task.circles), memory.measured(task)
    size = len(task.state_names)
    return x if len(places) == size else jnp.zeros((*x.shape[:-1], size), x.dtype).at[..., np.array(places)].set(x)


def observation(x: Any, task: Task) -> Any:
    """What a controller is given [..., O] where the state is x [..., D]."""
    places = memory.measured(task)
    return to_observation(x if len(places) == len(task.state_names) else x[..., np.array(places)], task.circles)


def state_of(rows: np.ndarray, task: Task, sensors: Sensors) -> np.ndarray:
    """States [..., D] at rest of what an environment observes [..., O]."""
    x = to_state(rows[..., list(sensors.measured)] if sensors.measured else rows, task.circles)
    more = np.zeros((*x.shape[:-1], len(task.state_names) - x.shape[-1]), x.dtype)
    return np.concatenate([x, more], -1)


def _picked(task: Task, kept: Sequence[int]) -> dict[str, Any]:
    """What is known of these entries of a task's state."""
    kept, place = list(kept), np.array(kept)
    of_each = ("start_mean", "start_std", "sensor_std", "starts", "starts_std")  # the last two may be unknown
    known = {name: value for name in of_each if (value := getattr(task, name)) is not None}
    return dict(
        angles=tuple(kept.index(i) for i in task.angles if i in kept),
        rates=_paired(task, kept),
        state_names=tuple(task.state_names[i] for i in kept),
        **{name: np.asarray(value)[..., place] for name, value in known.items()},
    )


def _paired(task: Task, kept: list[int]) -> tuple[int, ...]:
    """Which of these entries are rates, in the order of those whose rates they are.

    (), as of a task that is not known to be made of such pairs, where one of a pair is kept without the other. Of a
    task with more other entries than rates, what is dropped has none.
    """
    others = coordinates(task)
    if len(others) > len(task.rates):
        others = [i for i in others if i in kept]
    if len(others) != len(task.rates):
        return ()
    rate_at = dict(zip(others, task.rates, strict=True))
    rates = [rate_at[i] for i in kept if i in rate_at]
    return tuple(map(kept.index, rates)) if {*rates} == {*kept} & {*task.rates} else ()


def with_rates(task: Task) -> Task:
    """The task of an environment that measures positions [n], its state [2 n] them and their rates behind them.

    The rates of an episode's rows are differences from the row before; those of the first row are 0.
    """
    n, environment, dt = len(task.state_names), task.environment, task.dt
    turning, before = list(task.angles), np.zeros(0)

    def state(q: np.ndarray, new: bool) -> np.ndarray:
        nonlocal before
        change = np.zeros_like(q) if new else q - before
        change[turning] = np.arctan2(np.sin(change[turning]), np.cos(change[turning]))
        before = q
        return np.concatenate([q, change / dt]).astype(q.dtype)

    def step(control: np.ndarray) -> tuple[Any, ...]:
        q, *rest = environment.step(control)
        return state(q, False), *rest

    def grown(rows: Any) -> np.ndarray:
        return np.concatenate([np.asarray(rows, float), np.zeros(np.shape(rows))], -1)

    return task._replace(
        environment=environment._replace(reset=lambda seed: state(environment.reset(seed), True), step=step),
        rates=tuple(range(n, 2 * n)),
        state_names=(*task.state_names, *map(rate_of, task.state_names)),
        starts=None if task.starts is None else grown(task.starts),
        **{name: grown(getattr(task, name)) for name in ("start_mean", "start_std", "sensor_std")},
    )
