"""The compiled parts of an experiment, for one seed or for many at once, and the clock on them."""

import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import AbstractContextManager, nullcontext
from copy import copy
from functools import cache, partial
from importlib.metadata import entry_points
from threading import Lock, Thread
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding

from pegasus_jax import interrupt, sharding
from pegasus_jax.episode import Episode, trimmed
from pegasus_jax.experiment import Experiment
from pegasus_jax.runs.machine import cpus
from pegasus_jax.runs.traced import Store
from pegasus_jax.types import Params, Trajectory

NAMES = ("collect", "fit", "search", "imagine", "evaluate", "compile")

# How a GPU runs loops: whole, as graphs of kernels, so that no round waits for the host. The compiler's usual kinds of
# kernels are listed because WHILE alone would leave them out.
GRAPHS = {
    "xla_gpu_enable_command_buffer": "CONDITIONAL,CUBLAS,CUBLASLT,CUDNN,CUSTOM_CALL,DYNAMIC_SLICE_FUSION,FUSION,WHILE"
}
# And side by side the kernels of a graph that do not wait for each other (docs/decisions.md 0013).
CONCURRENT_KERNELS = {"xla_gpu_command_buffer_scheduling_mode": "CONCURRENT"}
# To try several kernels for each of hundreds of small products takes half of the time to compile (the same decision).
NO_AUTOTUNING = {"xla_gpu_autotune_level": 0, "xla_gpu_enable_triton_gemm": False}
ON_GPU = GRAPHS | CONCURRENT_KERNELS | NO_AUTOTUNING

# The compiler's options by platform. On a CPU what runs for milliseconds need not be compiled well: without
# emitters it is ready in two thirds of the time, and a tenth slower. A fit or a search runs for seconds, and gains by
# wide vectors; the compiler's highest level gains it nothing over the first, which takes a tenth less.
# Newer versions fuse reductions into kernels of a library that crashes the process for arrays of seven dimensions and
# more, such as those of several seeds with sensors.velocity= (github.com/jax-ml/jax/issues/39257): products only.
NO_REDUCTIONS = {"xla_cpu_experimental_ynn_fusion_type": "LIBRARY_FUSION_TYPE_DOT,LIBRARY_FUSION_TYPE_INDIVIDUAL_DOT"}
FAST_COMPILE: dict[str, dict] = {
    "cpu": NO_REDUCTIONS | {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False},
    "gpu": ON_GPU,
}
FAST_RUN: dict[str, dict] = {
    "cpu": NO_REDUCTIONS | {"xla_backend_optimization_level": 1, "xla_cpu_prefer_vector_width": 512},
    "gpu": ON_GPU,
}
# What runs once a trial, or a run: compiled in half of the time, it takes three times as long, some milliseconds more.
ONCE = FAST_COMPILE | {"cpu": FAST_COMPILE["cpu"] | {"xla_backend_optimization_level": 0}}
LONG, SELDOM = ("fit", "search"), ("init", "add_episode", "succeed", "calibrate")
SINGLE_THREAD_BELOW = 128  # particles that one thread of a CPU imagines as fast as two


class Jitted:
    """A jitted function that knows how long its caller waited for the compiler. It compiles for one set of shapes."""

    def __init__(self, function: Callable[..., Any], lower: Callable[..., Any] | None = None, **options: Any) -> None:
        self.function, self.compiled, self.seconds = jax.jit(function, **options), None, 0.0
        self.lower = self.function.lower if lower is None else lower
        self.low: Any = None  # lowered
        self.coming: Future | None = None
        self.one = Lock()  # compiles at a time

    def ready(self, *arguments: Any) -> None:
        """Wait until it is compiled for arguments of these shapes."""
        with self.one:
            if self.compiled is None:
                began = time.monotonic()
                # Traced here, where JAX has its caller's settings, and compiled elsewhere.
                self.compiled = (self.coming or begun(self.lowered(*arguments).compile)).result()
                self.seconds = time.monotonic() - began

    def __call__(self, *arguments: Any) -> Any:
        self.ready(*arguments)
        compiled: Any = self.compiled
        return begun(lambda: jax.block_until_ready(compiled(*arguments))).result()

    def compile(self, *arguments: Any) -> Any:
        """The function compiled for arguments of these shapes."""
        return self.lowered(*arguments).compile()

    def lowered(self, *arguments: Any) -> Any:
        """The function lowered for arguments of these shapes, once."""
        if self.low is None:
            self.low = self.lower(*arguments)
        return self.low

    def shapes(self, *arguments: Any) -> Any:
        """The shapes of its result."""
        return self.lowered(*arguments).out_info


