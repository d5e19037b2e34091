"""Task names -> tasks. The only importer of pegasus_envs, and with it of MuJoCo and Gymnasium, once a task is made."""

import dataclasses
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pegasus_jax import interrupt, memory
from pegasus_jax.checks import ConfigError, choice, did_you_mean
from pegasus_jax.config import GYM, MJCF, Config
from pegasus_jax.imagine.costs import saturating
from pegasus_jax.math import circles
from pegasus_jax.task import Task, known
from pegasus_jax.tasks import circled, constrained, guide, priors, sensed, terms, user_code
from pegasus_jax.tasks.own_plants import TASKS
from pegasus_jax.tasks.signals import FILES, named, with_signals
from pegasus_jax.tasks.starts import from_starts
from pegasus_jax.tasks.traceable import augmented as augmented
from pegasus_jax.tasks.traceable import outside as outside
from pegasus_jax.types import Cost

if TYPE_CHECKING:
    from pegasus_envs.plant import Plant

__all__ = ["make", "of_config"]


def of_plant(name: str, plant: "Plant") -> Task:
    """The task a plant of pegasus_envs poses."""
    return Task(
        name=name,
        plant=plant,
        cost=saturating(plant.error, plant.width, plant.angles),
        angles=plant.angles,
        start_mean=plant.start_mean,
        start_std=plant.start_std,
        sensor_std=plant.sensor_std,
        control_low=plant.control_low,
        control_high=plant.control_high,
        horizon=plant.horizon,
        dt=plant.dt,
        state_names=plant.state_names,
        control_names=plant.control_names,
        rates=plant.rates,
    )


def make(name: str, legs: int = 2, constants: Sequence[str] = ()) -> Task:
    """The task of that name; only the swimmer has legs, and only a cart-pole constants such as pole_mass=0.4 [kg].

    Raises ConfigError for an unknown one.
    """
    if name not in TASKS:
        raise ConfigError(f"task={name} is unknown; {did_you_mean(name, TASKS)}")
    return of_plant(name, TASKS[name](legs, constants))


def of_config(config: Config) -> Task:
    """The task that a config names."""
    with outside():  # it may be made while a program of its user's is traced
        task = sensed.sensed(with_signals(unsensed(config), config), config.sensors)
        return task._replace(
            constraint=constrained.of_config(config, task),
            guide=guide.of_config(config, task),
            prior=priors.of_config(config, task),
        )


def unsensed(config: Config) -> Task:
    """The task that a config names, as it is without the config's sensors."""
    own = {GYM: from_gym, MJCF: from_mjcf}
    choice("task", config.task, (*TASKS, *own))
    task = own[config.task](config) if config.task in own else make(config.task, config.legs, config.env_args)
    if config.cost is not None and config.task not in own:
        task = task._replace(cost=Cost(user_code.load("cost", config.cost)))
    return from_starts(task, config.starts) if config.starts and task.environment is None else task


def rates_of(task: Task) -> tuple[int, ...]:
    """The entries of a task's state that are rates of the others. Raises ConfigError where they are not known."""
    states = len(task.state_names)
    if 2 * len(set(task.rates)) != states or set(task.rates) & set(task.angles):
        raise ConfigError(
            f"model=lagrangian needs a state of coordinates and their rates, and that of task={task.name} is not known"
            " to be one; the nearest is model=log_normal"
        )
    return task.rates


def known_sensors(task: Task) -> np.ndarray:
    """The std [D] of a task's sensors. Raises ConfigError where it is not known."""
    if not np.any(task.sensor_std):
        raise ConfigError(
            f"search.observation_noise=plant needs a plant whose sensors' noise is known,"
            f" and that of task={task.name} is not; the nearest is search.observation_noise=model"
        )
    return np.asarray(task.sensor_std, float)


def input_scale(task: Task, units: tuple[float, ...] | None) -> Any:
    """What a policy's features [F] are multiplied by, so that it counts in these units; 1 for none.

    Raises ConfigError where they are not one for each state that is no angle.
    """
    names = [task.state_names[i] for i in memory.measured(task) if i not in task.angles]
    if units and len(units) != len(names):
        raise ConfigError(f"policy.input_units={list(units)} must be {len(names)} numbers, of {', '.join(names)}")
    shown = [unit for i, unit in enumerate(memory.units(task.memory)) if i not in task.memory.shown_angles]
    turning = 2 * len(memory.seen_angles(task))
    every = np.concatenate([1 / np.array([*(units or np.ones(len(names))), *shown]), np.ones(turning)])
    return every if units or any(unit != 1 for unit in shown) else 1.0


