"""Notes on what neither the user nor the plant has said, and what is assumed instead: one line each."""

from contextlib import suppress

import numpy as np

from pegasus_jax.checks import shown
from pegasus_jax.config import GYM, MJCF, Config
from pegasus_jax.config_models import Model, several, sized
from pegasus_jax.task import Task
from pegasus_jax.tasks.signals import draws

MANY = 100  # control periods of an episode


def notes(given: Config) -> list[str]:
    """Notes on a config as it was `given`, whose environment is open: its period, and its episodes that only measure.

    Nothing tells a default from the same number said by the user, so the latter is told what it means too.
    """
    if given.task != GYM:
        return []
    told = period(given)
    if not given.eval_episodes and (given.goals or given.goal_low):
        told.append(
            "eval_episodes=0, and each episode has another goal: their costs do not compare policies;"
            " pegasus-eval RUN episodes=20 does"
        )
    if given.eval_episodes == Config.eval_episodes:
        told.append(
            f"after each trial the environment runs {given.eval_episodes} more episodes, which only measure the policy"
            " and are not learned from; eval_episodes=0 leaves them out"
        )
    return told


def length(given: Config, task: Task) -> list[str]:
    """The note that an episode has as many control periods as the environment's own limit, where these are many.

    Or that this limit ends every episode before its horizon: what is left then costs, and none can succeed.
    """
    if given.task != GYM:
        return []
    from pegasus_envs.gym_plant import make_env, own_limit

    own = own_limit(make_env(given.env or "", given.env_args))
    if own is not None and own < task.horizon:
        return [
            f"horizon={task.horizon}, and the environment's own limit ends each episode after {own} periods: each that"
            f" is left costs stop_cost={given.stop_cost:g}, and none succeeds; horizon={own} is as long as its limit"
        ]
    if given.horizon is not None or task.horizon <= MANY:
        return []
    return [
        f"an episode has the environment's own {task.horizon} periods, and each iteration of a search goes through all"
        f" of them; horizon={MANY} makes it shorter, and docs/simulator.md shows how to hold a control for some steps"
    ]


def rotations(given: Config, task: Task) -> list[str]:
    """Notes on orientations of an MJCF file's bodies that are observed as quaternions, one each joint."""
    if given.task != MJCF:
        return []
    from pegasus_envs import mjcf_plant

    found = mjcf_plant.orientations(task.plant.model, given.observe)
    return [
        f"{joint}: {', '.join(entries)} are of a quaternion, which is learned as plain numbers, so that with noise it"
        " is not quite a rotation; hinges have angles, and observe= can leave it out"
        for joint, entries in found.items()
    ]


def actuators(given: Config, task: Task) -> list[str]:
    """The note that an MJCF file's actuators have a state of their own, which is not observed; or none."""
    count = task.plant.model.na if given.task == MJCF else 0
    what = f"{count} of the file's actuators have a state of their own (act), which is not observed"
    return [f"{what}; history=2 tells some of it"] if count and given.history == 1 else []


def goals(given: Config, task: Task) -> list[str]:
    """The note that goals= does not draw: its goal is the same for every key; or none."""
    if given.goals is None or task.goal is None or np.ptp(drawn := draws(task.goal.value), axis=0).any():
        return []
    same = f"goals={shown(given.goals)} gives {drawn[0].tolist()} for each of {len(drawn)} keys"
    return [f"{same}; to draw, use jax.random with the key: NumPy draws once, while JAX traces"]


def networks(model: Model, states: int) -> list[str]:
    """The note that a plant of so many states gets several models where the user did not say how many; or none."""
    size = several(sized(model, states))
    if size == several(model):
        return []
    said = f"{states} states: the model is {size} networks, and each imagined episode follows one of them"
    return [f"{said}; model.ensemble_size=1 takes one alone, which is quicker and often too sure of itself"]


def period(given: Config) -> list[str]:
    """The note that nobody said the control period, or that two said different ones; or none."""
    from pegasus_envs.gym_plant import make_env, own_period, told_period

    env, what = make_env(given.env or "", given.env_args), f"env={given.env}"
    if given.dt is None:
        assumed = f"{what} says no dt; a period of 1 s is assumed, at which pegasus-run drives; dt=0.05 says another"
        return [assumed] if told_period(env) is None else []
    own = None
    with suppress(ValueError):  # of an attribute that is no period, which dt= replaces
        own = own_period(env)
    if own is None or np.isclose(given.dt, own, rtol=1e-3):
        return []
    return [
        f"dt={given.dt:g}, and {what} has dt {own:g}: times, rates and pegasus-run go by dt={given.dt:g}, which does"
        " not change the environment; leave it out unless it is right"
    ]
