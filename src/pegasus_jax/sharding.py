"""Several devices as one: a mesh whose axes are `seeds` and `particles`, and what of an experiment lies where.

Where seeds alone are shared out, every device runs the program of its own seeds. Where particles are, JAX's compiler
splits the arithmetic and inserts the sums across devices that it needs: moments to be matched, the objective and its
gradient. Nothing here communicates, and several processes run the same program.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from pegasus_jax.checks import ConfigError

SEEDS, PARTICLES = "seeds", "particles"

Spread = Callable[[Any, int], Any]  # (tree, its axis of particles) -> the same tree, laid out over devices


def mesh(seeds: int, particles: int) -> Mesh | None:
    """The first seeds x particles devices; None for the only one. ValueError when there are not so many.

    One of several is a mesh too, on which our kernels know that they are alone; but not where several processes run.
    """
    wanted, there = seeds * particles, jax.device_count()
    if wanted > there:
        raise ValueError(f"needs {wanted} devices and there {'is' if there == 1 else 'are'} {there}")
    if wanted == 1 and (there == 1 or jax.process_count() > 1):
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


def pallas_allowed(x: Any) -> bool:
    """Whether a kernel of ours may compute in x's place: the compiler splits its own over devices, but not ours.

    It may where there is one GPU, and where every device runs its own part of a program (`each_its_own`).
    """
    over = jax.sharding.get_abstract_mesh()
    whole = jax.device_count() == 1 or (not over.empty and over.are_all_axes_manual)
    return jax.default_backend() == "gpu" and whole and x.dtype == jnp.float32


def over_particles(over: Mesh | None) -> Spread:
    """Lay the axis of particles out over the mesh's devices of that name. Raises ConfigError for what is no mesh."""
    if not isinstance(over, Mesh | None):
        raise ConfigError(f"mesh={over!r} is no Mesh; pegasus_jax.sharding.mesh(seeds, particles) makes one")
    if over is None or over.shape[PARTICLES] == 1:
        return together

    def spread(tree: Any, axis: int) -> Any:
        layout = NamedSharding(over, PartitionSpec(*[None] * axis, PARTICLES))
        return jax.tree.map(lambda leaf: jax.lax.with_sharding_constraint(leaf, layout), tree)

    return spread


def each_its_own(function: Callable[..., Any], over: Mesh, given: Any, returned: Any) -> Callable[..., Any]:
    """A function of several seeds, on a mesh that shares out nothing else: every device runs it on its own seeds.

    `given` (a tuple) and `returned` are the axes of the seeds, as `jax.vmap` takes them: 0, or None of what all share.
    The compiler has nothing to split then, and leaves our own kernels alone.
    """

    def lay(axes: Any) -> Any:
        of_axis = {None: PartitionSpec(), 0: PartitionSpec(SEEDS)}
        return jax.tree.map(of_axis.__getitem__, axes, is_leaf=lambda axis: axis is None)

    return jax.shard_map(function, mesh=over, in_specs=lay(given), out_specs=lay(returned), check_vma=False)


def over_seeds(over: Mesh) -> NamedSharding:
    """The layout of an array [S, ...] over the mesh's devices for seeds."""
    return NamedSharding(over, PartitionSpec(SEEDS))


def shared(over: Mesh) -> NamedSharding:
    """The layout of an array that every device has whole."""
    return NamedSharding(over, PartitionSpec())
