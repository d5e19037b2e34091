"""The command pegasus-sweep: many runs that differ in a few settings, handed to a launcher that exists already."""

import itertools
import math
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from pegasus_jax.checks import ConfigError, did_you_mean, whole
from pegasus_jax.cli import train as cli_train
from pegasus_jax.cli.main import main
from pegasus_jax.cli.words import MORE
from pegasus_jax.config import Config
from pegasus_jax.shell import typed

SWEEP = """\
pegasus-sweep task=NAME [setting=value,value,... ...]     learn with every combination of the values

Separate the values of a setting by commas; A-B is every whole number from A to B. Commas inside brackets belong to a
value: policy.hidden=[50,50],[200,200] has two values. Every combination is a pegasus-train command with its own folder,
OUT/SETTING-VALUE_.../seedN. All are checked before the first one starts.

  launcher=print        print the commands, one a line, and run none: for xargs, GNU parallel or any scheduler
           local        run them here, jobs= at a time
           slurm        hand them to SLURM as one job array, jobs= at a time, and return
  jobs=2                number of jobs that run at once
  out=runs/sweep        folder of all runs; OUT/jobs has what local and slurm jobs printed
  seeds=, mesh=, track=, final=   as in pegasus-train, for each command; several trackers in brackets
  slurm.KEY=VALUE       any option of sbatch: slurm.partition=gpu slurm.time=120 slurm.gpus_per_node=1

slurm needs the extra `sweep`: pip install 'pegasus-jax[sweep]'. For the other settings see pegasus-train --help=all.

examples
  pegasus-sweep task=cartpole search.grad_clip=1,10,100 seed=0-2
  pegasus-sweep task=cartpole policy.hidden=[50,50],[200,200] seed=0-9 | xargs -d '\\n' -P 2 -I{} sh -c {}
  pegasus-sweep task=cartpole,double_cartpole seeds=10 launcher=slurm slurm.gpus_per_node=1 slurm.time=60
  pegasus-report runs/sweep     all of its runs side by side
"""

OF_TRAIN = ("seeds", "mesh", "track", "final")  # options of pegasus-train
OPTIONS = (*MORE["pegasus-sweep"], "out", *OF_TRAIN)
LONG = 60  # letters of a value in a folder's name
LONGEST = 255  # bytes that file systems let a folder's name have
MOST = 10_000  # runs of a sweep: beyond is a slip of the keyboard
PROGRAM = [sys.executable, "-c", "from pegasus_jax.cli.main import train; train()"]  # pegasus-train, wherever that is


class Job(NamedTuple):
    """One run of a sweep."""

    run: Path
    words: list[str]  # of pegasus-train


def sweep() -> None:
    """Entry point of pegasus-sweep."""
    main(handle, SWEEP, stopped="all rows of every episode are kept, pegasus-train resume=RUN goes on with a run")


def values(text: str) -> list[str]:
    """The values of 'a,[b,c],2-4': split at commas outside brackets, ranges of whole numbers written out."""
    parts, depth = [""], 0
    for letter in text:
        depth += (letter in "[({") - (letter in "])}")
        if letter == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    ranges = [re.fullmatch(r"(\d+)-(\d+)", part) for part in parts]
    for part, found in zip(parts, ranges, strict=True):
        if found and int(found[1]) > int(found[2]):
            raise ConfigError(f"{part} counts down; type {found[2]}-{found[1]}")
        if found and int(found[2]) - int(found[1]) >= MOST:
            raise ConfigError(f"{part} is a range of more than {MOST:,} numbers; give fewer, for example 0-9")
    return [
        value
        for part, found in zip(parts, ranges, strict=True)
        for value in (map(str, range(int(found[1]), int(found[2]) + 1)) if found else [part])
    ]


