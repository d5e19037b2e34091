"""Help and completion: made of one table of words, tried in the shells themselves where they are installed."""

from __future__ import annotations

import os
import re
import select
import shutil
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

from pegasus_jax.cli import completion, help, main, version, words
from pegasus_jax.config import Config
from pegasus_jax.runs import config_io

ROOT = Path(__file__).resolve().parents[1]


def said(capsys: pytest.CaptureFixture[str], *typed: str) -> tuple[int, str]:
    """The exit status of pegasus-train with these words, and all that it printed."""
    code = main._code(lambda words: None, typed, help.TRAIN)
    printed = capsys.readouterr()
    return code, printed.out + printed.err


def shown_in(text: str) -> list[str]:
    """The words of the lines of a help."""
    return re.findall(r"^  ([a-z0-9_.]+)=\S* +\S", text.partition("examples")[0], re.MULTILINE)


def test_help_has_fifteen_words_and_all_help_has_every_one(capsys) -> None:
    code, first = said(capsys, "--help")
    assert (code, shown_in(first)) == (0, [*words.FIRST])
    assert len(words.FIRST) == 15
    assert said(capsys) == (2, first)  # so does a command without words
    _, every = said(capsys, "--help=all", "task=gym")
    assert {*shown_in(every)} == {*words.of_train()}
    titles = [line for line in every.splitlines() if line in words.GROUPS]
    assert titles == [*words.GROUPS]
    assert max(map(len, (first + every).splitlines())) <= 120
    code, wrong = said(capsys, "--help=everything")
    assert code == 2
    assert "did you mean '--help=all'" in wrong


def test_each_word_is_in_one_group_and_its_values_are_values() -> None:
    known = words.of_train()
    placed = [word for of in words.grouped(known).values() for word in of]
    assert sorted(placed) == sorted(known)
    assert {*words.VALUES} <= {*known}
    for word in ("search.matching", "search.init", "model.dropout", "policy.squash", "explore.kind", "successor"):
        for value in words.values(word):
            refine = {"search.refine_fraction": "0.5"} if word == "search.init" else {}
            config_io.parse({"preset": "cartpole_network", word: value} | refine)
    assert words.values("x64") == ("true", "false")
    assert words.values("trials") == ()


def test_completion_knows_every_command() -> None:
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert {*completion.commands()} == {*scripts} - {"pegasus-figures", "pegasus-completion"}


def runs_here(shell: str, command: str = "true") -> bool:
    """Whether a shell is here and a command succeeds in it: the bash of Windows is that of another system, or none."""
    found = os.name == "posix" and shutil.which(shell)
    return bool(found) and subprocess.run([found, "-c", command], capture_output=True).returncode == 0


PERIODS = [f"{name}=" for name in config_io.leaves(Config().search.period, "search.period.")]
# What is typed, and what completes it; a folder `demo folder` and a file `arm.xml` are there.
TYPED = [
    ("pegasus-train tas", ["task="]),
    ("pegasus-train task=cart", ["cartpole"]),
    ("pegasus-train model=de", ["deterministic"]),
    ("pegasus-train task=mjcf mjcf=ar", ["arm.xml"]),
    ("pegasus-train task=cartpole search.pe", PERIODS),
    ("pegasus-eval js", ["json="]),
    ("pegasus-eval json=t", ["true"]),
    ("pegasus-plot dem", ["demo folder"]),
    ("pegasus-export demo format=st", ["stablehlo"]),
    ("pegasus-train nothing=", []),
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "demo folder").mkdir()
    (tmp_path / "arm.xml").touch()
    for shell, script in completion.SHELLS.items():
        (tmp_path / f"words.{shell}").write_text(script())
    return tmp_path


@pytest.mark.skipif(not runs_here("bash", "((BASH_VERSINFO[0] > 3))"), reason="no bash, or the bash 3 of macOS")
def test_bash_completes(folder: Path) -> None:
    ask = """line="$1"; COMP_LINE="$line" COMP_POINT=${#line} COMP_WORDBREAKS=$' =:'; _pegasus "${line%% *}"
             printf '%s\\n' "${COMPREPLY[@]}" """
    for typed, expected in TYPED:
        script = f"source words.bash; {ask}"
        done = subprocess.run(["bash", "-uc", script, "_", typed], cwd=folder, capture_output=True, text=True)
        assert done.stderr.replace("bash: line", "") == "", typed
        assert sorted(filter(None, done.stdout.split("\n"))) == sorted(expected), typed