class Program:
    """An experiment over S seeds: every argument and result has a leading axis [S], except those that all share.

    With a mesh, the seeds lie on its devices; those of several processes call every part together.
    """

    def __init__(
        self,
        experiment: Experiment,
        search_steps: int,
        seeds: int = 1,
        over: Mesh | None = None,
        side_by_side: bool | None = None,
        traced: Store | None = None,
    ) -> None:
        self.mesh, self.seeds = over, seeds
        # Whether two parts may run at once. Sums across devices, and what processes tell each other, need one order.
        self.concurrent = jax.process_count() == 1 and (over is None or over.shape[sharding.PARTICLES] == 1)
        self.drive, self.horizon = experiment.drive, experiment.task.horizon
        # Evaluation episodes. A GPU takes as long for one as for twenty; a CPU does not, and would have one more
        # program to compile.
        self.side_by_side = jax.default_backend() != "cpu" if side_by_side is None else side_by_side
        self.chunk = chunk(search_steps)
        self.chunks = search_steps // self.chunk
        functions = {
            "init": (experiment.init, (0,)),
            "episode": (experiment.episode, (0, 0, None)),
            "evaluate": (jax.vmap(experiment.episode, (0, None, None)), (0, 0, None)),
            "add_episode": (experiment.add_episode, (0, 0)),
            "fit": (experiment.fit, (0,)),
            "search": (partial(experiment.search, steps=self.chunk), (0, None)),
            "succeed": (experiment.succeed, (0, 0)),
            "calibrate": (experiment.calibrate, (0, 0)),
        }
        self.axes = {name: axes for name, (_, axes) in functions.items()}
        layout = {} if over is None else {"out_shardings": sharding.over_seeds(over)}

        def part(name: str, function: Callable[..., Any], axes: tuple[int | None, ...]) -> Jitted:
            whole = over_seeds(function, axes, seeds=seeds, over=over)
            options = compiler_options(FAST_RUN if name in LONG else ONCE if name in SELDOM else FAST_COMPILE)
            lower = None if traced is None else partial(traced.lower, name, whole, options)
            return Jitted(whole, lower, compiler_options=options, **layout)

        self.parts = {name: part(name, *how) for name, how in functions.items()}
        self.spent: dict[str, float] = {}
        # Told of a part while its caller waits for the compiler; whoever shows progress puts its own here.
        self.on_compile: Callable[[str], AbstractContextManager[Any]] = nullcontext

    def aside(self) -> "Program":
        """The same compiled parts with a clock of their own, for another thread."""
        same = copy(self)
        same.spent, same.on_compile = {}, nullcontext
        return same

    def prepare(self, part: str, *others: Any) -> None:
        """Begin to compile a part of states and `others`, or of states and a whole number, while others are at work."""
        jitted = self.parts[part]
        if jitted.compiled or jitted.coming:
            return
        keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), self.seeds))
        states = self.parts["init"].shapes(keys)
        rest = others or tuple(jax.ShapeDtypeStruct((), jnp.int32) for _ in self.axes[part][1:])
        arguments: tuple[Any, ...] = (states, *rest)
        if self.mesh is not None:
            arguments = self.laid_out(part, arguments, shape_structs)
        jitted.coming = begun(jitted.compile, *arguments)

    def laid_out(self, part: str, arguments: tuple, lay: Callable[[Any, NamedSharding], Any]) -> tuple:
        """A part's arguments on the mesh: those that all seeds share whole on every device, the others by seeds."""
        assert self.mesh is not None
        layouts = [sharding.shared(self.mesh) if a is None else sharding.over_seeds(self.mesh) for a in self.axes[part]]
        return tuple(lay(*pair) for pair in zip(arguments, layouts, strict=True))

    def __call__(self, part: str, *arguments: Any, purpose: str | None = None) -> Any:
        """Run a part; its time is counted as that of `purpose`."""
        interrupt.check()  # one that came while a library swallowed it
        jitted, name = self.parts[part], purpose or part
        if self.mesh is not None:
            arguments = self.laid_out(part, arguments, shard)
        began, compiled = time.monotonic(), jitted.seconds
        if jitted.compiled is None:
            with self.on_compile(part):
                jitted.ready(*arguments)
        result = jitted(*arguments)
        compiling = jitted.seconds - compiled
        self.spent[name] = self.spent.get(name, 0.0) + time.monotonic() - began - compiling
        self.spent["compile"] = self.spent.get("compile", 0.0) + compiling
        return result

    def collect(self, keys: Any, params: Params, exploring: bool, purpose: str = "collect") -> list[Episode]:
        """An episode of each seed's policy [S, ...], or of random controls."""
        if self.drive is None:
            ran: Trajectory = gather(self("episode", keys, params, np.asarray(exploring), purpose=purpose))
            alone = [trimmed(jax.tree.map(lambda leaf: leaf[i], ran)) for i in range(self.seeds)]  # noqa: B023
            return [Episode(one, "horizon" if len(one.u) == self.horizon else "terminated") for one in alone]
        began, params = time.monotonic(), gather(params)
        found = [
            self.drive(keys[i], jax.tree.map(lambda leaf: leaf[i], params), exploring)  # noqa: B023
            for i in range(self.seeds)
        ]
        self.spent[purpose] = self.spent.get(purpose, 0.0) + time.monotonic() - began
        return found

    def evaluate(self, keys: Any, params: Any) -> np.ndarray:
        """Costs [S, E, H] of episodes on a plant in JAX of the policies, one for each key [S, E]."""
        follow = np.asarray(False)  # the policy, not random controls
        if self.side_by_side:
            return gather(self("evaluate", keys, params, follow).cost)
        several = (self("episode", some, params, follow, purpose="evaluate") for some in over_episodes(keys))
        return np.stack([gather(episode.cost) for episode in several], axis=1)

    def seconds(self) -> dict[str, float]:
        """Seconds spent in each part since the last call."""
        spent, self.spent = self.spent, {}
        return {name: round(spent.get(name, 0.0), 3) for name in NAMES}


