"""Linux, macOS, Windows: what only some systems have is used where its absence is answered, and that is tried."""

from __future__ import annotations

import ast
import enum
import os
import runpy
import signal
import sys
from pathlib import Path

import pytest

from pegasus_jax import interrupt
from pegasus_jax.checks import names_code
from pegasus_jax.runs import cache, files, machine
from pegasus_jax.tasks.guide import is_folder

ROOT = Path(__file__).resolve().parents[1]

# What Windows lacks, and macOS some of it.
LACKING = {
    "os": "chown fork getegid geteuid getgid getuid getpgid kill killpg mkfifo nice sched_getaffinity setsid uname",
    "signal": "SIGHUP SIGKILL SIGUSR1 SIGUSR2 SIGALRM alarm pause pthread_kill pthread_sigmask setitimer",
}
MODULES = {"fcntl", "grp", "pty", "pwd", "resource", "termios", "tty"}


def asked_without_answer(source: str) -> list[str]:
    """What of that a program uses outside the body of a `try`."""
    tree = ast.parse(source)
    answered = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.Try) and node.handlers
        for statement in node.body
        for inner in ast.walk(statement)
    }
    found = []
    for node in ast.walk(tree):
        if node in answered:
            continue
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if node.attr in LACKING.get(node.value.id, "").split():
                found.append(f"{node.value.id}.{node.attr}")
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names]
            found += sorted(MODULES & {*names})
    return found


def test_what_a_system_may_lack_has_another_way() -> None:
    sources = [path for top in ("src", "envs") for path in (ROOT / top).rglob("*.py")]
    assert len(sources) > 120
    found = {path.name: asked_without_answer(path.read_text(encoding="utf-8")) for path in sources}
    assert {name: what for name, what in found.items() if what} == {}
    assert asked_without_answer("import fcntl\nos.getuid()\nsignal.signal(signal.SIGHUP, f)") == [
        *("fcntl", "os.getuid", "signal.SIGHUP")
    ]
    assert not asked_without_answer("try:\n    os.getuid()\nexcept AttributeError:\n    pass")


def test_text_of_files_has_an_encoding() -> None:
    """Else it is the system's: Windows has several."""
    for path in (path for top in ("src", "envs") for path in (ROOT / top).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                said = {keyword.arg for keyword in node.keywords}
                plain = node.func.attr in ("read_text", "write_text") and "encoding" not in said
                assert not plain, f"{path.name}:{node.lineno}"


def test_files_are_written_where_no_folder_can_be_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usual = os.open

    def windows(path: Path, *rest: int) -> int:
        if Path(path).is_dir():
            raise PermissionError(13, "Permission denied", str(path))
        return usual(path, *rest)

    monkeypatch.setattr(os, "open", windows)
    files.write_json(tmp_path / "inner" / "a.json", {"a": 1})
    assert (tmp_path / "inner" / "a.json").read_bytes() == b'{\n "a": 1\n}\n'
    assert [path.name for path in (tmp_path / "inner").iterdir()] == ["a.json"]


def test_compiled_programs_are_kept_where_users_have_no_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "getuid")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path))
    folder = cache.folder()
    assert folder == str(tmp_path / "pegasus_jax")
    assert cache.problem(Path(folder)) is None
    Path(folder).chmod(0o777)  # as every folder of Windows looks
    assert cache.problem(Path(folder)) is None


def test_cpus_are_counted_and_named_without_linux(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    assert machine.cpus() == os.cpu_count()
    machine.cpu.cache_clear()
    monkeypatch.setattr(machine.Path, "read_text", lambda *_, **__: (_ for _ in ()).throw(FileNotFoundError()))
    assert [*machine.cpu()] == ["model name"]
    machine.cpu.cache_clear()


def test_signals_are_those_that_the_system_has(monkeypatch: pytest.MonkeyPatch) -> None:
    windows = enum.IntEnum("Signals", {"SIGINT": 2, "SIGTERM": 15, "SIGBREAK": 21})
    monkeypatch.setattr(signal, "Signals", windows)
    found = runpy.run_path(interrupt.__file__)["SIGNALS"]
    assert [one.name for one in found] == ["SIGINT", "SIGTERM", "SIGBREAK"]
    heard: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: heard.append(number))
    monkeypatch.delattr(signal, "pthread_kill")
    try:
        interrupt.to_main_thread(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)
    assert heard == [2]


def test_a_terminal_without_termios_keeps_what_was_typed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "termios", None)
    assert interrupt.forget_input() is None


def test_a_path_of_windows_names_no_code() -> None:
    paths = ("C:\\runs\\demo", "C:/runs/demo", "/runs/demo", "runs/demo", r"\\host\runs")
    assert not any(map(names_code, paths))
    assert all(map(is_folder, paths))
    assert all(map(names_code, ("robot:cost", "my.robot:cost", "package:Arm-v0")))
    assert not any(map(is_folder, ("robot:swing", None)))
