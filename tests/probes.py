"""Probe tasks: problems with known answers, small enough to debug an algorithm in seconds. And a small rig of pieces.

A probe is a `task.Task` whose plant is three lines of algebra. Where the answer is known in closed form, it is
computed here in NumPy, independently of the package.
"""

import os
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax import config
from pegasus_jax.imagine import costs as cost
from pegasus_jax.imagine import scenarios
from pegasus_jax.learn import data as dataset
from pegasus_jax.math import angles
from pegasus_jax.models import dropout
from pegasus_jax.models.bnn import bnn
from pegasus_jax.policies.mlp import mlp
from pegasus_jax.policies.squash import SQUASHES, to_limits
from pegasus_jax.task import Task
from pegasus_jax.types import Dynamics, Policy, Prediction, Trajectory

# What the fits and searches of a run are compiled with, and tests are not where they have the choice (conftest.py).
_SWITCH = "xla_cpu_use_fusion_emitters"
EMITTERS = {_SWITCH: True} if _SWITCH in os.environ.get("XLA_FLAGS", "") else {}


class Plant(NamedTuple):
    """What the package asks of a plant, and nothing more."""

    reset: Any  # key -> state
    step: Any  # (state, u [U]) -> state
    observe: Any  # state -> x [D]


def cart(horizon: int = 8) -> Task:
    """A frictionless cart, position and velocity, to be brought from 1 m to rest at 0 by a force of at most 2 N.

    The cost has no flat region at the start, so any sound algorithm improves at once.
    """
    dt, start_std = 0.3, np.array([0.1, 0.1])

    def step(x, u):
        return jnp.array([x[0] + dt * x[1] + 0.5 * dt**2 * u[0], x[1] + dt * u[0]])

    return Task(
        name="cart",
        plant=Plant(
            lambda key: jnp.array([1.0, 0.0]) + jnp.asarray(start_std, jnp.float32) * jax.random.normal(key, (2,)),
            step,
            lambda x: x,
        ),
        cost=cost.saturating(lambda x: x, 1.0, ()),
        angles=(),
        start_mean=np.array([1.0, 0.0]),
        start_std=start_std,
        sensor_std=np.array([0.01, 0.01]),
        control_low=np.array([-2.0]),
        control_high=np.array([2.0]),
        horizon=horizon,
        dt=dt,
        state_names=("x", "v"),
        control_names=("u",),
        rates=(1,),
    )


def dial(horizon: int = 6) -> Task:
    """A dial whose angle, seen in (-pi, pi], is turned by up to .8 rad a step from about 2.5 to -2.5.

    The short way is over the seam at 180 degrees: a model of differences that do not wrap is of no use here.
    """
    goal = -2.5

    def seen(angle):
        return jnp.arctan2(jnp.sin(angle), jnp.cos(angle))

    def error(x):
        return jnp.array([jnp.cos(x[0]) - np.cos(goal), jnp.sin(x[0]) - np.sin(goal)])

    return Task(
        name="dial",
        plant=Plant(
            lambda key: 2.5 + 0.2 * jax.random.normal(key, (1,)),
            lambda angle, u: angle + 0.8 * u,
            seen,
        ),
        cost=cost.saturating(error, 0.5, (0,)),
        angles=(0,),
        start_mean=np.array([2.5]),
        start_std=np.array([0.2]),
        sensor_std=np.array([0.02]),
        control_low=np.array([-1.0]),
        control_high=np.array([1.0]),
        horizon=horizon,
        dt=1.0,
        state_names=("angle",),
        control_names=("turn",),
    )


# Of a search that neither restarts nor refines, for those who ask nothing of that: it compiles in half the time.
PLAIN = dict(search__init="previous", search__refine_fraction=0.0, search__visited_starts=0.0)
PLAIN_WORDS = [f"{name.replace('__', '.')}={value}" for name, value in PLAIN.items()]  # the same, of a command
# Of a command that asks nothing of how well it learns.
TINY_WORDS = ["model.hidden=[8]", "policy.hidden=[8]", "search.steps=5", "fit.steps=5", "search.particles=16"]
TINY_WORDS += PLAIN_WORDS


class Counter:
    """How often Python went through a function: once a trace."""

    def __init__(self, function: Any) -> None:
        self.function, self.count = function, 0

    def __call__(self, *arguments: Any) -> Any:
        self.count += 1
        return self.function(*arguments)


