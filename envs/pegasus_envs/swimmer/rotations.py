"""Roll, pitch and yaw, of a body with x ahead, y left, z up, turned about z, then y, then x; quaternions [w x y z]."""

import jax.numpy as jnp
from jax import Array


def quaternion_of(angles: Array) -> Array:
    """[roll, pitch, yaw] [rad] -> unit quaternion [4]."""
    (cr, cp, cy), (sr, sp, sy) = jnp.cos(0.5 * angles), jnp.sin(0.5 * angles)
    w, x = cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy
    y, z = cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy
    return jnp.stack([w, x, y, z])


def angles_of(quaternion: Array) -> Array:
    """Unit quaternion [4] -> [roll, pitch, yaw] [rad]; roll and yaw in (-pi, pi], pitch in [-pi/2, pi/2]."""
    w, x, y, z = quaternion
    roll = jnp.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = jnp.arcsin(jnp.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = jnp.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return jnp.stack([roll, pitch, yaw])
