"""A feedback law for the swimmer: a person's idea of the maneuvers, its gains found by search.

It sees only the observation. Point the nose ahead, up or down as the depth's error asks; turn the roll angle, or its
rate, to its aim by opposite offsets of the left and right flippers; pitch by common (two legs) or front against rear
offsets (six); yaw by different amplitudes; six legs also push straight down or up by offsets of all of them.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from pegasus_envs.plant import Plant
from pegasus_envs.swimmer.plant import Swimming

ROLL = {"knife_edge": np.pi / 2, "belly_up": np.pi, "depth_change": 0.0, "corkscrew": None}
NAMES = ("thrust", "roll", "roll_rate", "pitch", "pitch_rate", "yaw", "yaw_rate", "depth", "steady", "lead", "heave")
GAINS = {
    (2, "knife_edge"): [0.675, 0.401, 0.024, 0.43, 0.02, 0.173, 0.11, 0.424, 0.414, 0.465, 0.0],
    (2, "belly_up"): [0.784, 0.356, 0.057, 0.924, -0.097, 0.186, 0.105, 0.965, 1.356, 0.293, 0.0],
    (2, "corkscrew"): [0.597, 0.208, 0.027, 0.632, 0.126, 0.09, 0.098, 0.456, 0.868, 1.021, 0.0],
    (2, "depth_change"): [0.784, 0.293, -0.071, 1.861, -0.395, 0.173, 0.324, 0.393, 0.443, 0.368, 0.0],
    (6, "knife_edge"): [0.699, 0.514, -0.015, 0.333, 0.024, 0.359, 0.046, 0.367, 0.673, 1.929, 0.0],
    (6, "belly_up"): [0.774, 0.362, 0.012, 0.529, 0.04, 0.236, 0.074, 0.584, 0.648, -0.012, 0.0],
    (6, "corkscrew"): [0.509, 0.106, 0.02, 0.427, 0.006, 0.327, 0.141, 0.677, 0.494, 0.217, 0.0],
    (6, "depth_change"): [0.785, 0.283, 0.049, 1.411, 0.078, 0.29, 0.234, 0.332, 0.494, 0.348, 1.855],
}
"""by a cross-entropy search such as `benchmarks.plants.gains`"""


def feedback(gains: Array, x: Array, task: str, legs: int, depth: float, rate: float = -2.0 * np.pi / 3.0) -> Array:
    """x [7 or 13] -> control [4 or 18]."""
    thrust, k_roll, k_roll_rate, k_pitch, k_pitch_rate, k_yaw, k_yaw_rate, k_depth, steady, lead, k_heave = gains
    spin, pitch_rate, yaw_rate = x[4:7]
    dive = jnp.clip(k_depth * (depth - x[3]), -1.2, 1.2)
    ahead = jnp.stack([jnp.cos(dive), 0.0, -jnp.sin(dive)])
    side, up = _in_body(x[:3], ahead)[1:]
    turn = lead * spin  # the body will have rolled on when the command acts
    side, up = side * jnp.cos(turn) + up * jnp.sin(turn), up * jnp.cos(turn) - side * jnp.sin(turn)
    if ROLL[task] is None:
        roll = steady * rate / (2.0 * np.pi / 3.0) + k_roll * (rate - spin)
    else:
        # Always the same way over, for a belly-up: the shorter way would change with the noise.
        error = (ROLL[task] - x[0] + np.pi - 1.0) % (2.0 * np.pi) - np.pi + 1.0
        roll = k_roll * error - k_roll_rate * spin
    pitch = -k_pitch * up - k_pitch_rate * pitch_rate
    yaw = k_yaw * side - k_yaw_rate * yaw_rate
    left, right = thrust - yaw, thrust + yaw
    if legs == 2:
        return jnp.stack([left, right, pitch + roll, pitch - roll])
    heave = jnp.clip(k_heave * (depth - x[3]), -1.0, 1.0) * jnp.cos(x[0])
    amplitude = jnp.stack([left, left, left, right, right, right])
    along = jnp.array([-1.0, 0.0, 1.0, -1.0, 0.0, 1.0])
    across = jnp.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])
    return jnp.concatenate([amplitude, pitch * along + roll * across - heave, jnp.array([0.0, np.pi, 0.0] * 2)])


def episodes(plant: Plant, tasks: Sequence[str], which: Array, gains: Array, starts: Swimming) -> Array:
    """Observations [N, H, D] of N episodes of 20 s at once: episode n does `tasks[which[n]]` with gains [n].

    The motion is the same for all maneuvers, so any swimmer with as many legs serves as the plant.
    """
    legs = 2 if len(plant.control_low) == 4 else 6
    depths = {task: 2.0 if task == "depth_change" else 1.0 for task in tasks}
    laws = [lambda g, x, task=task: feedback(g, x, task, legs, depths[task]) for task in tasks]

    def episode(index: Array, gains: Array, state: Swimming) -> Array:
        def advance(state: Swimming, _: None) -> tuple[Swimming, Array]:
            state = plant.step(state, jax.lax.switch(index, laws, gains, plant.observe(state)))
            return state, plant.observe(state)

        return jax.lax.scan(advance, state, None, length=plant.horizon)[1]

    return jax.vmap(episode)(which, gains, starts)


def _in_body(angles: Array, vector: Array) -> Array:
    """A vector of the world [3] in the frame of a body at roll, pitch, yaw [rad]."""
    roll, pitch, yaw = angles
    x, y, z = vector
    x, y = x * jnp.cos(yaw) + y * jnp.sin(yaw), y * jnp.cos(yaw) - x * jnp.sin(yaw)
    x, z = x * jnp.cos(pitch) - z * jnp.sin(pitch), z * jnp.cos(pitch) + x * jnp.sin(pitch)
    y, z = y * jnp.cos(roll) + z * jnp.sin(roll), z * jnp.cos(roll) - y * jnp.sin(roll)
    return jnp.stack([x, y, z])
