"""Clocks for programs on a machine that others use: what is compared is timed in turn, and the least time counts."""

import os
import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.speed.workloads import Workload, products
from pegasus_jax.runs.programs import FAST_RUN, compiler_options

Program = Callable[[], Any]


def clock() -> float:
    """Seconds; on a process pinned to one CPU, those in which it ran, whatever else wanted that CPU meanwhile."""
    pinned = hasattr(os, "sched_getaffinity") and len(os.sched_getaffinity(0)) == 1
    return time.process_time() if pinned else time.perf_counter()


def compiled(function: Callable[..., Any], *arguments: Any) -> tuple[Program, dict[str, float]]:
    """The function compiled, as a run compiles a search, for the arguments: a program without any; what it took."""
    began = clock()
    lowered = jax.jit(function).lower(*arguments)
    traced = clock()
    program = lowered.compile(compiler_options=compiler_options(FAST_RUN))
    ready = clock()
    row = {"trace_s": traced - began, "compile_s": ready - traced}
    memory = program.memory_analysis()
    if memory is not None:
        row["memory_mb"] = (memory.temp_size_in_bytes + memory.output_size_in_bytes) / 1e6
    return lambda: jax.block_until_ready(program(*arguments)), row


def in_turn(programs: Mapping[str, Program], repeats: int) -> dict[str, list[float]]:
    """Milliseconds of each run of each program, after one that does not count; all run once before any runs again."""
    times: dict[str, list[float]] = {name: [] for name in programs}
    for program in programs.values():
        program()
    for _ in range(repeats):
        for name, program in programs.items():
            began = clock()
            program()
            times[name].append((clock() - began) * 1e3)
    return times


def summary(times: list[float], per: int = 1) -> dict[str, float]:
    """Least and median of the times, of each of `per` steps inside one run."""
    return {"min_ms": min(times) / per, "median_ms": statistics.median(times) / per}


def product(kind: str, rows: int, inputs: int, outputs: int, times: int) -> Program:
    """A loop of one matrix product: x [K, I] @ w [I, O]; back, g [K, O] @ w' [O, I]; or weights, x' [I, K] @ g [K, O].

    The operands pass a barrier with the last result, so that the compiler cannot move the product out of the loop.
    """
    x, w, g = jnp.ones((rows, inputs)), jnp.ones((inputs, outputs)) * 1e-3, jnp.ones((rows, outputs))
    multiply, (left, right) = {
        "forward": (lambda x, w: x @ w, (x, w)),
        "back": (lambda g, w: g @ w.T, (g, w)),
        "weights": (lambda x, g: x.T @ g, (x, g)),
    }[kind]

    def body(_: Any, last: Any) -> Any:
        a, b, _ = jax.lax.optimization_barrier((left, right, last))
        return multiply(a, b)

    return compiled(lambda: jax.lax.fori_loop(0, times, body, multiply(left, right)))[0]


def matmul(times: int = 500) -> Program:
    """The loop of (100 x 200)(200 x 200) products that everything is compared with."""
    return product("forward", 100, 200, 200, times)


def own_products(work: Workload, repeats: int, times: int = 100) -> float:
    """Milliseconds of one search step's matrix products alone, each timed in a loop with its own shapes."""
    counted = products(work)
    runs = in_turn({str(key): product(*key, times) for key in counted}, repeats)
    return sum(min(runs[str(key)]) / times * count for key, count in counted.items())