def tiny(**changes: Any) -> config.Config:
    """A config that learns a probe in seconds; dotted changes with __ for the dot."""
    sections = {
        "model": dict(hidden=(16, 16), dropout="none", weight_decay=0.1),
        "policy": dict(hidden=(16,), dropout=0.1),
        "fit": dict(steps=400, batch_size=32, learning_rate=1e-2),
        "search": dict(steps=60, particles=12, learning_rate=2e-2),
        "explore": dict(trials=1),
    }
    top = {}
    for name, value in changes.items():
        section, dot, field = name.partition("__")
        if dot:
            sections[section][field] = value
        else:
            top[section] = value
    kinds = dict(model=config.BNN, policy=config.MLP, fit=config.Fit, search=config.Search, explore=config.Explore)
    return config.Config(**{"trials": 4, **top}, **{name: kind(**sections[name]) for name, kind in kinds.items()})


# A linear plant, known exactly


class Linear(NamedTuple):
    """x' = A x + B u from N(mean, diag(std^2)), the cost of a state x'Qx; controllers are u = gain x."""

    a: np.ndarray
    b: np.ndarray
    q: np.ndarray
    mean: np.ndarray
    std: np.ndarray
    horizon: int


SCALAR = Linear(np.array([[1.2]]), np.array([[0.5]]), np.eye(1), np.array([1.0]), np.array([0.3]), 5)
PENDULUM = Linear(  # two states, unstable, so that matching has a covariance to get right
    np.array([[1.0, 0.2], [0.3, 1.1]]),
    np.array([[0.1], [0.5]]),
    np.eye(2),
    np.array([0.5, -0.5]),
    np.array([0.3, 0.2]),
    7,
)


def expected_cost(plant: Linear, gain: np.ndarray, particles: int) -> float:
    """Mean over steps 1..H of the sample mean of x'Qx, for particles with exactly the Gaussian's moments.

    The sample covariance is the unbiased one, hence the factor (K - 1) / K in the mean of a quadratic.
    """
    closed = plant.a + plant.b @ gain
    mean, cov = plant.mean, np.diag(plant.std**2)
    costs = []
    for _ in range(plant.horizon):
        mean, cov = closed @ mean, closed @ cov @ closed.T
        costs.append(mean @ plant.q @ mean + (particles - 1) / particles * np.trace(plant.q @ cov))
    return float(np.mean(costs))


def known(plant: Linear, noise_std: float = 0.0) -> Dynamics:
    """The true dynamics as a model: nothing to fit, nothing random but the noise of the prediction."""
    states = plant.a.shape[0]

    def apply(posterior, draw, x, u):
        del posterior, draw
        mean = (jnp.asarray(plant.a, x.dtype) - jnp.eye(states, dtype=x.dtype)) @ x + jnp.asarray(plant.b, x.dtype) @ u
        return Prediction(mean, jnp.full((states,), noise_std, x.dtype))

    return Dynamics(
        init=lambda key: {},
        prepare=lambda data: None,
        loss=lambda params, key, batch, context: jnp.zeros(()),
        posterior=lambda params, data: None,
        sample=lambda key, posterior: jnp.zeros(()),
        apply=apply,
    )


def linear_policy(states: int, controls: int) -> Policy:
    """u = gain x, without noise, bias or limits; its parameters are the gain [U, D]."""
    return Policy(
        init=lambda key: jnp.zeros((controls, states)),
        sample=lambda key: jnp.zeros(()),
        apply=lambda gain, noise, x: gain @ x,
    )


def regression(states: int, controls: int) -> Dynamics:
    """A random linear model, fitted by noisy least squares: everything a model has, and it compiles in no time."""
    shape = (states + controls, states)

    def loss(params, key, batch, context):
        noise = 1 + 0.1 * jax.random.normal(key, shape)
        return context * jnp.mean((batch.y - jnp.concatenate([batch.x, batch.u], -1) @ (params * noise)) ** 2)

    return Dynamics(
        init=lambda key: jax.random.normal(key, shape),
        prepare=lambda data: 1 + 0 * jnp.mean(data.y),
        loss=loss,
        posterior=lambda params, data: params,
        sample=lambda key, posterior: posterior * (1 + 0.1 * jax.random.normal(key, shape)),
        apply=lambda posterior, draw, x, u: Prediction(jnp.concatenate([x, u]) @ draw, 0.05 + 0 * x),
    )


def noisy_linear_policy(task: Task) -> Policy:
    """u = limit tanh(gain x + noise), for symmetric limits."""
    limit, shape = jnp.asarray(task.control_high, jnp.float32), (len(task.control_names), len(task.state_names))

    def apply(gain, noise, x):
        return limit * jnp.tanh(gain @ x + (0 if noise is None else noise))

    return Policy(
        init=lambda key: jax.random.normal(key, shape),
        sample=lambda key: 0.1 * jax.random.normal(key, shape[:1]),
        apply=apply,
    )


