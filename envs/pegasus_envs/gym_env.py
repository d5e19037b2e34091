"""A plant as a Gymnasium environment."""

from functools import cache
from importlib import import_module
from typing import Any, NamedTuple

import gymnasium
import jax
import numpy as np

from pegasus_envs.plant import Plant, saturating
from pegasus_envs.render import Renderer


class _Compiled(NamedTuple):
    """A plant with its functions compiled once for all environments of its kind."""

    plant: Plant
    state_from_observation: Any
    step: Any
    """(state, control) -> state, x, cost"""
    observe: Any


class PlantEnv(gymnasium.Env):
    """Observation: the plant's x plus sensor noise; reward: minus the cost of the true state; ends at the horizon.

    Args:
        plant: constructor as `module:function`
        arguments: of the constructor, hashable values
        render_mode: `rgb_array` or None
        width, height: of a rendered picture [pixels]
        horizon: control periods of an episode; the plant's own by default
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        plant: str,
        arguments: dict[str, Any] | None = None,
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
        horizon: int | None = None,
    ):
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode {render_mode!r}: only 'rgb_array' or None")
        self._compiled = _compile(plant, tuple(sorted((arguments or {}).items())))
        self.plant = self._compiled.plant
        self.state_names, self.control_names = self.plant.state_names, self.plant.control_names
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / self.plant.dt))}
        self.render_mode = render_mode
        self._size, self._renderer = (width, height), None
        self._horizon, self._time, self._state = horizon or self.plant.horizon, 0, None
        low, high = self.plant.control_low.astype(np.float32), self.plant.control_high.astype(np.float32)
        self.action_space = gymnasium.spaces.Box(low, high, dtype=np.float32)
        unbounded = np.full(len(self.plant.start_mean), np.inf, np.float32)
        self.observation_space = gymnasium.spaces.Box(-unbounded, unbounded, dtype=np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Draw a start; `options={"x": x}` starts from the given x [D] instead."""
        super().reset(seed=seed)
        x = self.np_random.normal(self.plant.start_mean, self.plant.start_std)
        x = np.asarray((options or {}).get("x", x), np.float32)
        self._state, self._time = self._compiled.state_from_observation(x), 0
        x = np.asarray(self._compiled.observe(self._state))
        return self._sensed(x), {"x": x}

    def step(self, action: Any):
        """One control period; `info` has the noise-free `x` and its `cost`."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("reset() comes before step()")
        control = np.asarray(action, np.float32)
        self._state, x, cost = self._compiled.step(self._state, control)
        self._time += 1
        x, cost = np.asarray(x), float(cost)
        return self._sensed(x), -cost, False, self._time >= self._horizon, {"x": x, "cost": cost}

    def render(self):
        """A picture [height, width, 3] of 8-bit colors, or None without a render mode."""
        if self.render_mode is None:
            return None
        if self._state is None:
            raise gymnasium.error.ResetNeeded("reset() comes before render()")
        if self._renderer is None:
            self._renderer = Renderer(self.plant, *self._size)
        return self._renderer(self._state)

    def close(self):
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _sensed(self, x: np.ndarray) -> np.ndarray:
        return (x + self.plant.sensor_std * self.np_random.standard_normal(len(x))).astype(np.float32)


@cache
def _compile(constructor: str, arguments: tuple[tuple[str, Any], ...]) -> _Compiled:
    module, _, name = constructor.partition(":")
    plant: Plant = getattr(import_module(module), name)(**dict(arguments))

    # Apart, so that plants with the same motion but other goals compile it once.
    move, observe, cost = jax.jit(plant.step), jax.jit(plant.observe), jax.jit(lambda x: saturating(plant, x))

    def step(state: Any, control: np.ndarray) -> tuple[Any, jax.Array, jax.Array]:
        following = move(state, control)
        x = observe(following)
        return following, x, cost(x)

    return _Compiled(plant, jax.jit(plant.state_from_observation), step, observe)