def begun(function: Callable[..., Any], *arguments: Any) -> Future:
    """A future of the function's result. Another thread computes it, so that this one can always answer a signal.

    The thread does not keep the process alive: a command that is asked to stop does not wait for the compiler.
    """
    coming: Future = Future()

    def work() -> None:
        try:
            coming.set_result(function(*arguments))
        except BaseException as error:
            coming.set_exception(error)

    Thread(target=work, name=interrupt.WAITED, daemon=True).start()
    return coming


def share_cpus(seeds: int, particles: int | None = None) -> None:
    """Where a CPU does the work, make a device of as many of its cores as share the seeds evenly, unless JAX was told.

    One program for all seeds hardly uses a second core: a seed's matrices are too small to be shared. Where so few
    `particles` are imagined at once, threads would cost more than they do: then there is one (docs/costs.md). To be
    called before JAX has looked for devices.
    """
    asked = jax.config.jax_num_cpu_devices  # pyright: ignore[reportAttributeAccessIssue]
    told = asked > 0 or "xla_force_host_platform" in os.environ.get("XLA_FLAGS", "")
    if told:
        return
    jax.config.update("jax_num_cpu_devices", max(n for n in range(1, cpus() + 1) if seeds % n == 0))
    if (
        particles is not None and seeds * particles <= SINGLE_THREAD_BELOW and not entry_points(group="jax_plugins")
    ):  # no accelerator
        os.environ.setdefault("NPROC", "1")  # what XLA asks for the number of its threads


