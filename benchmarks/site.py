"""What is ours of the documentation site: mkdocs.yml names this file as its hook, and `make docs` builds it.

* Pages link to files where they lie in a checkout, so that a link works on GitHub too. What lies outside of docs/
  becomes a part of the site, under repository/: pages and pictures as they are, programs as pages that show them.
* Formulas become MathML, which browsers draw without a script.
* The pages of the API reference are those of site_reference.py.
"""

import posixpath
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import latex2mathml.converter
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]  # MkDocs knows this file alone

from benchmarks.site_reference import PROGRAMS, api_page, api_uris  # noqa: E402

OUTSIDE = "repository/"
SHOWN = {".py": "python", ".toml": "toml", ".xml": "xml", ".cff": "yaml"}  # programs that become pages
LINK = re.compile(r"(?<=\]\()(?!https?:|mailto:|#)([^)\s#]+)(?=[)#])")
CODE = re.compile(r"^```.*?^```$|``.+?``|`[^`\n]+`", re.DOTALL | re.MULTILINE)
DISPLAY = re.compile(r"^```math\n(.*?)^```$", re.DOTALL | re.MULTILINE)
INLINE = re.compile(r"(?<![\\$])\$(?!\s)([^$]+?)(?<!\s)\$")


def on_config(config: Any) -> Any:
    """The pages of the API take their place in the navigation, and one that is not there leaves it."""
    config.nav = list(present(config.nav))
    return config


def present(nav: list[Any]) -> Iterator[Any]:
    """The entries of a navigation whose pages are there, with those of the API."""
    for entry in nav:
        ((title, target),) = entry.items()
        if isinstance(target, list):
            yield {title: list(present(target))}
        elif target == "!api":
            yield {title: [{title: uri} for title, uri in api_uris().items()]}
        elif (ROOT / source_of(target)).exists():
            yield entry


def on_files(files: Files, config: Any) -> Files:
    """Add the pages of the API, and whatever pages link to outside of docs/."""
    for title, uri in api_uris().items():
        files.append(File.generated(config, uri, content=api_page(title)))
    waiting = [file for file in files if file.is_documentation_page() and not file.src_uri.startswith("api/")]
    wanted = {uri.removeprefix(OUTSIDE) for uri in uris(config.nav) if uri.startswith(OUTSIDE)} | {*PROGRAMS}
    while wanted or waiting:
        for path in sorted(wanted):
            uri = uri_of(path)
            if uri.startswith(OUTSIDE) and files.get_file_from_path(uri) is None:
                file = outside(path, uri, config)
                files.append(file)
                waiting += [file] if path.endswith(".md") else []
        wanted = set()
        if waiting:
            page = waiting.pop()
            wanted = {path for link in LINK.findall(page.content_string) if (path := path_of(page.src_uri, link))}
    return files


def uris(nav: Any) -> Iterator[str]:
    """The pages that the navigation names."""
    if isinstance(nav, str):
        yield nav
    else:
        for part in nav.values() if isinstance(nav, dict) else nav:
            yield from uris(part)


def path_of(uri: str, link: str) -> str | None:
    """The file in the checkout that a page's link leads to, a folder's README.md for a folder; None: there is none."""
    path = posixpath.normpath(posixpath.join(posixpath.dirname(source_of(uri)), link))
    path = posixpath.join(path, "README.md") if (ROOT / path).is_dir() else path
    return path if not path.startswith("..") and (ROOT / path).is_file() else None


def source_of(uri: str) -> str:
    """Where a page of the site is in the checkout."""
    return uri.removeprefix(OUTSIDE) if uri.startswith(OUTSIDE) else f"docs/{uri}"


def uri_of(path: str) -> str:
    """Where a file of the checkout is in the site."""
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    return f"{OUTSIDE}{path}.md" if posixpath.splitext(path)[1] in SHOWN else f"{OUTSIDE}{path}"


def outside(path: str, uri: str, config: Any) -> File:
    """A file of the checkout as one of the site; a program as a page that shows it."""
    language = SHOWN.get(posixpath.splitext(path)[1])
    if language is None:
        return File.generated(config, uri, abs_src_path=str(ROOT / path))
    text = (ROOT / path).read_text()
    page = f"---\nsearch:\n  exclude: true\n---\n# {path}\n\n````{language}\n{text}````\n"
    return File.generated(config, uri, content=page)


# A page's text

_formulas: dict[str, list[str]] = {}


def on_page_markdown(markdown: str, *, page: Any, config: Any, files: Files) -> str:
    """Lead links to where their files are in the site, and put a mark in the place of each formula."""
    uri, found = page.file.src_uri, _formulas.setdefault(page.file.src_uri, [])
    if uri.startswith("api/") or uri.removesuffix(".md").endswith(tuple(SHOWN)):
        return markdown

    def mark(latex: str, display: str) -> str:
        found.append(latex2mathml.converter.convert(latex.strip(), display=display))
        return f"FORMULA{len(found) - 1}END"

    def to_site(match: re.Match[str]) -> str:
        path = path_of(uri, match[1])
        return match[1] if path is None else posixpath.relpath(uri_of(path), posixpath.dirname(uri))

    def in_text(text: str) -> str:
        return INLINE.sub(lambda match: mark(match[1], "inline"), LINK.sub(to_site, text))

    markdown = DISPLAY.sub(lambda match: mark(match[1], "block"), markdown)
    return outside_code(markdown, in_text)


def outside_code(markdown: str, change: Callable[[str], str]) -> str:
    """The text with everything changed that is no code. A link's text may be code: only what is around it changes."""
    marks, kept = [], []

    def keep(match: re.Match[str]) -> str:
        kept.append(match[0])
        marks.append(f"CODE{len(kept) - 1}END")
        return marks[-1]

    text = change(CODE.sub(keep, markdown))
    return re.sub(r"CODE(\d+)END", lambda match: kept[int(match[1])], text)


def on_page_content(html: str, *, page: Any, config: Any, files: Files) -> str:
    """The formulas in the places of their marks."""
    found = _formulas.get(page.file.src_uri, [])
    return re.sub(r"FORMULA(\d+)END", lambda match: found[int(match[1])], html)
