"""A policy at its limits is named, with what may be in the way; one that works, or explores, is not."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from pegasus_jax.config import Config
from pegasus_jax.runs import train, writers
from pegasus_jax.runs.logged import NONE
from pegasus_jax.runs.stuck import stuck, unforeseen

FIRST: dict[str, Any] = {
    "trial": 4,
    "random": False,
    "saturated": 1.0,
    "episode_cost": 0.98,
    "objective_fresh": 0.97,
}
SECOND = FIRST | {"trial": 5, "saturated": 0.96, "episode_cost": 0.96}


def test_a_flat_cost_and_a_wrong_model_are_told_apart() -> None:
    (flat,), (wrong,) = stuck([FIRST], [SECOND]), stuck([FIRST | {"objective_fresh": 0.3}], [SECOND])
    for line in (flat, wrong):
        assert line.startswith("note: the controls stayed at a limit in trials 4 and 5")
        assert "(cost 0.96)" in line
    assert "the cost may be flat" in flat
    assert "imagined was 0.30: the model is wrong there" in wrong


def test_the_one_control_of_several_that_pushes_is_named() -> None:
    """As a car's that always turns right: by the share of all controls it would not be seen."""
    first, second = ({"saturated": 0.5, "saturated_controls": {"gas": gas, "wheel": 1.0}} for gas in (0.96, 0.0))
    (line,) = stuck([FIRST | first], [SECOND | second])
    assert line.startswith("note: wheel stayed at a limit in trials 4 and 5")
    assert stuck([FIRST | first], [SECOND | second | {"saturated_controls": {"gas": 0.96, "wheel": 0.9}}]) == [
        line.replace("wheel", "gas")
    ]
    assert not stuck([FIRST | first], [SECOND | second | {"saturated_controls": {"gas": 0.9, "wheel": 0.9}}])


@pytest.mark.parametrize("change", [{"random": True}, {"saturated": 0.94}, {"episode_cost": 0.4}])
@pytest.mark.parametrize("which", [0, 1])
def test_nothing_is_said_of_random_gentle_or_working_controls(change: dict[str, Any], which: int) -> None:
    rows = [FIRST, SECOND]
    rows[which] = rows[which] | change
    assert stuck([rows[0]], [rows[1]]) == []


def test_nothing_is_said_of_a_first_trial_or_of_several_seeds() -> None:
    assert stuck([], [FIRST]) == []
    assert stuck([FIRST, FIRST], [SECOND, SECOND]) == []


def told(monkeypatch: pytest.MonkeyPatch, rows: list[dict[str, Any]], task: Any) -> list[str]:
    """What a run with these rows prints, the beginning of each line."""
    left, said = iter(rows), list[str]()
    monkeypatch.setattr(train, "one_trial", lambda job, states, trial: (states, lambda: [next(left)]))
    shown = {"phase": lambda *told: None, "trial": lambda rows: said.append(f"trial {rows[0]['trial']}")}
    display = SimpleNamespace(line=said.append, **shown)
    given = dict(writer=writers.nothing(1), display=display, logs=NONE, cost_since=[1])
    settings = dict(program=SimpleNamespace(concurrent=True), experiment=SimpleNamespace(task=task))
    job = SimpleNamespace(config=Config(trials=len(rows)), **settings, **given)
    train.learn(cast(Any, job), cast(Any, None))
    return [line[:55] for line in said]


def test_a_run_says_it_once_for_each_two_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [FIRST | {"trial": 1, "random": True}, *(FIRST | {"trial": trial} for trial in (2, 3, 4))]
    assert told(monkeypatch, rows, SimpleNamespace(environment=None)) == [
        "trial 1",
        "trial 2",
        "trial 3",
        "note: the controls stayed at a limit in trials 2 and 3,",
        "trial 4",
        "note: the controls stayed at a limit in trials 3 and 4,",
    ]


def test_an_end_that_nobody_imagines_is_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two episodes that the plant ends early the first; not with stop=, of several seeds, or at the horizon."""
    early = FIRST | {"ended": "terminated", "steps": 12, "saturated": 0.1}
    task = SimpleNamespace(stop=None, horizon=40, environment=None)
    (line,) = unforeseen([early], cast(Any, task))
    assert line.startswith("note: the episode of trial 4 was over after 12 of 40 periods; imagined ones do not end")
    assert not unforeseen([early], cast(Any, SimpleNamespace(stop=lambda x: x, horizon=40)))
    assert not unforeseen([early], cast(Any, SimpleNamespace(stop=None, horizon=12)))
    assert not unforeseen([early, early], cast(Any, task))
    assert not unforeseen([early | {"ended": "truncated"}], cast(Any, task))
    (first,) = unforeseen([early | {"trial": 1}], cast(Any, task))
    rows = [early | {"trial": trial} for trial in (1, 2)]
    assert told(monkeypatch, rows, task) == ["trial 1", first[:55], "trial 2"]
