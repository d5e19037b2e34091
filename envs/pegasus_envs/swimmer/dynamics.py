"""Equations of motion of a hull with flippers of two links, whose hinges are all parallel to the hull's y axis.

They are MuJoCo's for such a mechanism without gravity, in closed form and in the hull's axes, where each flipper moves
in a plane: a small part of MJX's arithmetic, and all of it over the flippers and over a batch behind them. A test holds
them to C MuJoCo. Arrays are [2, C, ...]: hip and tip, flippers, batch. Turning is positive about the negative y axis.
"""

from collections.abc import Callable, Iterable
from functools import reduce
from operator import add
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from pegasus_envs.batching import stored
from pegasus_envs.inertia import solve
from pegasus_envs.swimmer.drag import Vector, resistance
from pegasus_envs.swimmer.layout import Mechanism


class Pose(NamedTuple):
    """Where the links are, and how they turn, as seen from the hull."""

    cos: Array
    sin: Array
    rate: Array
    """of the links' angles"""
    angle: Array
    angle_rate: Array
    """of the hinges"""
    own: tuple[Array, Array]
    arm: tuple[Array, Array]
    """x, z of a link's centre of mass, from its own hinge and from the hip"""
    centre: Vector
    """of mass, from the hull's"""


class Loads(NamedTuple):
    """What acts on each link, in the hull's axes; with the forces of inertia that there are if nothing accelerates."""

    force: Array
    torque: Array
    """[3, 2, C, ...]"""
    inertia: Array
    """xx, yy, zz, xz about the hull's centre of mass [4, 2, C, ...]"""


class Hinges(NamedTuple):
    """How the flippers bend."""

    inverse: Array
    """of the hinges' inertia: hip, mixed, tip [3, C, ...]"""
    hip: Array
    tip: Array
    """inertia against the hull's motion: at the flipper's hip along x, along z, and about y [3, C, ...]"""
    moment: Array
    """[2, C, ...]"""


def acceleration(body: Mechanism, qpos: Array, qvel: Array, command: Array) -> Array:
    """Generalised acceleration [nv, ...] at positions [nq, ...], velocities [nv, ...], hip angles asked [C, ...]."""
    rotation = _rotation(qpos[3:7])
    rate, speed = _vector(qvel[3:6]), _vector(_total(rotation[j] * qvel[j] for j in range(3)))
    pose = _pose(body, qpos[7:], qvel[6:])
    loads = _loads(body, pose, rate, speed)
    hinges = _hinges(body, pose, loads, command)
    hull = _hull(body, _flippers(body, pose, loads, hinges), rate, speed)
    hips, tips = _bend(hinges, body.hip[1], hull)
    world = (_total(rotation[i, j] * hull[j] for j in range(3)) for i in range(3))
    return stored(*world, *hull[3:], *(bend for pair in zip(hips, tips, strict=True) for bend in pair))


def _rotation(quaternion: Array) -> Array:
    """[3, 3, ...] from the hull's axes to the world's."""
    w, x, y, z = quaternion
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return stored(*rows).reshape(3, 3, *w.shape)


def _pose(body: Mechanism, angle: Array, rate: Array) -> Pose:
    hip, tip = angle[::2], angle[1::2]
    hip_rate, tip_rate = rate[::2], rate[1::2]
    link, link_rate = hip + tip, hip_rate + tip_rate
    waves = jnp.cos(hip), jnp.cos(link), jnp.sin(hip), jnp.sin(link)
    values = stored(*waves, hip_rate, link_rate, hip, tip, hip_rate, tip_rate)
    cos, sin, rate, angle, angle_rate = values.reshape(5, 2, *hip.shape)
    own = body.centre * cos, body.centre * sin
    arm = own[0] + body.hinge * cos[:1], own[1] + body.hinge * sin[:1]
    x, y, z = body.hip
    return Pose(cos, sin, rate, angle, angle_rate, own, arm, (x + arm[0], y, z + arm[1]))