@pytest.mark.skipif(not runs_here("fish"), reason="no fish")
def test_fish_completes(folder: Path) -> None:
    for typed, expected in TYPED:
        script = f"source words.fish; complete -C '{typed}'"
        environment = {**os.environ, "HOME": str(folder)}
        done = subprocess.run(["fish", "-c", script], cwd=folder, capture_output=True, text=True, env=environment)
        found = [line.partition("\t")[0].rstrip("/") for line in done.stdout.splitlines()]
        key = typed.rpartition(" ")[2].partition("=")
        assert sorted(found) == sorted(f"{key[0]}={word}" if key[1] else word for word in expected), typed


@pytest.mark.skipif(not runs_here("zsh"), reason="no zsh")
def test_zsh_completes(folder: Path) -> None:
    """At a terminal: a word is typed, then a tabulator, and the line is what zsh makes of it."""
    start = "PS1='> '; autoload -Uz compinit; compinit -u -D; source ./words.zsh; echo rea'dy'\n"
    import pty  # Windows has none, nor a zsh

    terminal, inside = pty.openpty()
    environment = {**os.environ, "TERM": "dumb", "HOME": str(folder)}
    ends = dict(stdin=inside, stdout=inside, stderr=inside)
    shell = subprocess.Popen(["zsh", "-f", "-i"], cwd=folder, env=environment, start_new_session=True, **ends)
    try:
        os.write(terminal, start.encode())
        heard(terminal, "ready")
        for typed, expected in [(typed, found[0]) for typed, found in TYPED if len(found) == 1]:
            key, equals, _ = typed.rpartition(" ")[2].partition("=")
            line = f"{key}={expected}" if equals else expected
            os.write(terminal, f"\x15{typed}\t".encode())
            heard(terminal, typed.rpartition(" ")[0] + " " + line.replace(" ", "\\ "))
    finally:
        shell.kill()
        shell.wait()
        os.close(terminal)
        os.close(inside)


def heard(terminal: int, text: str) -> None:
    """Read what a terminal shows until this is there."""
    shown, end = "", time.monotonic() + 20
    while text not in re.sub(r"\x1b\[[0-9;?]*\w|\r|\x08|\x07", "", shown):
        assert time.monotonic() < end, f"{text!r} does not come after {shown[-300:]!r}"
        if select.select([terminal], [], [], 0.2)[0]:
            shown += os.read(terminal, 4096).decode(errors="replace")


def test_the_completion_of_an_unknown_shell_is_refused() -> None:
    code = "from pegasus_jax.cli.completion import completion; completion()"
    done = subprocess.run([sys.executable, "-c", code, "bsh"], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert "did you mean 'bash'" in done.stderr


def test_a_word_that_is_given_twice_is_refused_by_every_command(capsys, tmp_path, monkeypatch) -> None:
    code, text = said(capsys, "task=cartpole", "trials=2", "seed=1", "trials=5")
    assert (code, text) == (2, "pegasus: trials= is given 2 times, trials=2 and trials=5; give it once\n")
    assert "given 3 times" in said(capsys, "seed=1", "seed=1", "seed=1")[1]
    monkeypatch.setattr(main, "_remember_compilations", lambda: None)
    monkeypatch.chdir(tmp_path)
    for folder in ("lr=1", "lr=2"):  # as other tools name them
        (tmp_path / folder).mkdir()
    assert said(capsys, "env_args.low=1", "env_args.high=1", "lr=1", "lr=2")[0] == 0
    code = main._code(lambda words: None, ["trials=2"], help.TRAIN, lambda: ["trials=1"])  # PEGASUS_SETTINGS changes it
    assert (code, capsys.readouterr().err) == (0, "")
    assert main._code(lambda words: None, ["seed=2"], help.TRAIN, lambda: ["trials=1", "trials=2"]) == 2


def test_the_version_is_told_with_what_a_report_of_a_problem_needs(capsys) -> None:
    code, text = said(capsys, "--version")
    assert code == 0
    assert re.fullmatch(r"pegasus-jax \S+\n", text)
    told = dict(line.split(maxsplit=1) for line in version.told(["--version", "--verbose"]).splitlines())
    assert {"python", "platform", "devices", "pegasus-jax", "jax", "jaxlib", "mujoco", "onnx"} <= {*told}
    assert not {"pytest", "ruff"} & {*told}
