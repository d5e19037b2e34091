"""The documentation site builds without a warning and without a network, and nothing in it is missing or too long."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import pegasus_jax as pg
from benchmarks import site, site_reference

ROOT = Path(__file__).resolve().parents[1]
DOCS = sorted((ROOT / "docs").glob("*.md"))
SHAPE = re.compile(r"\[(?:[A-Z]\w*(?: ?[+,] ?\w+)*)?(?:, \.\.\.)?\]|\.shape\b")  # [H, K, D], [] or x.shape
# From words, settings or pieces to settings, files or pieces.
NO_ARRAYS = """Config ConfigError Period RunError TrainState build config controller dynamics_of export minibatches
policy_of preset sampler search_table searcher tasks train"""


GENERATED = re.compile(r"^<!-- generated: .*?^<!-- generated until", re.DOTALL | re.MULTILINE)


def words(page: Path) -> int:
    """How many a person wrote; one has a letter, so that figures in tables are none."""
    return len(re.findall(r"\S*[^\W\d_]\S*", GENERATED.sub("", page.read_text())))


def test_the_pages_are_short() -> None:
    """Together, without what is generated and the page of the Python API; and each alone."""
    counts = {page.name: words(page) for page in DOCS if page.name != "api.md"}
    assert sum(counts.values()) <= 20_000, counts
    assert {page.name: n for page in DOCS if (n := len(page.read_text().splitlines())) > 400} == {}


def test_public_names_have_shapes_and_an_example() -> None:
    """95 % of them, in what the API reference shows of each: docstring, fields and example."""
    shown = site_reference.examples()
    assert {*shown} <= {*pg.__all__}
    complete = {name for name in pg.__all__ if name in shown and documented(name, shown[name])}
    assert len(complete) >= 0.95 * len(pg.__all__), sorted({*pg.__all__} - complete)


def test_every_module_with_public_names_has_a_page_in_the_reference() -> None:
    assert sorted(module for modules in site_reference.GROUPS.values() for module in modules) == sorted(pg._NAMES)


def documented(name: str, example: str) -> bool:
    """Whether a name's docstring says something, and the shapes of what it takes or gives are somewhere."""
    value = getattr(pg, name)
    module = pg._MODULES.get(name)
    fields = " ".join(" ".join(field) for field in site_reference.fields(module, name)) if module else ""
    said = value.__doc__ or ""
    return bool(said.strip()) and (name in NO_ARRAYS.split() or bool(SHAPE.search(f"{said} {fields} {example}")))


# The built pages


class Page(HTMLParser):
    """Where the links and pictures of a page lead, and the anchors in it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.leads: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in ("href", "src") and value:
                self.leads.append(value)
            elif name in ("id", "name") and value:
                self.anchors.add(value)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("site")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(out)]
    done = subprocess.run(
        words, cwd=ROOT, capture_output=True, text=True, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    )
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    return out


@pytest.mark.slow
def test_nothing_in_the_built_pages_is_missing(built: Path) -> None:
    page = cache(lambda path: Page(path.read_text()))
    pages = sorted(built.rglob("*.html"))
    assert len(pages) > 40
    missing = []
    for path in pages:
        for lead in {*page(path).leads} if path.name != "404.html" else ():
            where = urlsplit(lead)
            if where.scheme or where.netloc:
                continue
            target = (path.parent / unquote(where.path)).resolve() if where.path else path
            target = target / "index.html" if target.is_dir() else target
            if not target.exists():
                missing.append(f"{path.relative_to(built)}: {lead}")
            elif where.fragment and target.suffix == ".html" and unquote(where.fragment) not in page(target).anchors:
                missing.append(f"{path.relative_to(built)}: no {lead}")
    assert missing == []


def test_only_pages_to_come_are_missing_in_the_navigation() -> None:
    named = set(re.findall(r": ((?:repository/)?[\w/]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE))
    assert len(named) > 20
    absent = {uri for uri in named if not (ROOT / site.source_of(uri)).exists()}
    assert absent <= {"report.md", "repository/CHANGELOG.md"}


@pytest.mark.slow
def test_the_pages_load_nothing_from_elsewhere_and_hold_no_marks(built: Path) -> None:
    for path in built.rglob("*.html"):
        text = path.read_text()
        assert re.findall(r"<(?:script|img|iframe)[^>]* src=.?https?:", text) == []
        assert re.findall(r"(?:CODE|FORMULA)\d+END", text) == []
    assert "<math" in (built / "method.html").read_text()


@pytest.mark.slow
def test_every_public_name_has_a_place_in_the_reference(built: Path) -> None:
    text = "\n".join(path.read_text() for path in (built / "api").rglob("*.html"))
    anchors = set(re.findall(r'id="(pegasus_jax[\w.]*)"', text))
    names = {f"pegasus_jax.{module}.{name}" for name, module in pg._MODULES.items()}
    assert names | {f"pegasus_jax.{module}" for module in pg._FAMILIES.values()} <= anchors
