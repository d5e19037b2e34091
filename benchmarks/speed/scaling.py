"""Whole studies on GPUs: seconds of ten and a hundred seeds, of 1, 2 and 4 devices, of a hundred thousand particles.

    python -m benchmarks.speed.scaling seeds [counts=10,100] [setting=value ...]
    python -m benchmarks.speed.scaling devices [devices=1,2,4] [seeds=100] [trials=3] [setting=value ...]
    python -m benchmarks.speed.scaling particles [devices=1,4] [steps=5] [repeats=5] [setting=value ...]

`seeds` is the 15-trial cart-pole experiment on one device; `devices` shares seeds out over the mesh axis of that name
and says how efficient that is, t1 / (n tn); `particles` times a search step with search.particles=100000 on so many
devices, and says how far objective and gradient norm are from those of the first. Each prints a line as soon as it
knows something and has then written it to OUT/scaling-PART.json (out=benchmarks/results): a machine may be taken away
at any moment. Without a GPU, XLA_FLAGS=--xla_force_host_platform_device_count=4 makes four devices of a CPU.
"""

import json
import re
import shlex
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from benchmarks import RESULTS
from benchmarks.speed.timing import summary
from benchmarks.speed.workloads import ALIKE, workload
from pegasus_jax import sharding
from pegasus_jax.assembly.experiments import build, compose, set_precision
from pegasus_jax.config import Config
from pegasus_jax.experiment import EVALUATE, Experiment, trial_key
from pegasus_jax.runs import config_io
from pegasus_jax.runs.machine import about
from pegasus_jax.runs.programs import FAST_RUN, Jitted, compiler_options, over_seeds, shard
from pegasus_jax.types import Array, RunState

Row = dict[str, Any]
Report = Callable[[str, Row], None]  # (the row's name, the row) -> printed and on disk
COLLECTIVE = re.compile(
    r" = [^=]*? (?:all-reduce|all-gather|all-to-all|reduce-scatter|collective-permute)(?:-start)?\("
)
EPISODES = 20  # of evaluation


def spread(function: Callable[..., Any], axes: tuple[int | None, ...], seeds: int, over: Mesh | None) -> Jitted:
    """The function over seeds, and these over a mesh, as `pegasus-train seeds= mesh=` compiles it."""
    layout = {} if over is None else {"out_shardings": sharding.over_seeds(over)}
    how = compiler_options(FAST_RUN)
    return Jitted(over_seeds(function, axes, seeds=seeds, over=over), compiler_options=how, **layout)


def parts_of(experiment: Experiment) -> dict[str, Callable[[RunState], Any]]:
    """The parts of a trial, each (state) -> (state, what it reports)."""

    def collect(state: RunState) -> tuple[RunState, Array]:
        trajectory = experiment.collect(state)
        return experiment.add_episode(state, trajectory), trajectory.cost

    def evaluate(state: RunState) -> tuple[RunState, Array]:
        keys = jax.random.split(trial_key(state.key, state.trial, EVALUATE), EPISODES)
        return state, jax.vmap(experiment.episode, (0, None, None))(keys, state.policy.params, False).cost

    return {"collect": collect, "fit": experiment.fit, "search": experiment.search, "evaluate": evaluate}


def study(config: Config, seeds: int, over: Mesh | None, report: Callable[[Row], None]) -> Row:
    """Seconds of every trial of a study, and of its parts; reported after each trial."""
    set_precision(config)
    experiment = build(config, over)
    prepared = partial(spread, axes=(0,), seeds=seeds, over=over)
    parts = {name: prepared(function) for name, function in parts_of(experiment).items()}
    states = prepared(experiment.init)(on_devices(jax.vmap(jax.random.key)(jnp.arange(seeds)), over))
    devices = 1 if over is None else over.devices.size
    row: Row = {"seeds": seeds, "devices": devices, "device": jax.devices()[0].device_kind, "trial_s": []}
    spent: dict[str, list[float]] = {name: [] for name in parts}
    for _ in range(config.trials):
        costs = None
        for name, jitted in parts.items():
            compiled, began = jitted.seconds, time.perf_counter()
            states, costs = jitted(states)
            spent[name].append(time.perf_counter() - began - (jitted.seconds - compiled))
        row["trial_s"].append(sum(times[-1] for times in spent.values()))
        row["run_s"] = sum(row["trial_s"])
        row["compile_s"] = sum(jitted.seconds for jitted in parts.values())
        row["parts_s"] = {name: statistics.median(times) for name, times in spent.items()}
        row["mean_cost"] = float(np.mean(np.asarray(costs)))
        if "collectives" not in row:
            row["collectives"] = {name: collectives(jitted) for name, jitted in parts.items()}
        row["peak_gb"] = peaks(devices)
        report(row)
    return row


def on_devices(tree: Any, over: Mesh | None) -> Any:
    """The tree [S, ...] with its seeds laid out over the mesh."""
    return tree if over is None else shard(tree, sharding.over_seeds(over))


