"""Every test is run by one target of the Makefile; CI runs all but the long campaigns; `make test` is quick."""

import re
from contextlib import suppress
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests import conftest

ROOT = Path(__file__).resolve().parents[1]
TIERS = ("slow", "campaign")
TARGETS = ("test", "test-slow", "campaigns")


def selected_by(target: str) -> str:
    """Pytest's expression of the markers whose tests a target of the Makefile runs."""
    (words,) = re.findall(rf"^{target}:.*\n.* -m (.+) \$\(ARGS\)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    return words.strip('"')


@pytest.mark.parametrize("marked", [*product((False, True), repeat=len(TIERS))])
def test_one_target_runs_a_test(marked: tuple[bool, ...]) -> None:
    known = dict(zip(TIERS, marked, strict=True))
    chosen = [target for target in TARGETS if eval(selected_by(target), known)]
    assert len(chosen) == 1
    assert (chosen == ["test"]) == (not any(marked))


def test_ci_runs_all_but_the_long_campaigns() -> None:
    jobs = (ROOT / ".github" / "workflows" / "ci.yml").read_text()
    (commands,) = re.findall(r"command: \[(.*)\]\n", jobs)
    assert "- run: ${{ matrix.command }}\n" in jobs
    assert commands == ".ci/run, make test-slow"
    assert (ROOT / ".ci" / "run").read_text().splitlines()[-1] == "make test"


def test_a_test_that_takes_long_has_to_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def run(*marks: str) -> None:
        called = conftest.pytest_runtest_call(SimpleNamespace(get_closest_marker=marks.__contains__))
        next(called)
        with suppress(StopIteration):
            called.send(None)

    run()
    with monkeypatch.context() as changed:
        changed.setattr(conftest, "QUICK", -1)  # every test takes longer
        for mark in TIERS:
            run(mark)
        with pytest.raises(pytest.fail.Exception, match="mark it slow"):
            run()