def _loads(body: Mechanism, pose: Pose, rate: Vector, speed: Vector) -> Loads:
    links, r, first = body.links, pose.rate, pose.rate[:1]
    (own_x, own_z), (arm_x, arm_z) = pose.own, pose.arm
    hinge_x, hinge_z = arm_x - own_x, arm_z - own_z
    swing_x, swing_z = -r * own_z - first * hinge_z, r * own_x + first * hinge_x
    carried = _cross(rate, pose.centre)
    velocity = speed[0] + carried[0] + swing_x, speed[1] + carried[1], speed[2] + carried[2] + swing_z
    change = _cross(rate, (carried[0] + 2 * swing_x, carried[1], carried[2] + 2 * swing_z))
    change_x = change[0] - r * r * own_x - first * first * hinge_x
    change_z = change[2] - r * r * own_z - first * first * hinge_z
    spin = _inward(pose, (rate[0], rate[1] - r, rate[2]))
    motion = stored(*spin, *velocity, change_x, change[1], change_z)
    spin, velocity, change = _vector(motion[:3]), _vector(motion[3:6]), motion[6:]

    (i, j, k), (x, y, z) = links.inertia, spin
    drag = resistance(links.turning, spin)
    # Euler's equations; the terms in r are of the hinges' axes, which the hull turns.
    torque = drag[0] - i * r * z - (k - j) * y * z, drag[1] - (i - k) * z * x, drag[2] + k * r * x - (j - i) * x * y
    force = _outward(pose, resistance(links.moving, _inward(pose, velocity)))
    force = (f - links.mass * a for f, a in zip(force, change, strict=True))
    (x, y, z), cos, sin, mass = pose.centre, pose.cos, pose.sin, links.mass
    xx = i * cos * cos + k * sin * sin + mass * (y * y + z * z)
    zz = i * sin * sin + k * cos * cos + mass * (x * x + y * y)
    yy, xz = j + mass * (x * x + z * z), (i - k) * sin * cos - mass * x * z
    loads = stored(*force, *_outward(pose, torque), xx, yy, zz, xz)
    return Loads(loads[:3], loads[3:6], loads[6:])


def _hinges(body: Mechanism, pose: Pose, loads: Loads, command: Array) -> Hinges:
    mass, inertia = body.links.mass, body.links.inertia[1]
    (x, _, z), (fx, _, fz), (_, ty, _) = pose.centre, loads.force, loads.torque

    def beyond(of: Callable[[Array, Array], Array]) -> tuple[Array, Array]:
        """The sums of a quantity, a function of the arm, of all links beyond each hinge."""
        return _both(of(*pose.arm)), of(*pose.own)[1]

    hip_inertia, tip_inertia = beyond(lambda a, b: mass * (a * a + b * b) + inertia)
    hip_inertia, tip_inertia = hip_inertia + body.armature[0], tip_inertia + body.armature[1]
    mixed = (mass * (pose.arm[0] * pose.own[0] + pose.arm[1] * pose.own[1]) + inertia)[1]
    along_x, along_z = beyond(lambda a, b: -mass * b), beyond(lambda a, b: mass * a)
    about = beyond(lambda a, b: -mass * (x * a + z * b) - inertia)
    hip, tip = beyond(lambda a, b: a * fz - b * fx - ty)
    passive = body.stiffness * pose.angle + body.damping * pose.angle_rate
    hip, tip = hip - passive[0] + body.gain * (command - pose.angle[0]), tip - passive[1]
    scale = 1.0 / (hip_inertia * tip_inertia - mixed * mixed)
    inverse = tip_inertia * scale, -mixed * scale, hip_inertia * scale
    coupling = (kind[hinge] for hinge in range(2) for kind in (along_x, along_z, about))
    hinges = stored(*inverse, *coupling, hip, tip)
    return Hinges(hinges[:3], hinges[3:6], hinges[6:9], hinges[9:])


