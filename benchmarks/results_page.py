"""What the stored results show: README.md's tables, and docs/results.md with every figure and its claims.

    python -m benchmarks.results_page

Run it after a study was added: it draws the figures' pictures and writes what is between the markers of both pages.
"""

import os
from collections.abc import Sequence
from pathlib import Path

from benchmarks import RESULTS, command, none, readme_table
from benchmarks.paper import claims
from benchmarks.paper.comparison import draw, results
from benchmarks.paper.figures import Figure, read

FIGURES = Path(__file__).parent / "paper"
PAGE = Path(__file__).parents[1] / "docs" / "results.md"
README = Path(__file__).parents[1] / "README.md"
ORDER = ("cartpole", "crn", "clip", "rbf", "nn", "double")
BEGIN, END = "<!-- generated: python -m benchmarks.results_page -->\n", "<!-- generated until here -->\n"


def main(words: Sequence[str] = ()) -> None:
    """Draw every figure that has studies, and write the generated part of both pages. ConfigError for any word."""
    none(words)
    for path in FIGURES.glob("*.toml"):
        figure = read(path)
        if there := results(figure, RESULTS):
            draw(figure, there, RESULTS)
    write(README, readme(RESULTS))
    write(PAGE, page(FIGURES, RESULTS))


def write(path: Path, generated: str, begin: str = BEGIN) -> None:
    """Replace what is between the markers of a page; the rest is a person's."""
    before, _, rest = path.read_text().partition(begin)
    path.write_text(before + begin + generated + END + rest.partition(END)[2])


def readme(out: Path) -> str:
    """The generated part of README.md."""
    return f"\n{readme_table.readme_table(out)}\n\n{readme_table.peers_table(out)}\n\n"


def page(folder: Path, out: Path) -> str:
    """The generated part of docs/results.md: the table by trial, then a section for each figure."""
    return f"\n{readme_table.by_trial(out)}" + figures(folder, out)


def figures(folder: Path, out: Path) -> str:
    """A section for each figure's file in the folder."""
    paths = {path.stem: path for path in sorted(folder.glob("*.toml"))}
    names = [*(name for name in ORDER if name in paths), *(name for name in paths if name not in ORDER)]
    return "".join(section(read(paths[name]), out) for name in names)


def section(figure: Figure, out: Path) -> str:
    """One figure: what the paper says, the picture if it has been drawn, the studies, the claims."""
    parts = [f"\n## {figure.title}", f"**Paper.** {figure.paper}"]
    if figure.found:
        parts.append(f"**Here.** {figure.found}")
    if (out / f"{figure.name}.png").exists():
        parts.append(f"![{figure.title}]({os.path.relpath(out / f'{figure.name}.png', PAGE.parent)})")
    parts.append(claims.markdown(claims.variants_table(figure, out)))
    if figure.claims:
        parts.append(claims.markdown(claims.claims_table(figure, out)))
    return "\n\n".join(parts) + "\n"


def shown(folder: Path, out: Path) -> set[str]:
    """The files of `out` that a row of a table, a figure or a claim shows, by name."""
    every = [read(path) for path in folder.glob("*.toml")]
    stems = {stem for row in (*readme_table.ROWS, *readme_table.MORE) for stem in row.studies}
    stems |= {f"{figure.name}-{label}" for figure in every for label in figure.variants}
    stems |= {
        side for figure in every for one in figure.claims for side in (one.lower, one.than) if isinstance(side, str)
    }
    there = {path.name for path in out.iterdir()}
    return there & ({f"{stem}.json" for stem in stems} | {f"{figure.name}.png" for figure in every})


if __name__ == "__main__":
    command(main, __doc__)