def control_units(task: Task) -> Any:
    """The units of a policy's features [F]: of a control of before, half of the range of the control; 1 of the others.

    A network whose inputs are forces of 10 N begins saturated by them: docs/decisions.md 0039.
    """
    half = (known(task, "control_high") - known(task, "control_low")) / 2
    turning, shown = memory.seen_angles(task), memory.seen_names(task)
    before = range(1, 1 + len(shown))
    of = {name: unit for i in before for name, unit in zip(terms.past(task, i), half, strict=True)}
    plain = [of.get(name, 1.0) for i, name in enumerate(shown) if i not in turning]
    return np.array([*plain, *np.ones(2 * len(turning))])


def resolve(config: Config) -> Config:
    """The config for a run's folder: it finds its MJCF file from anywhere.

    That of a Gymnasium environment says all that has to be known of it, so that whoever reads the folder, or goes on
    with it, neither opens nor resets it: it may be a robot.
    """
    if isinstance(config.reference, str) and config.reference.endswith(FILES):
        config = dataclasses.replace(config, reference=os.path.abspath(config.reference))
    if isinstance(config.prior, str) and config.prior.endswith(priors.FILE):
        config = dataclasses.replace(config, prior=os.path.abspath(config.prior))
    if config.task == GYM:
        from pegasus_envs.gym_plant import EnvSpec, env_spec

        _complete(config)
        environment(config)
        given = {name: getattr(config, name) for name in EnvSpec._fields}
        what = f"env={config.env}"
        with user_code.blamed(what), _refused(what):
            known = env_spec(config.env or "", config.env_args, **given)
        plain: dict[str, Any] = {
            name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in known._asdict().items()
        }
        if config.circles is None:
            plain["circles"] = circles.find(known.starts, (*config.angles, *config.rates))
        return dataclasses.replace(config, **plain)
    if config.task != MJCF or config.mjcf is None:
        return config
    return dataclasses.replace(config, mjcf=os.path.abspath(config.mjcf))


def from_gym(config: Config) -> Task:
    """The task that a Gymnasium environment and a cost of its observations pose. Raises ConfigError if they cannot."""
    from pegasus_envs.gym_plant import EnvSpec, env_plant

    _complete(config)
    known: dict[str, Any] = {name: getattr(config, name) for name in EnvSpec._fields}
    names = {"state_names", "control_names"}
    if any(value in (None, ()) for name, value in known.items() if name not in {"starts", *names}):
        return from_gym(resolve(config))
    known |= {n: np.array(value, float) for n, value in known.items() if isinstance(value, tuple) and n not in names}
    name, about = config.env or "", EnvSpec(**known)
    states = about.state_names or tuple(f"x{i}" for i in range(len(about.start_mean)))
    controls = about.control_names or tuple(f"u{i}" for i in range(len(about.control_low)))
    task = _of_users(config, name, None, about, about.horizon, states, controls)
    task = task._replace(
        rates=_entries("rates", config.rates, name, len(states)),
        environment=env_plant(name, config.env_args, len(states), len(controls), about.state_names),
        starts=about.starts if len(about.starts) else None,
    )
    return circled.start_moments(circled.of_angles(*sensed.chosen(task, config.sensors, config.circles or ())))


def close_environments() -> None:
    """Close every environment that is open; none is before the module that opens them was imported."""
    if "pegasus_envs.gym_plant" in sys.modules:
        from pegasus_envs.gym_plant import close_environments as close_all

        close_all()


def close(task: Task) -> None:
    """Close the task's environment, if it has one and it is open."""
    if task.environment is not None:
        interrupt.let_go(task.environment.close)


def _complete(config: Config) -> None:
    """Raises ConfigError unless an environment is named, and a cost that there is: no robot is opened for nothing."""
    _said(config, env="Pendulum-v1", cost="mymodule:cost")
    assert config.env is not None
    assert config.cost is not None
    terms.agree(user_code.load("cost", config.cost), *named(config))
    if config.constraint is not None:
        user_code.load("constraint", config.constraint)
    module, colon, _ = config.env.partition(":")
    if colon:  # Gymnasium imports it, to register what is in it
        user_code.importing(f"env={config.env}", module)


