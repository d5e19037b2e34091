"""docs/results.md: every figure beside what the paper says of it, generated from benchmarks/figures and the results.

    python -m benchmarks.results_page

Run it again when a study has been added: it draws the figures' pictures, and writes what is between the page's markers.
"""

import json
import os
from pathlib import Path

from benchmarks.study import RESULTS
from pegasus_jax.studies import claims
from pegasus_jax.studies.comparison import draw, results, stored
from pegasus_jax.studies.figures import Figure, read

FIGURES = Path(__file__).parent / "figures"
PAGE = Path(__file__).parents[1] / "docs" / "results.md"
ORDER = ("cartpole", "crn", "clip", "rbf", "nn", "double")
BEGIN, END = "<!-- generated: python -m benchmarks.results_page -->\n", "<!-- generated until here -->\n"


def main() -> None:
    """Draw every figure that has studies, and write the page's generated part."""
    for path in FIGURES.glob("*.toml"):
        figure = read(path)
        if there := results(figure, RESULTS):
            draw(figure, there, RESULTS)
    before, _, rest = PAGE.read_text().partition(BEGIN)
    PAGE.write_text(before + BEGIN + generated(FIGURES, RESULTS) + END + rest.partition(END)[2])


def generated(folder: Path, out: Path) -> str:
    """A section for each figure's file in the folder, and one for the studies in `out` that belong to none."""
    paths = {path.stem: path for path in sorted(folder.glob("*.toml"))}
    names = [*(name for name in ORDER if name in paths), *(name for name in paths if name not in ORDER)]
    figures = [read(paths[name]) for name in names]
    return "".join(section(figure, out) for figure in figures) + others(figures, out)


def section(figure: Figure, out: Path) -> str:
    """One figure: what the paper says, the picture if it has been drawn, the studies, the claims, the commands."""
    parts = [f"\n## {figure.title}", f"**Paper.** {figure.paper}"]
    if figure.found:
        parts.append(f"**Here.** {figure.found}")
    if (out / f"{figure.name}.png").exists():
        parts.append(f"![{figure.title}]({os.path.relpath(out / f'{figure.name}.png', PAGE.parent)})")
    parts += [claims.markdown(claims.variants_table(figure, out)), claims.markdown(claims.claims_table(figure, out))]
    parts.append(f"`make figures FIGURE={figure.name}` runs what is missing.")
    return "\n\n".join(parts) + "\n"


def others(figures: list[Figure], out: Path) -> str:
    """The studies in `out` of no figure, each with its command."""
    known = {f"{figure.name}-{label}" for figure in figures for label in figure.variants}
    stems = [path.stem for path in sorted(out.glob("*.json")) if path.stem not in known and is_study(path)]
    found = {stem: result for stem in stems if (result := stored(out, stem)) is not None}
    if not found:
        return ""
    header = ["study", *claims.HEADER[1:]]
    commands = [f"* `{result['about']['command']}`" for result in found.values()]
    table = claims.markdown([header, *(claims.row(stem, result) for stem, result in found.items())])
    return "\n\n".join(["\n## Other studies", table, "\n".join(commands)]) + "\n"


def is_study(path: Path) -> bool:
    """Whether a result is a learning study; others are of speed."""
    return "mean_cost" in json.loads(path.read_text())


if __name__ == "__main__":
    main()
