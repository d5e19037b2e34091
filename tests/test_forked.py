"""A process that was forked with packages imported does and says what one that began by itself does."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

import forked

FACTS = """
import json, os, sys
print(json.dumps([os.getcwd(), sys.argv, dict(os.environ), sys.path[:2], 'pegasus_jax' in sys.modules, __name__]))
print(sys.stdin.read(), end='')
"""
ENDS = ["", "sys.exit(3)", "sys.exit('no')", "sys.exit(None)", "1 / 0", "os.kill(os.getpid(), 9)", "os._exit(4)"]


def anew(program: str, words: list[str], cwd: Path, environment: dict[str, str]) -> forked.Done:
    command = [sys.executable, "-P", "-c", program, *words]
    told = dict(stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    return subprocess.run(command, cwd=cwd, env=environment, **told)  # type: ignore[call-overload]


def test_it_has_the_folder_the_words_and_the_environment(tmp_path: Path) -> None:
    given = (FACTS, ["a b", "c='d'"], tmp_path, {**os.environ, "PYTHONPATH": f"{tmp_path}:/nowhere", "NEW": "é"})
    one, other = forked.run(*given), anew(*given)
    assert (one.returncode, one.stderr) == (0, "")
    assert json.loads(one.stdout) == json.loads(other.stdout)


@pytest.mark.parametrize("end", ENDS)
def test_it_ends_as_it_would(end: str, tmp_path: Path) -> None:
    given = (f"import os, sys\nprint('said', flush=True)\n{end}", [], tmp_path, {**os.environ})
    one, other = forked.run(*given), anew(*given)
    assert (one.returncode, one.stdout) == (other.returncode, other.stdout)
    assert one.stderr.splitlines()[-1:] == other.stderr.splitlines()[-1:]


def test_what_is_read_at_an_import_begins_a_process_of_its_own(tmp_path: Path) -> None:
    before = len(forked.spent)
    program = "import jax; print(jax.config.jax_enable_x64)"
    assert forked.run(program, [], tmp_path, {**os.environ, "JAX_ENABLE_X64": "true"}).stdout == "True\n"
    assert len(forked.spent) == before
    assert forked.run(program, [], tmp_path, {**os.environ}).stdout == "False\n"


def test_its_cpu_time_is_counted(tmp_path: Path) -> None:
    forked.run("while __import__('time').process_time() < 0.5: pass", [], tmp_path, os.environ)
    if sys.platform == "linux":
        assert 0.3 < forked.spent[-1] < 5


@pytest.mark.parametrize("environment", [{}, {"JAX_ENABLE_X64": "true"}], ids=["forked", "anew"])
def test_what_hangs_is_killed_with_all_that_it_started(environment: dict[str, str], tmp_path: Path) -> None:
    """It says what it had written, and the next one runs; what has ended in time was not killed."""
    hangs = "import subprocess, time; print('begun', flush=True)"
    hangs += "; subprocess.Popen(['sh', '-c', 'sleep 5; touch late']); time.sleep(60)"
    given = ([], tmp_path, {**os.environ, **environment})
    forked.run("", *given)  # the process that forks has begun
    began = time.monotonic()
    with pytest.raises(TimeoutError, match=r"killed after 3.0 s(.|\n)*\nbegun\n"):
        forked.run(hangs, *given, limit=3.0)
    killed = time.monotonic()
    assert killed - began < 30
    assert forked.run("print('next')", *given, limit=30.0).stdout == "next\n"
    time.sleep(max(0.0, killed + 4 - time.monotonic()))
    assert not (tmp_path / "late").exists()
