"""Several devices as one: a mesh whose axes are `seeds` and `particles`, and what of an experiment lies where.

JAX's own compiler splits the arithmetic and inserts the sums across devices that it needs, so nothing here
communicates: the same program runs on one device, on several, and on those of several processes. What crosses devices
for the `particles` axis are the sums over particles: moments to be matched, the objective and its gradient.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

SEEDS, PARTICLES = "seeds", "particles"

Spread = Callable[[Any, int], Any]  # (tree, its axis of particles) -> the same tree, laid out over devices


def mesh(seeds: int, particles: int) -> Mesh | None:
    """The first seeds x particles devices; None for one device. ValueError when there are not so many."""
    wanted, there = seeds * particles, jax.device_count()
    if wanted > there:
        raise ValueError(f"needs {wanted} devices and there {'is' if there == 1 else 'are'} {there}")
    if wanted == 1:
        return None
    devices = jax.devices()[:wanted]
    return jax.make_mesh((seeds, particles), (SEEDS, PARTICLES), axis_types=(AxisType.Auto,) * 2, devices=devices)


def evenly(seeds: int) -> Mesh | None:
    """As many devices as share the seeds evenly; None for one."""
    return mesh(math.gcd(seeds, jax.device_count()), 1)


def together(tree: Any, axis: int) -> Any:
    """The spread of one device: nothing to do."""
    del axis
    return tree


def over_particles(over: Mesh | None) -> Spread:
    """Lay the axis of particles out over the mesh's devices of that name."""
    if over is None or over.shape[PARTICLES] == 1:
        return together

    def spread(tree: Any, axis: int) -> Any:
        layout = NamedSharding(over, PartitionSpec(*[None] * axis, PARTICLES))
        return jax.tree.map(lambda leaf: jax.lax.with_sharding_constraint(leaf, layout), tree)

    return spread


def over_seeds(over: Mesh) -> NamedSharding:
    """The layout of an array [S, ...] over the mesh's devices for seeds."""
    return NamedSharding(over, PartitionSpec(SEEDS))


def shared(over: Mesh) -> NamedSharding:
    """The layout of an array that every device has whole."""
    return NamedSharding(over, PartitionSpec())
