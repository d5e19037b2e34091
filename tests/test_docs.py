"""What is documented runs as it stands: every fenced program, file and command of README.md and docs/, page by page.

And pages keep to their form: links that lead somewhere, decisions of four parts, the field's words.

A page has a folder of its own, into which the files that the pages name are written, and in which its commands are run
by a shell, in order. Settings are cut down by PEGASUS_SETTINGS, which is documented, and by nothing else.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import NamedTuple
from urllib.request import urlopen

import jax
import pytest

import forked
from pegasus_jax.runs.config_io import parse, split
from probes import PLAIN_WORDS

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
CODE = [path for top in ("src", "envs", "tests", "benchmarks") for path in sorted((ROOT / top).rglob("*.py"))]


class Block(NamedTuple):
    """A fenced block of a page."""

    kind: str  # python, xml, c, math, or "" for commands
    text: str
    file: str  # what the paragraph above calls it, "" for no file


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page that are not mathematics. A file is named by the paragraph above it, if at all."""
    found, text = [], page.read_text()
    for match in re.finditer(r"^```(\w*)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE):
        above = text[: match.start()].rstrip().rpartition("\n\n")[2]
        names = re.findall(r"`(\w+\.(?:py|xml|toml|c))`", above) if match[1] in ("python", "xml", "toml", "c") else []
        found.append(Block(match[1], match[2], names[-1] if names else ""))
    return [block for block in found if block.kind != "math"]


def commands(block: Block) -> list[str]:
    """The lines of a block of commands, those that go on put together, without what only explains them."""
    lines = block.text.replace("\\\n", " ").splitlines()
    return [line.partition("  #")[0].strip() for line in lines if line.strip()]


FILES = [block for page in PAGES for block in blocks(page) if block.file]
USED = re.compile(r"\bruns/")  # a program that reads a run is one of a page's commands
PROGRAMS = [
    pytest.param(block.text, id=f"{page.stem}-{number}", marks=() if page.stem == "README" else pytest.mark.slow)
    for page in PAGES
    for number, block in enumerate(blocks(page))
    if block.kind == "python" and not block.file
]
RUN = [
    pytest.param(page, id=page.stem)
    for page in PAGES
    if any(block.kind in ("", "bash", "sh") for block in blocks(page))
]

# What the commands find in a page's folder, as in a checkout.
CHECKOUT = ("Makefile", "pyproject.toml", "requirements.lock", "benchmarks", "src", "envs")
# What is not run here, each with the reason; its words are checked all the same.
NOT_RUN = {
    "make test": "it would run this test again",
}
SERVES = "pegasus-watch "  # until a person ends it
# Pages of which each command is a new process, as a reader's is; of the others our commands begin as forked.py says.
ANEW = ("README", "quickstart")
OURS = re.compile(r"pegasus-[^;&|<>`$]*")  # and nothing else that a shell would do
TINY = "fit.steps=3 search.steps=4"
SMALL = {  # a part of a command -> a setting that makes it small, unless the command is about that
    "model=": "model.hidden=[8]",
    "policy=": "policy.hidden=[8]",
    "algorithm=pilco": "search.particles=8",
    "eval_episodes=": "eval_episodes=1",
}
# What a command does with these is no matter of the search, which compiles in half the time without its extras.
BEGUN_WITH = ("data=", "init=", "prior=")


def cut(command: str) -> str:
    """Settings that make a command quick. Learning takes place for `make train` and for the robot only."""
    words = command.split()
    if words[0] not in ("make", "pegasus-train"):
        return ""
    if any(word.startswith("resume=") for word in words):  # of a run that was cut down already
        return f"{TINY} trials=2"
    learns = words[0] == "make" or "env=robot:Arm-v0" in words
    small = [setting for about, setting in SMALL.items() if about not in command]
    if any(word.startswith(BEGUN_WITH) for word in words):
        small += PLAIN_WORDS
    return " ".join([TINY, *small, "explore.trials=2", "trials=2" if learns else "trials=1"])


def scripts() -> dict[str, str]:
    """The programs of the commands of pyproject.toml."""
    told = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    places = {name: where.split(":") for name, where in told.items()}
    return {
        name: f"import sys\nfrom {module} import {function}\nsys.exit({function}())\n"
        for name, (module, function) in places.items()
    }


@pytest.fixture(scope="module")
def tools(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of a shell in which this interpreter and the commands of pyproject.toml are found."""
    folder = tmp_path_factory.mktemp("tools")
    (folder / "bin").mkdir()
    for name, program in scripts().items():
        (folder / "bin" / name).write_text(f"#!{sys.executable}\n{program}")
    python = folder / "bin" / "python"  # not a link: it would not know its environment
    python.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} "$@"\n')
    (folder / ".installed").touch()
    for program in (folder / "bin").iterdir():
        program.chmod(0o755)
    of_make = ("MAKEFLAGS", "MFLAGS", "ARGS")  # of the make that runs these tests, and no words for that of a page
    return {
        **{name: value for name, value in os.environ.items() if name not in of_make},
        "PATH": f"{folder / 'bin'}:{os.environ['PATH']}",
        "PYTHONPATH": f"{ROOT / 'src'}:{ROOT / 'envs'}",
        "XDG_CACHE_HOME": str(folder / "cache"),
        "VENV": str(folder),  # for make, to which this is an environment where everything is installed
    }


def shell(command: str, folder: Path, environment: dict[str, str]) -> None:
    done = subprocess.run(
        ["sh", "-c", command], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"


def forks(command: str, folder: Path, environment: dict[str, str]) -> None:
    """A command of ours, with the words that a shell makes of it."""
    split = subprocess.run(
        ["sh", "-c", f"printf '%s\\n' {command}"], cwd=folder, capture_output=True, text=True, check=True
    )
    name, *words = split.stdout.splitlines()
    done = forked.run(f"import sys; sys.argv[0] = {name!r}\n{scripts()[name]}", words, folder, environment)
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"


@pytest.mark.slow
@pytest.mark.parametrize("page", RUN)
def test_a_page_runs_from_the_top_to_the_end(page: Path, tmp_path: Path, tools: dict[str, str]) -> None:
    if any(block.kind == "c" for block in blocks(page)) and not shutil.which("cc"):
        pytest.skip("the page compiles C, and there is no cc")
    for name in CHECKOUT:
        (shutil.copytree if (ROOT / name).is_dir() else shutil.copy2)(ROOT / name, tmp_path / name)
    own = {block.file for block in blocks(page)}
    for block in FILES:  # what this page takes from another one
        if block.file not in own:
            append(tmp_path / block.file, block.text)
    for block in blocks(page):
        if block.file:
            append(tmp_path / block.file, block.text)
        if block.file and USED.search(block.text):
            shell(f"python {block.file}", tmp_path, tools)
        for command in commands(block) if block.kind in ("", "bash", "sh") else ():
            if command.startswith(SERVES):
                watched(command, tmp_path, tools)
            elif command not in NOT_RUN:
                begin = forks if page.stem not in ANEW and OURS.fullmatch(command) else shell
                begin(command, tmp_path, {**tools, "PEGASUS_SETTINGS": cut(command)})


def watched(command: str, folder: Path, environment: dict[str, str]) -> None:
    """A command that serves a page until Ctrl-C; on any port, as another test may have its own."""
    words = shlex.split(f"exec {command} port=0")
    process = subprocess.Popen(
        shlex.join(words),
        shell=True,
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    address = process.stdout.readline().split()[0]
    assert urlopen(f"{address}/content").status == 200
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert (process.returncode, error) == (130, "stopped; the run goes on\n")


def append(path: Path, text: str) -> None:
    """Write a file, or go on with it, as somebody who reads the page from the top would."""
    path.write_text(path.read_text() + "\n" + text if path.exists() else text)


@pytest.mark.parametrize("command", NOT_RUN)
def test_what_is_not_run_is_documented_and_there(command: str, tools: dict[str, str]) -> None:
    assert any(command in commands(block) for page in PAGES for block in blocks(page))
    shell(f"{command} --dry-run", ROOT, tools)


@pytest.mark.parametrize("program", PROGRAMS)
def test_example_runs(program: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with jax.debug_key_reuse(False):  # vmap of a scan over split keys is its one false alarm (conftest.py)
        exec(compile(program, "example", "exec"), {"__name__": "example"})


METHOD = (ROOT / "docs" / "method.md").read_text()
# A section's code: [`file`](path) `name`, `name`; [`file`](path) ...
CITED = [
    pytest.param(ROOT / "docs" / path, names, id=path.rpartition("/")[2] + f"-{i}")
    for i, code in enumerate(re.findall(r"^Code: (.*?)\n\n", METHOD, re.DOTALL | re.MULTILINE))
    for path, names in re.findall(r"\]\((\S+\.py)\)([^\[]*)", code)
]


@pytest.mark.parametrize(("path", "names"), CITED)
def test_method_cites_code_that_exists(path: Path, names: str) -> None:
    code = path.read_text()
    for name in re.findall(r"`(\w+)`", names):
        assert re.search(rf"^\s*(def|class) {name}\b|^{name}\b.* = ", code, re.MULTILINE), f"no {name} in {path.name}"


def test_method_cites_sections_of_the_reference_that_exist() -> None:
    reference = (ROOT / "docs" / "reference.md").read_text()
    sections = set(re.findall(r"^##+ (\d+(?:\.\d+)?) ", reference, re.MULTILINE))
    sources = [path.read_text() for top in ("src", "envs", "tests") for path in (ROOT / top).rglob("*.py")]
    cited = {n for text in sources for n in re.findall(r"docs/reference\.md (\d+(?:\.\d+)?)", text)}
    cited |= {n for group in re.findall(r"\bR (\d[\d., ]*)", METHOD) for n in re.findall(r"\d+(?:\.\d+)?", group)}
    assert cited
    assert cited <= sections


@pytest.mark.parametrize("command", sorted(set(re.findall(r"`pegasus-train (.*?)`", METHOD))))
def test_method_commands_are_settings(command: str) -> None:
    _, settings = split(command.split())
    parse(settings)


def test_the_first_page_is_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120


def test_every_block_is_a_program_a_file_or_commands() -> None:
    for page in PAGES:
        for block in blocks(page):
            assert block.kind in ("", "bash", "sh", "python", "xml", "toml", "c"), f"{page.name}: {block.kind}"
            if block.kind in ("xml", "toml", "c"):
                assert block.file, f"{page.name} does not say what the file is called: {block.text[:40]}"
            for command in commands(block) if block.kind in ("", "bash", "sh") else ():
                assert shlex.split(command)[0].startswith(("pegasus-", "make", "python", "cc")), command
    of_plants = {"mymodule.py", "arm.xml", "robot.py", "drive.py", "encoder.py", "simulator.py", "trolley.py"}
    assert {block.file for block in FILES} == of_plants | {
        "lean.py",
        "on_robot.py",
        "robot.c",
        "in_runtimes.py",
        "handed_on.py",
        "hand.py",
        "rows.py",
    }
    assert len(PROGRAMS) >= 4


# The form of the pages


def links(page: Path) -> list[str]:
    """Where the relative links of a page lead, without the part of a page after #."""
    found = re.findall(r"\]\(([^)\s]+)\)", page.read_text())
    return [link.partition("#")[0] for link in found if not link.startswith(("http", "#"))]


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CONTRIBUTING.md"], ids=lambda page: page.stem)
def test_links_lead_to_files(page: Path) -> None:
    assert [link for link in links(page) if not (page.parent / link).exists()] == []


def test_programs_and_files_that_pages_name_exist() -> None:
    """`python -m benchmarks.study` and `tests/test_layers.py`, in any page."""
    text = "\n".join(page.read_text() for page in [*PAGES, ROOT / "CONTRIBUTING.md"])
    modules = set(re.findall(r"python -m ((?:benchmarks|tests)(?:\.\w+)+)", text))
    assert len(modules) > 10
    there = [[ROOT.joinpath(*name.split(".")).with_suffix(".py"), ROOT.joinpath(*name.split("."))] for name in modules]
    assert [paths[0] for paths in there if not any(path.exists() for path in paths)] == []
    files = set(re.findall(r"`((?:src|envs|tests|benchmarks)/[\w/]+\.\w+)`", text))
    assert [name for name in files if "NAME" not in name and not (ROOT / name).exists()] == []


DECISIONS = re.split(r"^## (?=\d{4} )", (ROOT / "docs" / "decisions.md").read_text(), flags=re.MULTILINE)[1:]


@pytest.mark.parametrize("decision", DECISIONS, ids=lambda text: text[:4])
def test_a_decision_is_short_and_has_its_parts(decision: str) -> None:
    assert re.findall(r"^\*\*(\w+)\.\*\*", decision, re.MULTILINE) == ["Context", "Decision", "Consequence", "Status"]
    assert re.search(r"^\*\*Status\.\*\* (Accepted|Superseded by)\b", decision, re.MULTILINE)
    assert len(decision.split()) <= 150


def test_decisions_that_are_cited_exist() -> None:
    """By their numbers, from code, figures and pages; one that was superseded whole has no text."""
    cited = {
        number
        for path in [*CODE, *PAGES, *(ROOT / "benchmarks").rglob("*.toml")]
        if path != Path(__file__)
        for line in path.read_text().splitlines()
        if re.search(r"decisions?\b", line)
        for number in re.findall(r"\b00\d\d\b", line)
    }
    assert len(cited) > 15
    assert cited <= {decision[:4] for decision in DECISIONS} | {"0005"}


def prose(page: Path) -> str:
    """A page without code, commands, links' targets and formulas."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"`[^`]*`|\]\([^)]*\)|\$[^$]*\$", " ", text)


# Words of our own for which the field has others.
PRIVATE = r"anew|stale|rivals?|courses?|abreast|shelf|guests?|troubles?|processors?"


@pytest.mark.parametrize("page", [*PAGES, ROOT / "benchmarks" / "results" / "README.md"], ids=lambda page: page.stem)
def test_pages_use_the_fields_words(page: Path) -> None:
    text = f"{page.stem} {prose(page)}".replace("course work", "")
    assert re.findall(rf"(?i)\b(?:{PRIVATE})\b", text.replace("-", " ")) == []


# The reading order of docs/design.md: | `file` | lines | what it explains |
ORDER = re.findall(r"^\| `(\S+\.py)` \| (\d+) \|", (ROOT / "docs" / "design.md").read_text(), re.MULTILINE)


def test_the_method_can_be_read_in_an_hour() -> None:
    lines = {name: len((ROOT / "src" / "pegasus_jax" / name).read_text().splitlines()) for name, _ in ORDER}
    assert ORDER[0][0] == "types.py"
    assert ORDER[-1][0] == "learn/search.py"
    assert sum(lines.values()) <= 1200
    assert not {name for name, count in lines.items() if count > 200}
    assert lines["learn/search.py"] + lines["learn/schedule.py"] <= 200
    assert {name: lines[name] for name, said in ORDER if abs(lines[name] - int(said)) > 10} == {}
