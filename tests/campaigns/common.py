"""What the campaigns share: commands run in forked children, cases shared out among processes, results as JSON."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from tests.forked import ended, live

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: a process that forks must have no other thread

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks" / "results"
# The smallest run that writes every kind of file.
SMALL = [
    *("task=cartpole", "model=log_normal", "model.hidden=[8]", "policy.hidden=[8]", "fit.steps=5", "fit.batch_size=20"),
    *("search.steps=5", "search.particles=10"),
]
TRIALS = 3
RUN = [*SMALL, f"trials={TRIALS}", "eval_episodes=1"]


class Outcome(NamedTuple):
    """How a command ended."""

    status: int
    """exit status; -N when signal N ended it"""
    out: str
    err: str
    seconds: float
    late: bool
    """whether it was ended because its time was over"""

    @property
    def traceback(self) -> bool:
        return "Traceback (most recent call last)" in self.out + self.err

    @property
    def refusal(self) -> str | None:
        """The one line of a refused command; None when it ended otherwise or said more."""
        lines = [line for line in self.err.splitlines() if not line.startswith("trial ")]
        errors = [line for line in lines if line.startswith("pegasus: ")]
        return errors[0] if self.status == 2 and len(errors) == 1 and lines[-1] == errors[0] else None


def prepare(folder: Path) -> None:
    """Before JAX is imported: compiled programs are kept in `folder`, not in the user's cache."""
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
    os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")  # it compiles faster, to slower code
    os.environ["MPLBACKEND"] = "agg"
    # JAX reads these when it is imported, which is before the children's commands can set them.
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder / "cache" / "programs")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    (folder / "cache" / "programs").mkdir(mode=0o700, parents=True, exist_ok=True)


def load() -> None:
    """Import what commands need, so that forked children need not. JAX must not start its threads here."""
    import matplotlib.pyplot  # noqa: F401
    import orbax.checkpoint  # noqa: F401
    import tensorboardX  # noqa: F401

    import pegasus_envs.gym_env  # noqa: F401

    threads = len(os.listdir("/proc/self/task"))
    assert threads == 1, f"{threads} threads: a forked child would wait for those it does not have"


def entry(name: str) -> Callable[[], None] | None:
    """The function behind a console script of the project, as pyproject.toml names it; None where there is none."""
    import importlib
    import tomllib

    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    if name not in scripts:
        return None
    module, _, function = scripts[name].partition(":")
    return getattr(importlib.import_module(module), function)


def forked(work: Callable[[], Any], limit: float, kill_after: float | None = None) -> Outcome:
    """Run `work` in a forked child, for `limit` seconds at most; SIGKILL after `kill_after` seconds, if given."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        sys.stdout.flush()
        began = time.monotonic()
        child = os.fork()
        if not child:
            _be_child(work, out.fileno(), err.fileno())
        status, _, late = ended(child, limit if kill_after is None else min(limit, kill_after))
        texts = []
        for file in (out, err):
            file.seek(0)
            texts.append(file.read().decode(errors="replace"))
    return Outcome(status, *texts, time.monotonic() - began, late)


def command(name: str, *words: object, cwd: Path, limit: float = 60.0, **options: Any) -> Outcome:
    """Run one of the project's commands in a forked child that works in `cwd`."""
    function = entry(name)
    assert function is not None

    def work() -> None:
        os.chdir(cwd)
        sys.argv = [name, *map(str, words)]
        sys.path.insert(0, str(cwd))
        function()

    return forked(work, limit, **options)


def _be_child(work: Callable[[], Any], out: int, err: int) -> NoReturn:
    """The child's life: as an interpreter that does nothing but `work`."""

    def begun() -> None:
        os.setpgid(0, 0)
        null = os.open(os.devnull, os.O_RDONLY)
        for target, source in ((0, null), (1, out), (2, err)):
            os.dup2(source, target)
        # A test may hold the others.
        sys.stdout, sys.stderr = (os.fdopen(file, "w", closefd=False) for file in (1, 2))
        work()

    live(begun)


def shared(cases: Sequence[Any], work: Callable[[Any], dict[str, Any]], jobs: int) -> list[dict[str, Any]]:
    """The results of `work` on every case, in `jobs` forked processes; progress goes to stderr."""
    folder = Path(tempfile.mkdtemp())  # no TemporaryDirectory: a forked child would delete it when it ends
    files, children = [folder / f"{job}.jsonl" for job in range(jobs)], []
    for job, file in enumerate(files):
        child = os.fork()
        if not child:
            _work_on(cases[job::jobs], work, file, len(cases))
        children.append(child)
    statuses = [os.waitpid(child, 0)[1] for child in children]
    rows = [json.loads(line) for file in files if file.exists() for line in file.read_text().splitlines()]
    shutil.rmtree(folder)
    if any(statuses):
        raise RuntimeError(f"a process of the campaign itself failed: {statuses}")
    return rows


def _work_on(cases: Iterable[Any], work: Callable[[Any], dict[str, Any]], file: Path, total: int) -> None:
    code = 1
    try:
        with file.open("w") as rows:
            for index, case in enumerate(cases):
                rows.write(json.dumps(work(case)) + "\n")
                rows.flush()
                if index % 20 == 19:
                    print(f"{index + 1} cases of {total} in process {file.stem}", file=sys.stderr, flush=True)
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def options(defaults: dict[str, Any]) -> dict[str, Any]:
    """The words NAME=VALUE of a campaign's command line, over their defaults."""
    words = dict(word.split("=", 1) for word in sys.argv[1:] if "=" in word)
    if unknown := {*words} - {*defaults}:
        sys.exit(f"{sorted(unknown)[0]} is no option; there are {', '.join(defaults)}")
    return {name: type(value)(words.get(name, value)) for name, value in defaults.items()}


def campaign(name: str, run: Callable[..., dict[str, Any]], cases: int, **more: Any) -> None:
    """A campaign's command: prints what it found, as JSON to the file `out` too; status 1 when it found something.

    Without `out` nothing is written: a short campaign of an afternoon must not replace the documented figures.
    """
    defaults = dict(cases=cases, seed=0, jobs=2, out="", folder="") | more
    chosen = options(defaults)
    given = chosen.pop("folder")
    folder = Path(given or tempfile.mkdtemp(prefix=f"campaign-{name}-")).absolute()
    folder.mkdir(parents=True, exist_ok=True)
    out, began = chosen.pop("out"), time.monotonic()
    prepare(folder)
    result = run(folder, **chosen)
    asked = shlex.join(["python", "-m", f"tests.campaigns.{name}", *(f"{k}={v}" for k, v in chosen.items())])
    result |= {"command": asked, "minutes": round((time.monotonic() - began) / 60, 1)}
    if out:
        Path(out).parent.mkdir(parents=True, exist_ok=True)
        Path(out).write_text(json.dumps(result, indent=1) + "\n")
    print("\n".join(f"{value!s:>8}  {what}" for what, value in result["figures"].items()))
    for problem in result["problems"][:40]:
        print(f"- {problem}")
    if not (result["problems"] or given):
        shutil.rmtree(folder, ignore_errors=True)  # else it stays, to look at
    sys.exit(bool(result["problems"]))


def last_line(text: str) -> str:
    """The last line of a command's output, for a list of problems."""
    lines = [line for line in text.splitlines() if line.strip()]
    return lines[-1][:200] if lines else "(nothing)"
