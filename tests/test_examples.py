"""The examples run as they stand, in a folder of their own and by the commands of their README, cut down by words."""

import ast
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from probes import PLAIN_WORDS
from test_docs import blocks, commands, shell, tools  # noqa: F401 (tools is a fixture)

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "examples"
SCRIPTS = sorted(EXAMPLES.glob("*.py"))
PAGES_HAVE_NOT = ("own_model_in_jit", "own_robot")  # what the others do, pages do too
COMMANDS = [command for block in blocks(EXAMPLES / "README.md") for command in commands(block)]
SMALL = "trials=2 fit=3 search=2"  # of a script's own words
# Of a command.
SETTINGS = " ".join(["trials=2 fit.steps=3 search.steps=4 model.hidden=[8] policy.hidden=[8]", *PLAIN_WORDS])


def cut(command: str) -> str:
    """The command with words that make it quick. One is quick as it is, and the script of a controller takes none."""
    more = {"cartpole.py": "", "own_mjcf.py": "", "study.py": " seeds=2"}.get(command.removeprefix("python "))
    return command if more is None else f"{command} {SMALL}{more}"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The examples where somebody copied them to."""
    return shutil.copytree(EXAMPLES, tmp_path / "examples")


def commands_of(script: Path) -> list[str]:
    """README's commands for a script: what teaches its controller comes first."""
    return [command for command in COMMANDS if re.search(rf"\b{script.stem}\b", command)]


@pytest.mark.slow
@pytest.mark.parametrize(
    "script",
    [
        pytest.param(path, id=path.stem, marks=() if path.stem in PAGES_HAVE_NOT else pytest.mark.campaign)
        for path in SCRIPTS
    ],
)
def test_an_example_runs_as_it_stands(script: Path, folder: Path, tools: dict[str, str]) -> None:  # noqa: F811
    before = {path.name for path in folder.iterdir()}
    for command in commands_of(script):
        shell(cut(command), folder, {**tools, "PEGASUS_SETTINGS": SETTINGS})
    written = {path.name for path in folder.iterdir()} - before - {"__pycache__", "runs"}
    assert written == {*re.findall(r"\b\w+\.(?:png|csv)\b", ast.get_docstring(ast.parse(script.read_text())) or "")}


def test_a_readers_first_scripts_are_short_and_use_public_names_alone() -> None:
    assert len(SCRIPTS) == 5
    for script in SCRIPTS:
        text = script.read_text()
        assert len(text.splitlines()) <= 80, script.name
        assert re.findall(r"^(?:import|from) (pegasus_\w+.*)$", text, re.MULTILINE) == ["pegasus_jax as pg"], (
            script.name
        )
        assert commands_of(script), f"README.md has no command for {script.name}"
        assert f"`{script.name}`" in (EXAMPLES / "README.md").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("program", sorted((EXAMPLES / "api").glob("*.py")), ids=lambda path: path.stem)
def test_the_examples_of_the_api_reference_run(program: Path, tmp_path: Path, tools: dict[str, str]) -> None:  # noqa: F811
    shell(f"python {program}", tmp_path, tools)


@pytest.mark.campaign
def test_a_model_of_ones_own_learns(folder: Path, tools: dict[str, str]) -> None:  # noqa: F811
    """Its first episode is random; from the second on the cart is brought to its goal, as the model expected."""
    shell("python own_model_in_jit.py > said", folder, tools)
    costs, errors = np.array(re.findall(r"cost (.*), errors (.*) times", (folder / "said").read_text()), float).T
    assert costs[0] > 0.8
    assert (costs[1:] < 0.5).all()
    assert ((errors[1:] > 0.3) & (errors[1:] < 3)).all()


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_stands_in_the_script_too(command: str) -> None:
    """Word by word; what a script can be told beside it stands there in brackets."""
    (script,) = [path for path in SCRIPTS if path.name in command or f"{path.stem}:" in command]
    said = " ".join((ast.get_docstring(ast.parse(script.read_text()), clean=False) or "").replace("\\", " ").split())
    assert " ".join(command.split()) in said