def collectives(jitted: Jitted) -> int:
    """How many operations of a compiled program speak to another device."""
    assert jitted.compiled is not None
    return len(COLLECTIVE.findall(jitted.compiled.as_text() or ""))


def peaks(devices: int) -> list[float]:
    """The most memory that each device has held at once in this process [GB]; of CPUs it is not known."""
    stats = [device.memory_stats() for device in jax.devices()[:devices]]
    return [round(known["peak_bytes_in_use"] / 1e9, 2) for known in stats if known and "peak_bytes_in_use" in known]


def of_seeds(options: dict[str, str], words: dict[str, str], report: Report) -> None:
    """The whole experiment, one device."""
    config = config_io.parse({"task": "cartpole", "model": "log_normal", **ALIKE, **words})
    for count in numbers(options, "counts", "10,100"):
        study(config, count, None, partial(report, f"{count} seeds"))


def of_devices(options: dict[str, str], words: dict[str, str], report: Report) -> None:
    """A few trials of many seeds, on more and more devices."""
    config = config_io.parse({"task": "cartpole", "model": "log_normal", **ALIKE, "trials": "3", **words})
    (seeds,) = numbers(options, "seeds", "100")
    first = None
    for count in sorted(numbers(options, "devices", "1,2,4")):
        name = f"{count} devices"
        row = study(config, seeds, sharding.mesh(count, 1), partial(report, name))
        seconds = statistics.median(row["trial_s"][1:] or row["trial_s"])  # the first one warms devices up
        first = first or seconds * count
        report(name, {**row, "trial_after_first_s": seconds, "efficiency": first / (count * seconds)})


def of_particles(options: dict[str, str], words: dict[str, str], report: Report) -> None:
    """Search steps of very many particles, on more and more devices."""
    words = {"task": "cartpole", "model": "log_normal", **ALIKE, "search.particles": "100000", **words}
    config = config_io.parse(words)
    small = workload({**words, "search.particles": "100"})  # nothing in a state depends on K
    states = jax.tree.map(lambda leaf: leaf[None], small.state)
    (steps,), (repeats,) = numbers(options, "steps", "5"), numbers(options, "repeats", "5")
    first = None
    for count in numbers(options, "devices", "1,4"):
        over = sharding.mesh(1, count)
        experiment = compose(config, small.task, mesh=over)
        search = spread(partial(experiment.search, steps=steps), (0, None), 1, over)
        arguments: tuple[Any, ...] = (states, jnp.int32(1))  # not 0, which would also weigh a fresh policy
        if over is not None:
            arguments = shard(states, sharding.over_seeds(over)), shard(jnp.int32(1), sharding.shared(over))
        _, info = search(*arguments)
        times = []
        for _ in range(repeats):
            began = time.perf_counter()
            search(*arguments)
            times.append((time.perf_counter() - began) * 1e3)
        row: Row = {"particles": config.search.particles, "devices": count, "device": jax.devices()[0].device_kind}
        row |= {"compile_s": search.seconds, **summary(times, steps), "collectives": collectives(search)}
        row |= {"program_gb": memory(search), "peak_gb": peaks(count)}
        found = {name: np.asarray(getattr(info, name))[0] for name in ("objective", "gradient_norm")}
        first = first or found
        row |= {name: values.tolist() for name, values in found.items()}
        row |= {f"{name}_error": float(np.max(np.abs(found[name] / first[name] - 1))) for name in found}
        report(f"{config.search.particles} particles on {count} devices", row)


def memory(jitted: Jitted) -> float:
    """What a program needs of each device beside its arguments, as the compiler says [GB]."""
    assert jitted.compiled is not None
    known = jitted.compiled.memory_analysis()
    return round((known.temp_size_in_bytes + known.output_size_in_bytes) / 1e9, 3) if known else float("nan")


def numbers(options: dict[str, str], name: str, default: str) -> list[int]:
    """The whole numbers of an option."""
    return [int(text) for text in options.get(name, default).split(",")]


PARTS = {"seeds": of_seeds, "devices": of_devices, "particles": of_particles}


def main(words: list[str]) -> None:
    """The command line of this module."""
    part, *rest = words
    options, dotted = config_io.split(rest, ("counts", "devices", "seeds", "steps", "repeats", "out"))
    path = Path(options.get("out", RESULTS)) / f"scaling-{part}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = {
        "rows": {},
        "about": about(shlex.join(["python", "-m", "benchmarks.speed.scaling", *words])),
    }

    def report(name: str, row: Row) -> None:
        result["rows"][name] = row
        path.write_text(json.dumps(result, indent=1) + "\n")
        brief = {key: value for key, value in row.items() if key not in ("trial_s", "objective", "gradient_norm")}
        rounded = json.loads(json.dumps(brief), parse_float=lambda text: float(f"{float(text):.4g}"))
        print(f"{name}  after {len(row['trial_s'])} trials " if "trial_s" in row else name, rounded, flush=True)

    PARTS[part](options, dotted, report)


if __name__ == "__main__":
    main(sys.argv[1:])
