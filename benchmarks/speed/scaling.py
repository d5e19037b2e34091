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
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from benchmarks import RESULTS, command, named, number, numbers, writable
from benchmarks.speed.timing import summary
from benchmarks.speed.workloads import ALIKE, workload
from pegasus_jax import sharding
from pegasus_jax.assembly.experiments import compose
from pegasus_jax.checks import ConfigError, check_range, did_you_mean
from pegasus_jax.config import Config
from pegasus_jax.runs import config_io, writers
from pegasus_jax.runs.files import write_json
from pegasus_jax.runs.job import first_states, opened
from pegasus_jax.runs.machine import about
from pegasus_jax.runs.programs import FAST_RUN, Jitted, compiler_options, over_seeds, shard
from pegasus_jax.runs.train import learn
from pegasus_jax.types import RunState

Row = dict[str, Any]
Report = Callable[[str, Row], None]  # (the row's name, the row) -> printed and on disk
COLLECTIVE = re.compile(
    r" = [^=]*? (?:all-reduce|all-gather|all-to-all|reduce-scatter|collective-permute)(?:-start)?\("
)


def study(config: Config, seeds: int, over: Mesh | None, report: Callable[[Row], None]) -> Row:
    """Seconds of every trial of a study, and of its parts, as `pegasus-train` learns it; reported after each trial."""
    devices = 1 if over is None else over.devices.size
    row: Row = {"seeds": seeds, "devices": devices, "device": jax.devices()[0].device_kind, "trial_s": []}
    spent: list[dict[str, float]] = []
    with opened(config, range(seeds), over) as job:

        def trial(number: int, states: RunState, rows: list[Row]) -> None:
            parts = {name: value for name, value in rows[0]["seconds"].items() if name != "between_episodes"}
            spent.append(parts)
            row["compile_s"] = sum(trial["compile"] for trial in spent)
            row["trial_s"] = [sum(trial.values()) - trial["compile"] for trial in spent]
            row["run_s"] = sum(row["trial_s"])
            row["parts_s"] = {
                name: statistics.median(trial[name] for trial in spent) for name in spent[0] if name != "compile"
            }
            row["mean_cost"] = statistics.mean(one["mean_cost"] for one in rows)
            compiled = {name: part for name, part in job.program.parts.items() if part.compiled is not None}
            row["collectives"] = {name: collectives(part) for name, part in compiled.items()}
            row["peak_gb"] = peaks(devices)
            report(row)

        learn(job._replace(writer=writers.nothing(seeds)._replace(trial=trial)), first_states(job))
    return row


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
    seeds = number(options, "seeds", 100)
    first = None
    for count in sorted(device_counts(options, "1,2,4")):
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
    steps, repeats = number(options, "steps", 5), number(options, "repeats", 5)
    first = None
    for count in device_counts(options, "1,4"):
        over = sharding.mesh(1, count)
        experiment = compose(config, small.task, mesh=over)
        layout = {} if over is None else {"out_shardings": sharding.over_seeds(over)}
        function = over_seeds(partial(experiment.search, steps=steps), (0, None), seeds=1, over=over)
        search = Jitted(function, compiler_options=compiler_options(FAST_RUN), **layout)
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


def device_counts(options: dict[str, str], default: str) -> list[int]:
    """On how many devices. Raises ConfigError for more than there are."""
    found = numbers(options, "devices", default)
    check_range("devices", max(found), 1, jax.device_count())
    return found


PARTS = {"seeds": of_seeds, "devices": of_devices, "particles": of_particles}


def main(words: list[str]) -> None:
    """The command line of this module."""
    part, rest = named(words, f"one of {', '.join(PARTS)}")
    if part not in PARTS:
        raise ConfigError(f"{part} is unknown; {did_you_mean(part, PARTS)}")
    options, dotted = config_io.split(rest, ("counts", "devices", "seeds", "steps", "repeats", "out"))
    path = writable(f"{options.get('out', RESULTS)}/scaling-{part}.json")
    result: dict[str, Any] = {
        "rows": {},
        "about": about(shlex.join(["python", "-m", "benchmarks.speed.scaling", *words])),
    }

    def report(name: str, row: Row) -> None:
        result["rows"][name] = row
        write_json(path, result)
        brief = {key: value for key, value in row.items() if key not in ("trial_s", "objective", "gradient_norm")}
        rounded = json.loads(json.dumps(brief), parse_float=lambda text: float(f"{float(text):.4g}"))
        print(f"{name}  after {len(row['trial_s'])} trials " if "trial_s" in row else name, rounded, flush=True)

    PARTS[part](options, dotted, report)


if __name__ == "__main__":
    command(main, __doc__)