def _flippers(body: Mechanism, pose: Pose, loads: Loads, hinges: Hinges) -> Array:
    """What the hull feels of its flippers: inertia, the 21 entries not below its diagonal, and force [27, ...]."""
    (x, y, z), mass = pose.centre, body.links.mass
    m, mx, my, mz = _both(mass), _both(mass * x), _both(mass) * y, _both(mass * z)
    moment = (a + b for a, b in zip(_cross(pose.centre, _vector(loads.force)), loads.torque, strict=True))
    (fx, fy, fz), (tx, ty, tz), (ixx, iyy, izz, ixz) = (map(_both, of) for of in (loads.force, moment, loads.inertia))

    # Of all that a stiff flipper would pass on, bending takes this.
    hip, tip, bend = hinges.hip, hinges.tip, _freed(hinges, *hinges.moment)
    freed = [_freed(hinges, h, t) for h, t in zip(hip, tip, strict=True)]
    xx, xz, xt, zz, zt, tt = (hip[i] * freed[j][0] + tip[i] * freed[j][1] for i in range(3) for j in range(i, 3))
    bend_x, bend_z, bend_t = (h * bend[0] + t * bend[1] for h, t in zip(hip, tip, strict=True))
    zero = jnp.zeros_like(xx)
    felt = stored(
        *(m - xx, zero, -xz, -y * xz, mz - xt, y * xx - my),
        *(m, zero, -mz, zero, mx),
        *(m - zz, my - y * zz, -mx - zt, y * xz),
        *(ixx - y * y * zz, -mx * y - y * zt, ixz + y * y * xz),
        *(iyy - tt, -mz * y + y * xt),
        izz - y * y * xx,
        *(fx - bend_x, fy, fz - bend_z, tx - y * bend_z, ty - bend_t, tz + y * bend_x),
    )
    return _total(felt[:, flipper] for flipper in range(felt.shape[1]))


def _hull(body: Mechanism, flippers: Array, rate: Vector, speed: Vector) -> Array:
    """The hull's acceleration and angular acceleration, in its own axes [6, ...]."""
    hull, (a, b, c) = body.hull, body.hull.inertia
    gyroscopic = _cross(rate, (a * rate[0], b * rate[1], c * rate[2]))
    torque = (t - g for t, g in zip(resistance(hull.turning, rate), gyroscopic, strict=True))
    force = flippers[21:] + jnp.stack([*resistance(hull.moving, speed), *torque])
    own, entry = (hull.mass, hull.mass, hull.mass, a, b, c), np.zeros((6, 6), int)
    entry[np.triu_indices(6)] = np.arange(21)
    inertia = stored(*(flippers[entry[min(i, j), max(i, j)]] + own[i] * (i == j) for i in range(6) for j in range(6)))
    return solve(inertia.reshape(6, 6, *inertia.shape[1:]), force[:, None])[:, 0]


def _bend(hinges: Hinges, y: Array, hull: Array) -> tuple[Array, Array]:
    """The hinges' accelerations [C, ...], hips' and tips', on a hull that accelerates by [6, ...]."""
    at_hip = hull[0] - y * hull[5], hull[2] + y * hull[3], hull[4]
    hip, tip = (_total(k * a for k, a in zip(kind, at_hip, strict=True)) for kind in (hinges.hip, hinges.tip))
    return _freed(hinges, hinges.moment[0] - hip, hinges.moment[1] - tip)


def _freed(hinges: Hinges, hip: Array, tip: Array) -> tuple[Array, Array]:
    """How free hinges accelerate by moments."""
    of_hip, mixed, of_tip = hinges.inverse
    return of_hip * hip + mixed * tip, mixed * hip + of_tip * tip


def _total(terms: Iterable[Array]) -> Array:
    """The sum, as one expression: along an axis of three to six it would be several times slower."""
    return reduce(add, terms)


def _both(links: Array) -> Array:
    """The sum over the two links of a flipper."""
    return links[0] + links[1]


def _inward(pose: Pose, vector: Vector) -> Vector:
    """From the hull's axes to the links'."""
    x, y, z = vector
    return x * pose.cos + z * pose.sin, y, z * pose.cos - x * pose.sin


def _outward(pose: Pose, vector: Vector) -> Vector:
    """From the links' axes to the hull's."""
    x, y, z = vector
    return x * pose.cos - z * pose.sin, y, x * pose.sin + z * pose.cos


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _vector(array: Array) -> Vector:
    x, y, z = array
    return x, y, z
