"""Commands in processes that begin with the packages that every command imports, which takes seconds, once for all.

A process that has imported JAX and other packages, and nothing of ours, waits for commands and forks for each of them.
What is forked has its own folder, environment, output and end, and imports all of our code itself. Commands that a test
interrupts or kills, and those whose imports are what it is about, are started by subprocess instead.
"""

from __future__ import annotations

import atexit
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

# Not MuJoCo, which looks for a display when it is imported, nor what only some commands need.
PACKAGES = ("jax", "jax.experimental.multihost_utils", "flax.linen", "optax", "orbax.checkpoint")
PACKAGES += ("omegaconf", "rich.console", "rich.live", "tensorboardX", "gymnasium", "filelock")
# Variables that those packages, or Python, make use of when they begin.
READ_AT_IMPORT = ("JAX_", "XLA_", "TF_", "OPENBLAS_", "PYTHON")
LIMIT = 300.0  # seconds that a command may take before it fails its test; it takes a tenth of that on a busy machine
Done = subprocess.CompletedProcess[str]
spent: list[float] = []  # CPU seconds of each process that was forked: they are no children of this one


def command(name: str, *words: object, cwd: Path, env: Mapping[str, str] | None = None) -> Done:
    """A command of `pegasus_jax.cli.main`, such as `train`, until its end; `env` comes on top of this environment."""
    return run(f"from pegasus_jax.cli.main import {name}; {name}()", words, cwd, {**os.environ, **(env or {})})


def run(
    program: str, words: Sequence[object], cwd: Path, environment: Mapping[str, str], *, limit: float = LIMIT
) -> Done:
    """What `python -P -c program words` leaves, and has written; another environment than ours for JAX starts that.

    After `limit` seconds its whole process group is killed, and TimeoutError says what it had written.
    """
    arguments = [sys.executable, "-P", "-c", program, *map(str, words)]
    begin = forked if sys.platform == "linux" and read_at_import(environment) == read_at_import(os.environ) else anew
    with tempfile.TemporaryDirectory() as folder:
        out, err = (Path(folder) / name for name in ("out", "err"))
        code = begin(arguments, cwd, environment, out, err, limit)
        written = [path.read_text(errors="replace") if path.exists() else "" for path in (out, err)]
    if code is None:
        raise TimeoutError("\n".join([f"killed after {limit} s: {arguments[3:]}", *written]))
    return subprocess.CompletedProcess(arguments, code, *written)


def forked(
    arguments: list[str], cwd: Path, environment: Mapping[str, str], out: Path, err: Path, limit: float
) -> int | None:
    """How a process that is forked ended; None if it was killed."""
    server = started(tuple(read_at_import(os.environ).items()))
    assert server.stdin is not None
    assert server.stdout is not None
    asked = (limit, arguments[3], arguments[4:], str(cwd), dict(environment), str(out), str(err))
    print(json.dumps(asked), file=server.stdin, flush=True)
    code, seconds, killed = json.loads(server.stdout.readline())
    spent.append(seconds)
    return None if killed else code


def anew(
    arguments: list[str], cwd: Path, environment: Mapping[str, str], out: Path, err: Path, limit: float
) -> int | None:
    """The same of a process that begins by itself."""
    with out.open("w") as stdout, err.open("w") as stderr:
        told = dict(cwd=cwd, env=environment, stdin=subprocess.DEVNULL, stdout=stdout, stderr=stderr)
        process = subprocess.Popen(arguments, start_new_session=True, **told)  # type: ignore[call-overload]
        try:
            return process.wait(limit)
        except subprocess.TimeoutExpired:
            return None
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


def read_at_import(environment: Mapping[str, str]) -> dict[str, str]:
    """The variables that come too late for packages that are imported already; PYTHONPATH does not."""
    return {k: v for k, v in environment.items() if k.startswith(READ_AT_IMPORT) and k != "PYTHONPATH"}


@cache
def started(variables: tuple[tuple[str, str], ...]) -> subprocess.Popen[str]:
    """The process that forks, one for all tests of this process that leave these variables as they are."""
    del variables  # they are those of this process
    program = f"import runpy; runpy.run_path({__file__!r})['serve']()"
    pipes = dict(stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    server = subprocess.Popen([sys.executable, "-P", "-c", program], cwd=os.sep, **pipes)  # type: ignore[call-overload]
    atexit.register(server.kill)
    return server


def serve() -> None:
    """Fork for each line of the input, one after another, and say how it ended, and after how many CPU seconds."""
    for name in PACKAGES:
        import_module(name)
    ours = [name for name in sys.modules if name.startswith("pegasus")]
    threads = len(os.listdir("/proc/self/task"))
    assert not ours, f"{ours}: what is forked imports these itself"
    assert threads == 1, f"{threads} threads: what is forked would wait for those it does not have"
    answers = os.fdopen(os.dup(1), "w")
    while line := sys.stdin.readline():
        limit, *asked = json.loads(line)
        process = os.fork()
        if not process:
            become(*asked)
        with suppress(PermissionError, ProcessLookupError):
            os.setpgid(process, process)  # as it does itself: whichever comes first
        print(json.dumps(ended(process, limit)), file=answers, flush=True)


def ended(process: int, limit: float) -> tuple[int, float, bool]:
    """Wait for a process, and kill its group after `limit` seconds: its exit code, CPU seconds, whether that was so."""
    handle = os.pidfd_open(process)
    late = True  # also where the waiting is interrupted
    try:
        late = not select.select([handle], [], [], limit)[0]
    finally:
        os.close(handle)
        for send in (os.killpg, os.kill) if late else ():
            with suppress(ProcessLookupError):  # it may have no group of its own yet
                send(process, signal.SIGKILL)
    _, status, used = os.wait4(process, 0)
    return os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, late


def become(program: str, words: list[str], cwd: str, environment: dict[str, str], out: str, err: str) -> NoReturn:
    """Be the process that was asked for, to its end."""

    def work() -> None:
        os.setpgid(0, 0)
        for path, number in ((os.devnull, 0), (out, 1), (err, 2)):
            os.dup2(os.open(path, os.O_RDWR | os.O_CREAT, 0o600), number)
        os.chdir(cwd)
        os.environ.clear()
        os.environ.update(environment)
        sys.path[:0] = [path for path in environment.get("PYTHONPATH", "").split(os.pathsep) if path]
        sys.argv = ["-c", *words]
        exec(compile(program, "<string>", "exec"), {"__name__": "__main__"})

    live(work)


def live(work: Callable[[], Any]) -> NoReturn:
    """The life of a process that is forked: `work`, then what an interpreter does at its end."""
    code = 1
    try:
        work()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
    except BaseException:
        traceback.print_exc()
    finally:
        try:
            atexit._run_exitfuncs()
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(code)
