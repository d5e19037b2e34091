"""The page of a run, or of several side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from pegasus_jax.checks import ConfigError
from pegasus_jax.report import compare, compared_curves, content
from pegasus_jax.report.page import GENERATOR, Section, page
from pegasus_jax.report.read import look
from pegasus_jax.report.tables import FIRST
from pegasus_jax.runs import groups
from pegasus_jax.runs.files import write_whole


class Report(NamedTuple):
    """What a page says, before it is one."""

    title: str
    lead: str
    sections: list[Section]
    files: dict[str, str]  # name -> CSV
    problems: list[str]  # why runs are left out


def report(paths: Sequence[Path]) -> Report:
    """The report of a run, or of those in the folders side by side. Raises RunError where there is nothing to show."""
    runs = groups.found(paths)
    if len(runs) == 1:
        one = look(runs[0])
        return Report(content.title(one), content.lead(one), content.sections(one), content.files(one), [])
    several = compare.compared(runs)
    made = compare.lead(several), compare.sections(several), compared_curves.files(several), several.problems
    return Report(compare.title(several), *made)


def write(made: Report, out: Path, folder: Path | None = None) -> list[Path]:
    """Write the page, and its curves as CSV into `folder`. Raises ConfigError where that would replace other files."""
    whole = page(made.title, made.lead, made.sections)
    files = {out: whole} | ({} if folder is None else {folder / name: text for name, text in made.files.items()})
    for path in files:
        _free(path)
    for path, text in files.items():
        write_whole(path, lambda file, text=text: file.write(text.encode()))
    return [*files]


def _free(path: Path) -> None:
    """Raises ConfigError for a path where something else than an earlier report lies."""
    if not path.exists():
        return
    if path.is_dir():
        raise ConfigError(f"out={path} is a folder; name a file, for example out={path / 'report.html'}")
    with path.open("rb") as file:
        begin = file.read(4096).decode(errors="replace")
    if GENERATOR not in begin and not begin.startswith(f"{FIRST},"):
        raise ConfigError(f"{path} is no report of pegasus-report, so it is not replaced; choose another name")
