"""Linux, macOS, Windows: what only some systems have is used where its absence is answered, and that is tried."""

from __future__ import annotations

import ast
import enum
import os
import runpy
import signal
import socket
import subprocess
import sys
import types
from pathlib import Path, PureWindowsPath

import pytest

from pegasus_jax import interrupt, shell
from pegasus_jax.checks import names_code
from pegasus_jax.report import serve
from pegasus_jax.runs import cache, checkpoint, files, groups, machine
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


def test_a_file_that_another_program_reads_is_replaced_a_moment_later(tmp_path: Path, monkeypatch) -> None:
    """Windows refuses it for so long; elsewhere a refusal is one."""
    usual, refusals = os.replace, [1]

    def refusing(new: Path, path: Path) -> None:
        if refusals:
            refusals.pop()
            raise PermissionError(13, "Access is denied", str(new))
        usual(new, path)

    monkeypatch.setattr(os, "replace", refusing)
    monkeypatch.setattr(sys, "platform", "linux")
    with pytest.raises(PermissionError):
        files.write_json(tmp_path / "a.json", 1)
    monkeypatch.setattr(sys, "platform", "win32")
    refusals += [1, 2]
    files.write_json(tmp_path / "a.json", 1)
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]
    refusals.append(1)
    with pytest.raises(PermissionError):
        files.take_place(tmp_path / "a.json", tmp_path / "b.json", seconds=-1)


@pytest.mark.parametrize("system", ["macOS", "Linux", "Windows"])
def test_a_file_is_on_the_disk_in_the_way_of_its_system(system: str, tmp_path: Path, monkeypatch) -> None:
    called: list[str] = []
    fcntl = types.SimpleNamespace(fcntl=lambda handle, command: called.append(command))
    if system == "macOS":
        fcntl.F_FULLFSYNC = "F_FULLFSYNC"
    monkeypatch.setitem(sys.modules, "fcntl", None if system == "Windows" else fcntl)
    monkeypatch.setattr(os, "fsync", lambda handle: called.append("fsync"))
    files.write_json(tmp_path / "a.json", 1)
    assert called[0] == ("F_FULLFSYNC" if system == "macOS" else "fsync")


def test_a_checkpoint_of_windows_is_whole_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    path = PureWindowsPath(r"C:\runs\demo\checkpoints\0001")
    monkeypatch.setattr(checkpoint, "_files", lambda path: [path / "d" / "manifest.ocdbt"])
    monkeypatch.setattr(checkpoint, "_digest", lambda file: "sum")
    assert checkpoint._summed(path) == {"d/manifest.ocdbt": "sum"}


def test_runs_on_two_drives_keep_their_names(monkeypatch: pytest.MonkeyPatch) -> None:
    def windows(paths: list[Path]) -> str:
        raise ValueError("Paths don't have the same drive")

    monkeypatch.setattr(os.path, "commonpath", windows)
    runs = [[types.SimpleNamespace(path=Path(f"/{drive}/demo"))] for drive in "cd"]
    assert [Path(name).parts[-2:] for name in groups._folders(runs)] == [("c", "demo"), ("d", "demo")]


def test_commands_are_written_as_a_shell_of_the_system_reads_them(monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["pegasus-train", r"resume=my runs\arm", "policy.hidden=[50,50]", r"out=runs\arm"]
    assert shell.split(shell.typed(words)) == words
    monkeypatch.setattr(sys, "platform", "win32")
    assert shell.typed(words) == r'pegasus-train "resume=my runs\arm" "policy.hidden=[50,50]" out=runs\arm'
    assert shell.split(shell.typed(words)) == words


def test_two_programs_do_not_serve_at_one_port(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for system, shared in (("linux", True), ("win32", False)):  # there the option means another thing
        monkeypatch.setattr(sys, "platform", system)
        with serve.server([tmp_path], 0) as server:
            assert bool(server.socket.getsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR)) == shared


def test_letters_that_an_output_lacks_are_written_by_their_number() -> None:
    code = (
        "import sys; from pegasus_jax.cli.main import main; sys.argv = ['x', 'y']; main(lambda words: print('θ'), '')"
    )
    environment = {**os.environ, "PYTHONUTF8": "0", "PYTHONIOENCODING": "cp1252"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stdout) == (0, "\\u03b8\n"), done.stderr


def test_compiled_programs_are_kept_where_users_have_no_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "getuid", raising=False)
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
    monkeypatch.delattr(signal, "pthread_kill", raising=False)
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
