"""One HTML page that needs nothing else: its style, its contents, and small pieces of HTML."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from typing import NamedTuple

from pegasus_jax.report.style import STYLE

GENERATOR = '<meta name="generator" content="pegasus-report">'  # by which a report is known as one


class Section(NamedTuple):
    """A part of a page."""

    name: str  # its address in the page
    title: str
    html: str


def page(title: str, lead: str, sections: Sequence[Section], script: str = "") -> str:
    """A page: a title, what it is of, a table of contents, the sections. `script` is JavaScript at its end."""
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">{GENERATOR}'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<meta name="color-scheme" content="light dark"><title>{escape(title)}</title>'
        '<link rel="icon" href="data:,">'
        f'<style>{STYLE}</style></head><body><div id="content">{content(title, lead, sections)}</div>'
        + (f"<script>{script}</script>" if script else "")
        + "</body></html>\n"
    )


def content(title: str, lead: str, sections: Sequence[Section]) -> str:
    """What is on a page."""
    links = "".join(f'<li><a href="#{part.name}">{escape(part.title)}</a></li>' for part in sections)
    parts = "".join(
        f'<section id="{part.name}"><h2>{escape(part.title)}</h2>{part.html}</section>' for part in sections
    )
    return (
        f'<nav aria-label="contents"><b>Contents</b><ol>{links}</ol></nav>'
        f"<main><header><h1>{escape(title)}</h1>{lead}</header>{parts}</main>"
    )


def table(head: Sequence[str], rows: Sequence[Sequence[str]], style: str = "") -> str:
    """A table of cells that are HTML already."""
    titles = "".join(f"<th>{cell}</th>" for cell in head)
    lines = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table class="{style}"><tr>{titles}</tr>{lines}</table></div>'


def facts(pairs: Sequence[tuple[str, str]]) -> str:
    """Names and values, one above the other."""
    return (
        '<dl class="cards">' + "".join(f"<div><dt>{name}</dt><dd>{value}</dd></div>" for name, value in pairs) + "</dl>"
    )


def fold(title: str, html: str, *, name: str = "", opened: bool = False) -> str:
    """What a person opens by a click."""
    return f'<details id="{name}"{" open" if opened else ""}><summary>{title}</summary>{html}</details>'


def data(kind: str, content: bytes) -> str:
    """The address of something that is in the page itself."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def downloads(files: Mapping[str, str]) -> str:
    """Links that save files which are in the page: name -> CSV."""
    links = [
        f'<a class="file" download="{escape(name)}" href="{data("text/csv", text.encode())}">{escape(name)}</a>'
        for name, text in files.items()
    ]
    return f"<p>Every curve of this page:</p><p>{''.join(links)}</p>"


def number(value: float | None, form: str = ".3f") -> str:
    """A number, or a dash where it is not known."""
    return "–" if value is None else format(value, form)
