"""The code in the documentation runs as it stands."""

import re
from pathlib import Path

import jax
import pytest

from pegasus_jax.settings import parse, split

ROOT = Path(__file__).resolve().parents[1]
BLOCKS = [
    pytest.param(block, id=f"{page.name}-{i}")
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    for i, block in enumerate(re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL))
]


@pytest.mark.parametrize("block", BLOCKS)
def test_example_runs(block: str) -> None:
    with jax.debug_key_reuse(False):  # vmap of a scan over split keys is its one false alarm (conftest.py)
        exec(compile(block, "example", "exec"), {"__name__": "example"})


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


def test_there_are_examples() -> None:
    assert len(BLOCKS) >= 4