def jobs_of(words: dict[str, str], out: Path) -> list[Job]:
    """Every combination of the values of `words`, in their order, the last changing fastest.

    Raises ConfigError where two of them would be the same run.
    """
    choices = {key: values(text) for key, text in words.items()}
    if empty := [key for key, found in choices.items() if not found or "" in found]:
        raise ConfigError(f"{empty[0]}={words[empty[0]]} has an empty value; for example seed=0,1,2 or seed=0-2")
    if (count := math.prod(map(len, choices.values()))) > MOST:
        raise ConfigError(f"these are {count:,} combinations; a sweep has at most {MOST:,}")
    for key, found in choices.items():
        if twice := [value for value, count in Counter(found).items() if count > 1]:
            raise ConfigError(f"{key}={words[key]} has {twice[0]} twice; give each value once")
    swept = {key: names_of(found) for key, found in choices.items() if len(found) > 1}
    jobs = []
    for combination in itertools.product(*choices.values()):
        chosen = dict(zip(choices, combination, strict=True))
        name = "_".join(f"{key}-{swept[key][chosen[key]]}".rstrip("-") for key in swept if key != "seed")
        if len(name.encode()) > LONGEST:
            raise ConfigError(
                f"{len(swept)} settings make a folder's name too long, {name[:LONG]}...; sweep over fewer"
            )
        seed = [f"seed{chosen['seed']}"] if "seed" in swept else []
        run = out.joinpath(*([name] if name else []), *seed)
        jobs.append(Job(run, [*(f"{key}={value}" for key, value in chosen.items()), f"out={run}"]))
    counts = Counter(job.run for job in jobs)
    if shared := next((run for run, count in counts.items() if count > 1), None):
        raise ConfigError(f"two combinations would share the folder {shared}; give each value once")
    return jobs


def names_of(found: Sequence[str]) -> dict[str, str]:
    """Value -> what it is called in a folder's name: its letters, numbers and signs, which any file system takes.

    No two are called alike, also where A is a: the second of [1,2] and 1,2 is 1-2~2.
    """
    names: dict[str, str] = {}
    taken: set[str] = set()
    for value in found:
        plain = re.sub(r"[^\w.-]+", "-", value.strip("[](){}\"' "))[:LONG].rstrip(".-")
        every = (plain if number == 1 else f"{plain}~{number}" for number in itertools.count(1))
        names[value] = next(name for name in every if name.casefold() not in taken)
        taken.add(names[value].casefold())
    return names


def check(job: Job) -> None:
    """Raise ConfigError for what pegasus-train would refuse, but for devices that only it asks for."""
    from pegasus_jax.runs import config_io, store

    options, settings = config_io.split(job.words, ("out", *OF_TRAIN))
    asked = cli_train.new(options, settings, OPTIONS)
    _learnable(replace(asked.config, seed=0))
    if store.holds(job.run):
        raise ConfigError(f"{job.run} holds a run already; another out= keeps both")


@cache
def _learnable(config: Config) -> None:
    """Raise ConfigError for what cannot be learned; looked at once for all seeds."""
    from pegasus_jax import tasks
    from pegasus_jax.assembly.experiments import set_precision
    from pegasus_jax.runs.check import checked

    set_precision(config)
    checked(config, tasks.resolve(config))


def show(jobs: Sequence[Job], at_once: int, out: Path, options: dict[str, Any]) -> None:
    """Print the commands."""
    del at_once, out, options
    for job in jobs:
        print(typed(["pegasus-train", *job.words]))