def compiler_options(by_platform: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The compiler's options for the platform at hand: those that its version has, and XLA_FLAGS does not speak of."""
    wanted, told = by_platform.get(jax.default_backend(), {}), os.environ.get("XLA_FLAGS", "")
    return {name: value for name, value in wanted.items() if name not in told and _has(name, value)}


@cache
def quick(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function jitted, for what takes longer to compile than it ever runs: the keys of a trial."""
    return jax.jit(function, compiler_options=compiler_options(ONCE))


@cache
def _has(name: str, value: Any) -> bool:
    try:
        jax.jit(lambda: jnp.zeros(())).lower().compile(compiler_options={name: value})
    except jax.errors.JaxRuntimeError:
        return False
    return True


def over_seeds(
    function: Callable[..., Any], axes: tuple[int | None, ...], *, seeds: int, over: Mesh | None = None
) -> Callable[..., Any]:
    """The function over a leading axis of `seeds`; one seed is the function itself, so that its numbers do not change.

    `axes` is 0 for an argument with that axis, None for one that all seeds share. With a mesh the seeds are shared out.
    """
    if over is not None and over.shape[sharding.PARTICLES] == 1:
        each = over_seeds(function, axes, seeds=seeds // over.shape[sharding.SEEDS])
        return sharding.each_its_own(each, over, axes, 0)
    if seeds > 1:
        return jax.vmap(function, axes, spmd_axis_name=sharding.SEEDS)

    def alone(*arguments: Any) -> Any:
        own = (
            argument if axis is None else jax.tree.map(lambda leaf: leaf[0], argument)
            for argument, axis in zip(arguments, axes, strict=True)
        )
        return jax.tree.map(lambda leaf: leaf[None], function(*own))

    return alone


def shard(tree: Any, layout: NamedSharding) -> Any:
    """The tree's arrays laid out over devices; arrays that other processes hold too are equal there."""

    def put(leaf: Any) -> Any:
        if isinstance(leaf, jax.Array) and leaf.sharding.is_equivalent_to(layout, leaf.ndim):
            return leaf
        if isinstance(leaf, jax.Array) and not leaf.is_fully_addressable:
            return jax.device_put(leaf, layout)
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(put(np.asarray(jax.random.key_data(leaf))))
        return jax.device_put(np.asarray(leaf), layout)

    return jax.tree.map(put, tree)


def shape_structs(tree: Any, layout: NamedSharding) -> Any:
    """The shapes of a tree's arrays when they are laid out over devices."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=layout), tree)


def gather(tree: Any) -> Any:
    """The tree's arrays whole on this process, whatever devices of whatever process hold them.

    In NumPy, but for random keys: what a trial does with them is no program that would have to be compiled.
    """
    several = jax.process_count() > 1

    def get(leaf: Any) -> Any:
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(get(jax.random.key_data(leaf))) if several else leaf
        return np.asarray(multihost_utils.process_allgather(leaf, tiled=True) if several else leaf)

    return jax.tree.map(get, tree)


def over_episodes(keys: Any) -> Iterator[Any]:
    """Of keys [S, E] those [S] of each of the E episodes, without a program that would take them apart."""
    numbers = np.asarray(jax.random.key_data(keys))
    return (jax.random.wrap_key_data(jax.device_put(numbers[:, episode])) for episode in range(numbers.shape[1]))


def is_main_process() -> bool:
    """Whether this process is the one that writes files and speaks."""
    return jax.process_index() == 0


def chunk(steps: int) -> int:
    """Search iterations of one call of the program: the smallest divisor of `steps` that is at least a twentieth."""
    return next(d for d in range(-(-steps // 20), steps + 1) if steps % d == 0)