def _said(config: Config, **examples: str) -> None:
    """Raises ConfigError, which names those that are missing, unless a config has all of these settings."""
    if missing := [name for name in examples if getattr(config, name) is None]:
        *others, last = (f"{name}=" for name in missing)
        words = f"{', '.join(others)} and {last}" if others else last
        example = " ".join(f"{name}={examples[name]}" for name in missing)
        raise ConfigError(f"task={config.task} needs {words}; for example {example}")


def observation_limits(config: Config, task: Task) -> tuple[np.ndarray, np.ndarray]:
    """The least and the greatest state [D] as far as its environment tells them, else infinite."""
    if config.task == GYM:
        space: Any = environment(config).observation_space
        low, high = (sensed.state_of(np.array(limit, float), task, config.sensors) for limit in (space.low, space.high))
        rates = task.rates if config.sensors.velocity != "none" else ()
        free = [*circles.angle_places(task.observed, task.circles), *rates]
        low[free], high[free] = -np.inf, np.inf
        return low, high
    return np.full(len(task.state_names), -np.inf), np.full(len(task.state_names), np.inf)


def readings(config: Config, task: Task, resets: int) -> np.ndarray:
    """The states of an environment after so many resets [N, D]; N is 0 for a simulation of our own.

    Raises ConfigError, in one line, for what the environment raises.
    """
    if config.task != GYM:
        return np.zeros((0, len(task.state_names)))
    from pegasus_envs.gym_plant import resets_of

    with user_code.blamed(f"env={config.env} cannot be reset"):
        return sensed.state_of(resets_of(config.env or "", config.env_args, resets), task, config.sensors)


def compared(config: Config, task: Task) -> None:
    """Raises ConfigError, in one line, where MJX does not simulate a task's MJCF file as MuJoCo does."""
    if config.task == MJCF:
        from pegasus_envs import mjcf_check

        # With a delay the plant's state also holds the controls that wait, which MuJoCo does not have.
        plant = unsensed(config).plant if config.sensors.delay else task.plant
        with _refused(f"mjcf={config.mjcf}"):
            mjcf_check.compare(plant)


def described(config: Config) -> dict[str, str]:
    """What an environment says of itself, by name."""
    if config.task != GYM:
        return {"model": config.mjcf} if config.mjcf else {}
    env: Any = environment(config)
    layers = [env]
    while hasattr(layers[-1], "env"):
        layers.append(layers[-1].env)
    spaces = {"observation space": env.observation_space, "action space": env.action_space}
    return {
        "environment": " of ".join(type(layer).__name__ for layer in layers),
        **{k: str(v) for k, v in spaces.items()},
    }


def environment(config: Config, **more: Any) -> Any:
    """The environment of a config, opened once a process; `more` arguments are for one that is not open yet.

    Raises ConfigError, in one line, where it cannot be made.
    """
    import gymnasium

    from pegasus_envs.gym_plant import make_env

    name, _, _ = (config.env or "").rpartition(":")
    if name:
        user_code.importing(f"env={config.env}", name)
    try:
        return make_env(config.env or "", config.env_args, **more)
    except (gymnasium.error.Error, ModuleNotFoundError) as error:
        raise ConfigError(f"env={config.env}: {str(error).splitlines()[0]}") from error
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # sys.exit is one
        given = "; env_args.NAME=VALUE gives arguments" if isinstance(error, TypeError) else ""
        raise ConfigError(f"env={config.env} cannot be made: {user_code.told(error)}{given}") from error
    finally:
        interrupt.reclaim()


def from_mjcf(config: Config) -> Task:
    """The task that an MJCF file and a cost of its observations pose. Raises ConfigError if they cannot."""
    _said(config, mjcf="arm.xml", cost="mymodule:cost", dt="0.05", horizon="40")
    from pegasus_envs import mjcf_plant

    names = ("observe", "control_low", "control_high", "start_mean", "start_std")
    with _refused(f"mjcf={config.mjcf}"):
        model = mjcf_plant.read(Path(config.mjcf or ""))
        plant = mjcf_plant.mechanism(model, config.dt or 0.0, **{name: getattr(config, name) for name in names})
        mjcf_plant.within_range(model, plant.control_low, plant.control_high)
    _of_hinges(config.angles, plant.hinges, plant.state_names, mjcf_plant.NAMED)
    name = Path(config.mjcf or "").stem
    task = _of_users(config, name, plant, plant, config.horizon or 0, plant.state_names, plant.control_names)
    return task._replace(rates=plant.rates)


