"""The notebooks run from the first cell to the last, and are stored with what they show."""

import json
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "examples" / "notebooks"
NAMES = {"cartpole_in_imagination", "own_plant", "comparing_models"}


def cells(name: str) -> list[dict[str, Any]]:
    return json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]


def outputs(cells: list[Any]) -> list[Any]:
    return [output for cell in cells for output in cell.get("outputs", [])]


def pictures(cells: list[Any]) -> int:
    return sum("image/png" in output.get("data", {}) for output in outputs(cells))


def test_notebooks_are_short_and_are_stored_with_their_pictures() -> None:
    assert {path.stem for path in FOLDER.glob("*.ipynb")} == NAMES
    for name in NAMES:
        found = cells(name)
        assert len(found) < 15
        assert found[0]["cell_type"] == "markdown"
        code = [cell for cell in found if cell["cell_type"] == "code"]
        assert [cell["execution_count"] for cell in code] == [*range(1, len(code) + 1)]  # in one go
        assert pictures(found) >= 1
        assert not [output for output in outputs(found) if output["output_type"] == "error"]
        assert (FOLDER / f"{name}.ipynb").stat().st_size < 250_000


# One is run for every change; the others take as long again each.
RUN = [
    pytest.param("own_plant", marks=pytest.mark.slow),
    *(pytest.param(name, marks=pytest.mark.campaign) for name in sorted(NAMES - {"own_plant"})),
]


@pytest.mark.parametrize("name", RUN)
def test_a_notebook_runs(name: str, tmp_path: Path) -> None:
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    stored = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    shown = pictures(stored.cells)
    nbclient.NotebookClient(stored, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    assert pictures(stored.cells) == shown
