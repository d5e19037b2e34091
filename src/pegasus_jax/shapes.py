"""Shapes and types of what callers hand over, checked while a program is traced; a compiled program checks nothing."""

from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax.types import Dataset, Params, Prediction, Scenarios, TrainState, Trajectory

Shape = tuple[int | None, ...]  # None: any size
ARRAYS = (jax.Array, np.ndarray, np.generic, jax.ShapeDtypeStruct, float, int)


def check_shape(name: str, value: Any, shape: Shape, index: str = "") -> None:
    """Raises ValueError, in one line, unless `value` has floating-point entries and this shape.

    `index` are the letters of its axes, for the message: "[K, D]".
    """
    letters = f" {index}" if index else ""
    if not isinstance(value, ARRAYS):
        raise ValueError(f"{name} is a {type(value).__name__}; expected an array{letters} {_written(shape)}")
    try:
        chex.assert_shape(value, shape)
    except AssertionError:
        raise ValueError(f"{name} has shape {jnp.shape(value)}; expected{letters} {_written(shape)}") from None
    try:
        chex.assert_type(value, float)
    except AssertionError:
        raise ValueError(f"{name} is of {jnp.result_type(value)}; expected floating-point numbers") from None


def check_floating(name: str, tree: Params) -> None:
    """Raises ValueError unless every array of `tree` has floating-point entries: gradients are of no others."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        where = name + jax.tree_util.keystr(path)
        if not isinstance(leaf, ARRAYS):
            raise ValueError(f"{where} is a {type(leaf).__name__}; expected an array")
        if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            raise ValueError(f"{where} is of {jnp.result_type(leaf)}; expected floating-point numbers")


def check_prediction(name: str, value: Any, shape: Shape, index: str) -> None:
    """Raises ValueError unless what dynamics.apply returns is a `Prediction` of arrays of this shape.

    `name` says of what: "dynamics.apply returns for K particles".
    """
    if not isinstance(value, Prediction):
        kind = "n array" if isinstance(value, jax.Array) else f" {type(value).__name__}"
        raise ValueError(f"dynamics.apply returns a{kind}; expected Prediction(mean [D], std [D])")
    for field, array in value._asdict().items():
        check_shape(f"{field} of what {name}", array, shape, index)


def check_particles(name: str, tree: Params, particles: int) -> None:
    """Raises ValueError unless every array of `tree` has one entry a particle [K, ...]."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if jnp.shape(leaf)[:1] != (particles,):
            where = name + jax.tree_util.keystr(path)
            raise ValueError(f"{where} has shape {jnp.shape(leaf)}; expected [K, ...] with K = {particles} particles")


def check_params(name: str, params: Params) -> None:
    """Raises ValueError for a `TrainState` in place of its parameters."""
    if isinstance(params, TrainState):
        raise ValueError(f"{name} is a TrainState; expected its parameters, {name}=learner.params")


def check_scenarios(scenarios: Scenarios, memory: int = 0) -> None:
    """Raises ValueError unless the parts of the scenarios agree in K, H and D, beside which M are of a memory."""
    check_shape("scenarios.start", scenarios.start, (None, None), "[K, D]")
    (particles, whole), horizon = scenarios.start.shape, jnp.shape(scenarios.match)[:1]
    for name, size in (("match", whole), ("sensor", whole - memory)):
        noise = getattr(scenarios, name)
        check_shape(f"scenarios.{name}", noise, (*horizon, particles, size) if horizon else (None,) * 3, "[H, K, D]")
    for name in ("dynamics", "policy"):
        check_particles(f"scenarios.{name}", getattr(scenarios, name), particles)


def check_data(data: Dataset) -> None:
    """Raises ValueError unless x [N, D], u [N, U] and y [N, D] agree in N and D."""
    check_shape("data.x", data.x, (None, None), "[N, D]")
    check_shape("data.u", data.u, (len(data.x), None), "[N, U]")
    check_shape("data.y", data.y, data.x.shape, "[N, D]")


def check_trajectory(trajectory: Trajectory, states: int, controls: int) -> None:
    """Raises ValueError unless an episode has x [H+1, D], u [H, U] and cost [H], in floating-point numbers."""
    horizon = len(trajectory.u)
    for name, shape in dict(x=(horizon + 1, states), u=(horizon, controls), cost=(horizon,)).items():
        check_shape(f"an episode's {name}", getattr(trajectory, name), shape)


def _written(shape: Shape) -> str:
    """The shape as Python prints it, with a star for any size."""
    sizes = ["*" if size is None else str(size) for size in shape]
    return f"({', '.join(sizes)}{',' if len(sizes) == 1 else ''})"