def local(jobs: Sequence[Job], at_once: int, out: Path, options: dict[str, Any]) -> None:
    """Run the jobs as processes of this machine, which end with this one. Raises RunError when any failed."""
    from pegasus_jax.checks import RunError

    del options
    (home := out / "jobs").mkdir(parents=True, exist_ok=True)
    running: dict[subprocess.Popen, tuple[Path, Path]] = {}  # -> its run, and what it prints
    failed: list[Path] = []
    try:
        for number, job in enumerate([*jobs, None], start=1):  # in the end wait for the last ones
            while len(running) >= at_once or (job is None and running):
                for process in [one for one in running if one.poll() is not None]:
                    run, log = running.pop(process)
                    failed += [run] if process.returncode else []
                    print(f"{'failed' if run in failed else 'done'}: {run} ({log})", flush=True)
                time.sleep(0.2)
            if job is not None:
                log = home / f"{number:04d}.log"
                with log.open("wb") as printed:
                    begun = subprocess.Popen(
                        [*PROGRAM, *job.words],
                        stdin=subprocess.DEVNULL,
                        stdout=printed,
                        stderr=subprocess.STDOUT,
                        start_new_session=True,  # a Ctrl-C is told to them once, below
                    )
                running[begun] = job.run, log
    finally:
        for process in running:
            process.terminate()
        for process in running:
            process.wait()
    if failed:
        raise RunError(f"{len(failed)} of {len(jobs)} runs failed, the first {failed[0]}; see {out / 'jobs'}")


def slurm(jobs: Sequence[Job], at_once: int, out: Path, options: dict[str, Any]) -> None:
    """Submit the jobs as an array. Raises ConfigError where there is no SLURM, or for an option it lacks."""
    executor = _executor(out)
    try:
        executor.update_parameters(slurm_array_parallelism=at_once, **options)
    except (NameError, TypeError, ValueError) as error:
        raise ConfigError(f"slurm.: {' '.join(str(error).split())}; for example slurm.time=120") from error
    with executor.batch():
        submitted = [executor.submit(_command(job)) for job in jobs]
    for job, handle in zip(jobs, submitted, strict=True):
        print(f"{handle.job_id}  {job.run}")


LAUNCHERS: dict[str, Callable[[Sequence[Job], int, Path, dict[str, Any]], None]] = {
    "print": show,
    "local": local,
    "slurm": slurm,
}


def handle(words: Sequence[str]) -> None:
    """Check a sweep, and give it to its launcher. Raises ConfigError for what cannot be."""
    from pegasus_jax.runs import config_io

    options, rest = config_io.split(words, OPTIONS)
    launcher = options.get("launcher", "print")
    if launcher not in LAUNCHERS:
        raise ConfigError(f"launcher={launcher} is unknown; {did_you_mean(launcher, LAUNCHERS)}")
    at_once = whole("jobs", options.get("jobs", "2"))
    if options.get("out") == "":
        raise ConfigError("out= names no folder; for example out=runs/sweep")
    out = Path(options.get("out", "runs/sweep"))
    of_slurm = {f"slurm_{key[6:]}": value for key, value in rest.items() if key.startswith("slurm.")}
    if of_slurm and launcher != "slurm":
        raise ConfigError(
            f"{next(iter(of_slurm)).replace('_', '.', 1)}= is of no use with launcher={launcher}; launcher=slurm"
        )
    own = {key: value for key, value in rest.items() if not key.startswith("slurm.")}
    if whole("seeds", options.get("seeds", "1")) > 1 and len(values(own.get("seed", "0"))) > 1:
        raise ConfigError(
            f"seeds={options['seeds']} of each of seed={own['seed']} would learn some twice; give one of them"
        )
    jobs = jobs_of(own | {key: options[key] for key in OF_TRAIN if key in options}, out)
    for job in jobs:
        check(job)
    LAUNCHERS[launcher](jobs, at_once, out, of_slurm)


def _executor(out: Path) -> Any:
    """The library's executor. Raises ConfigError where it or SLURM is missing."""
    try:
        import submitit
    except ImportError as error:
        raise ConfigError(
            "launcher=slurm needs the extra sweep, pip install 'pegasus-jax[sweep]'; launcher=print needs nothing"
        ) from error
    try:
        return submitit.AutoExecutor(folder=out / "jobs", cluster="slurm")
    except RuntimeError as error:
        raise ConfigError(f"launcher=slurm: {' '.join(str(error).split())}; launcher=local is here") from error


def _command(job: Job) -> Any:
    """What a cluster calls: a fresh interpreter, so that no two runs share anything."""
    from submitit.helpers import CommandFunction

    return CommandFunction([*PROGRAM, *job.words], verbose=False)