def balanced_start(plant: Linear, particles: int) -> Any:
    """(key, posterior) -> first states [K, D] with exactly the plant's mean and covariance."""

    def start(key, posterior):
        from pegasus_jax.math.linalg import standardize

        z = jax.random.normal(key, (particles, plant.mean.shape[0]))
        return plant.mean.astype(z.dtype) + standardize(z) * plant.std.astype(z.dtype)

    return start


# A small rig of the real pieces


class Rig(NamedTuple):
    """A small BNN and a small dropout policy on a three-dimensional state whose last entry is an angle."""

    dynamics: Dynamics
    policy: Policy
    blocks: scenarios.Blocks
    posterior: Any
    params: Any  # of the policy
    cost: Any  # [H, K, D] -> [H, K]
    particles: int
    horizon: int


LIMITS = np.array([-1.0, 0.0]), np.array([3.0, 0.5])  # of the rig's two controls; not symmetric


def network(kind: str = "log_normal", heteroscedastic: bool = True, **changes: Any) -> Dynamics:
    """The rig's model, or a variant of it."""
    noise = getattr(dropout, kind)()
    pieces: dict[str, Any] = dict(
        states=3,
        controls=2,
        angles=(2,),
        hidden=(8,),
        dropout=noise,
        heteroscedastic=heteroscedastic,
        weight_decay=1.0,
        initializer="glorot",
    )
    return bnn(**{**pieces, **changes})


def controller(kind: dropout.Dropout | None = None, squash: str = "tanh", **changes: Any) -> Policy:
    """The rig's policy, or a variant of it."""
    low, high = (jnp.asarray(limit, jnp.float32) for limit in LIMITS)
    pieces: dict[str, Any] = dict(
        encode=partial(angles.encode, angles=(2,)),
        features=4,
        controls=2,
        hidden=(8,),
        dropout=kind or dropout.binary(0.3),
        saturate=to_limits(SQUASHES[squash], low, high),
        initializer="glorot",
    )
    return mlp(**{**pieces, **changes})


def experience(rows: int = 30, capacity: int = 40, seed: int = 0):
    """A data set of the rig's shapes from a smooth made-up system."""
    noise = np.random.default_rng(seed)
    x = np.cumsum(noise.normal(size=(rows + 1, 3)) * 0.3, 0)
    u = noise.uniform(*LIMITS, size=(rows, 2))
    trajectory = Trajectory(jnp.asarray(x), jnp.asarray(u), jnp.zeros(rows))
    return dataset.add(dataset.empty(capacity, 3, 2), trajectory, (2,))


def make_rig(particles: int, horizon: int, heteroscedastic: bool = True) -> Rig:
    """The rig, in whatever precision is in force."""
    dynamics, policy = network(heteroscedastic=heteroscedastic), controller()
    blocks = scenarios.blocks(
        dynamics=dynamics,
        policy=policy,
        start=lambda key: jnp.array([0.2, -0.1, 3.0]) + 0.3 * jax.random.normal(key, (3,)),
        particles=particles,
        horizon=horizon,
        standardized_noise=False,
    )

    @jax.jit  # operation by operation it would take seconds
    def start(data):
        return dynamics.posterior(dynamics.init(jax.random.key(1)), data), policy.init(jax.random.key(2))

    posterior, params = start(experience())
    wide = lambda leaf: leaf.astype(float) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf  # noqa: E731
    posterior, params = jax.tree.map(wide, (posterior, params))  # flax makes float32 kernels even where float64 is on
    distance = cost.of_particles(cost.saturating(lambda x: jnp.array([x[0], x[1], jnp.sin(x[2])]), 1.0, (2,)))
    return Rig(dynamics, policy, blocks, posterior, params, distance, particles, horizon)


@cache
def rig(particles: int = 7, horizon: int = 4) -> Rig:
    """The rig in float32, made once."""
    return make_rig(particles, horizon)


def unchecked(function: Any) -> Any:
    """The function without the check for reused keys, which cries wolf at vmap of a scan over keys (jax 0.10, 0.12)."""

    def call(*arguments):
        with jax.debug_key_reuse(False):
            return function(*arguments)

    return call


def same(a: Any, b: Any) -> bool:
    """Two pytrees are equal to the last bit."""
    first, second = jax.tree.leaves(a), jax.tree.leaves(b)
    return jax.tree.structure(a) == jax.tree.structure(b) and all(
        np.array_equal(bits(p), bits(q)) for p, q in zip(first, second, strict=True)
    )


def bits(leaf: Any) -> np.ndarray:
    """The array of a leaf; of a key, its data."""
    is_key = hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if is_key else leaf)