def _of_hinges(angles: tuple[int, ...], hinges: tuple[int, ...], names: tuple[str, ...], most: int) -> None:
    """Raises ConfigError for an angle that is no position of a hinge, and names the nearest ones, at most so many."""
    for entry in angles:
        if entry not in hinges:
            what = names[entry] if 0 <= entry < len(names) else "not an entry of the observation"
            nearest = sorted(sorted(hinges, key=lambda i: abs(i - entry))[:most])
            choices = f"choose from {', '.join(f'{i} {names[i]}' for i in nearest)}" if nearest else "leave it out"
            raise ConfigError(f"angles={entry} is {what}, and only positions of hinges are angles; {choices}")


def mjcf_digest(task: Task) -> str | None:
    """SHA-256 of the compiled model of a task=mjcf, whatever files it was made of; None of another task."""
    mjcf_plant = sys.modules.get("pegasus_envs.mjcf_plant")  # MJX takes a second to import, and made no other task
    if mjcf_plant is None or not isinstance(task.plant, mjcf_plant.Mechanism):
        return None
    return mjcf_plant.digest(task.plant.model)


@contextmanager
def _refused(what: str) -> Iterator[None]:
    """Turns a ValueError raised within into a ConfigError of one line: `what`, and its message."""
    try:
        yield
    except ValueError as error:
        raise ConfigError(f"{what}: {' '.join(str(error).split())}") from error


def _of_users(
    config: Config, name: str, plant: Any, about: Any, horizon: int, states: tuple[str, ...], controls: tuple[str, ...]
) -> Task:
    """The task that a user's plant, about which `about` is known, poses with the config's cost and angles."""
    return Task(
        name=name,
        plant=plant,
        cost=Cost(user_code.load("cost", config.cost or "")),
        angles=_entries("angles", config.angles, name, len(states)),
        start_mean=about.start_mean,
        start_std=about.start_std,
        sensor_std=np.zeros(len(states)),
        control_low=about.control_low,
        control_high=about.control_high,
        horizon=horizon,
        dt=about.dt,
        state_names=states,
        control_names=controls,
        success=config.success,
        stop=None if config.stop is None else user_code.load("stop", config.stop),
        stop_cost=config.stop_cost,
    )


def _entries(setting: str, entries: tuple[int, ...], name: str, states: int) -> tuple[int, ...]:
    """The entries, if they are ones of the observation."""
    for entry in entries:
        if not 0 <= entry < states:
            raise ConfigError(
                f"{setting}={entry} is not an entry of {name}'s observation; choose from 0 to {states - 1}"
            )
    return entries


def camera(config: Config) -> Callable[[], np.ndarray]:
    """Open the environment of a config so that it renders; each call is a picture [height, width, 3] of 8-bit colors.

    Raises ConfigError, in one line, for one that cannot; where it says so itself, before it is opened.
    """
    from pegasus_envs.gym_plant import close_env, picture, render_modes
    from pegasus_envs.render import without_display

    without_display()
    refusal = f"env={config.env} cannot be filmed: 'rgb_array' is not among its metadata's render_modes"
    if config.env and ":" in config.env:
        user_code.importing(f"env={config.env}", config.env.rpartition(":")[0])
    with user_code.blamed(f"env={config.env}"):
        known = render_modes(config.env or "")
    if known is not None and "rgb_array" not in known:
        raise ConfigError(f"{refusal}, {list(known)}")
    interrupt.let_go(lambda: close_env(config.env or "", config.env_args))
    env = environment(config, render_mode="rgb_array")
    if "rgb_array" not in (env.metadata or {}).get("render_modes", ()):
        raise ConfigError(refusal)
    return lambda: picture(env)


def pictures(task: Task, states: Any, width: int, height: int) -> list[np.ndarray]:
    """Pictures [height, width, 3] of stacked states [N, ...] of the task's plant."""
    from pegasus_envs.render import frames, unstack

    return frames(task.plant, unstack(states), width, height)
