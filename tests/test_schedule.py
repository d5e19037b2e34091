"""The table of a search in closed form, and a choice that leaves gradients alone."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pegasus_jax.assembly.schedules import rounds_from, width_for
from pegasus_jax.checks import ConfigError
from pegasus_jax.imagine.matching import either
from pegasus_jax.learn.schedule import (
    COARSE,
    CURRENT,
    EVALUATE,
    FRESH,
    LEADER,
    OTHER,
    START,
    STEP,
    search_table,
)
from pegasus_jax.learn.visits import first_rows
from pegasus_jax.viz.search_table import text


def visits(**settings):
    table = search_table(4, **settings)
    return [tuple(map(int, row)) for row in zip(*table[:4], strict=True)]


STEPS = [(i, i, STEP, CURRENT) for i in range(4)]


def test_the_plain_table_is_the_printed_algorithm():
    assert visits() == STEPS
    table = search_table(4)
    assert not table.refine.any()
    assert all(np.array_equal(factor, np.ones((1, 4))) for factor in table[-3:])


@pytest.mark.parametrize("refine", [-1, 5, [2, 9]])
def test_a_refinement_begins_within_the_search(refine):
    with pytest.raises(ConfigError, match=r"^refine=(-1|5|9) is out of range; expected a number in \[0, 4\]"):
        search_table(4, refine=refine)


def test_a_search_starts_from_the_policy_it_is_told():
    assert visits(init="better") == [(0, 0, EVALUATE, CURRENT), (0, 0, EVALUATE, FRESH), *STEPS]
    assert visits(init="fresh") == [(0, 0, STEP, FRESH), *STEPS[1:]]
    race = [(0, 0, STEP, FRESH), (1, 1, STEP, OTHER), (1, 2, EVALUATE, CURRENT), (1, 2, EVALUATE, LEADER)]
    end = [(3, 4, EVALUATE, CURRENT), (3, 4, EVALUATE, START)]
    assert visits(init="raced", refine=4) == [*race, *STEPS[2:], *end]
    assert visits(init="raced", refine=3) == visits(init="better", refine=3)  # too short for a race
    assert visits(init="raced") == visits(init="better")
    with pytest.raises(ValueError, match=r"init=old is not a choice; .*choices: previous, better, fresh, raced"):
        search_table(4, init="old")


def test_a_refinement_begins_and_ends_with_a_comparison_under_its_own_objective():
    table = search_table(4, refine=2)
    middle = [(1, 2, EVALUATE, CURRENT), (1, 2, EVALUATE, START)]
    end = [(3, 4, EVALUATE, CURRENT), (3, 4, EVALUATE, COARSE)]
    assert visits(refine=2) == [*STEPS[:2], *middle, *STEPS[2:], *end]
    assert table.refine.tolist() == [False] * 2 + [True] * 6
    assert visits(refine=4) == [*STEPS, (3, 4, EVALUATE, CURRENT), (3, 4, EVALUATE, START)]
    assert visits(refine=0) == [*STEPS, *end]


@pytest.mark.parametrize("init", ["previous", "better", "fresh", "raced"])
@pytest.mark.parametrize("refine", [None, 0, 2, 4])
def test_iterations_begin_where_those_before_have_ended(init, refine):
    table = search_table(4, init=init, refine=refine)
    begin = first_rows(table)
    assert (begin[0], begin[-1]) == (0, len(table.action))
    for i in range(4):
        assert set(table.iteration[begin[i] : begin[i + 1]]) == {i}


def of_steps(column, table):
    return column[..., table.action == STEP]


def test_the_width_narrows_geometrically_and_stays():
    table = search_table(25, cost_width_start=4.0, anneal_trials=1)
    np.testing.assert_allclose(table.cost_width[0, [0, 5, 10, 13, 20]], [4, 4**0.6, 4**0.2, 1, 1])
    raced = search_table(40, cost_width_start=4.0, refine=20, init="raced")  # a race counts once
    np.testing.assert_allclose(
        of_steps(raced.cost_width, raced)[0, [0, 4, 5, 9, 10]], 4 ** np.array([1, 7 / 15, 1, 7 / 15, 1 / 3])
    )
    refining = search_table(40, cost_width_start=4.0, refine=20)  # by half of the coarse part
    np.testing.assert_allclose(of_steps(refining.cost_width, refining)[0, [0, 5, 10, 15]], [4, 2, 1, 1])


def test_a_cost_begins_as_wide_as_makes_it_nine_tenths_where_episodes_start():
    """Of 1 - exp(-e^2 / 2): with the width w it is 1 - exp(-e^2 / 2 w^2)."""
    for error in (3.0, 4.8):
        width = width_for(1 - np.exp(-0.5 * np.full(7, error) ** 2))
        np.testing.assert_allclose(1 - np.exp(-0.5 * (error / width) ** 2), 0.9, rtol=1e-9)
    assert width_for(np.array([0.0, 1.0])) == width_for(np.array([0.9])) == 1
    assert 2.6 < width_for(np.ones(3)) < 2.7  # what single precision cannot tell from 1
    assert width_for(np.array([7.0])) == width_for(np.ones(3))  # a cost that is not within [0, 1]


def test_the_step_size_falls_and_begins_again_where_a_search_refines():
    table = search_table(100, decay=0.2, refine=60)
    sizes = of_steps(table.step_size, table)[0]
    np.testing.assert_allclose(sizes[[0, 30, 59]], [1, 0.6, 0.2], atol=1e-3)
    np.testing.assert_allclose(sizes[[60, 80, 99]], [1, 0.515, 0.03], atol=2e-3)
    np.testing.assert_allclose(search_table(100, decay=0.2).step_size[0, [0, 50, 99]], [1, 0.6, 0.2], atol=1e-3)


def test_a_refinement_has_rounds_that_begin_at_the_full_step_size_and_may_each_be_the_last():
    table = search_table(500, refine=rounds_from(300, 500, 4))
    sizes = of_steps(table.step_size, table)[0, 300:].reshape(4, 50)
    np.testing.assert_allclose(sizes, np.tile(search_table(50, refine=0).step_size[0, :50], (4, 1)), atol=1e-6)
    assert table.iteration[table.ends].tolist() == [349, 399, 449, 499]
    assert of_steps(table.counts, table)[300:].reshape(4, 50).sum(1).tolist() == [12] * 4
    assert not of_steps(table.counts, table)[:300].any()
    assert table.refine[table.iteration >= 300].all()
    assert rounds_from(380, 500, 4) == [380, 440]  # a round has 50 iterations at least
    assert rounds_from(470, 500, 4) == [470]


def test_annealed_searches_are_one_and_the_last_row_of_factors_serves_all_later_ones():
    table = search_table(2, cost_width_start=4.0, decay=0.2, anneal_trials=2)
    np.testing.assert_allclose(table.cost_width, [[4, 2], [1, 1], [1, 1]])
    half = np.sqrt(0.5) / 2
    np.testing.assert_allclose(
        table.step_size, [[1, 0.2 + 0.8 * (0.5 + half)], [0.6, 0.2 + 0.8 * (0.5 - half)], [0.2] * 2]
    )
    assert np.all(table.limit == 1)


def test_after_annealed_searches_each_has_its_own_step_size_and_limit():
    table = search_table(2, decay=0.5, anneal_trials=2, warm_restart=0.4, warm_limit_factor=30.0)
    np.testing.assert_allclose(table.step_size[2], [0.4, 0.3])
    np.testing.assert_allclose(table.step_size[:2], search_table(2, decay=0.5, anneal_trials=2).step_size[:2])
    assert table.limit.tolist() == [[1, 1], [1, 1], [30, 30]]


def test_a_table_can_be_read_without_jax():
    code = (
        "import sys; from pegasus_jax.learn.schedule import search_table\n"
        "from pegasus_jax.viz.search_table import text\n"
        "print(text(search_table(2, init='better', refine=1, cost_width_start=2))); assert 'jax' not in sys.modules"
    )
    lines = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.splitlines()
    assert " ".join(lines[0].split()) == "iteration scenarios action candidate refine ends width step limit"
    assert lines[1].split() == ["0", "0", "evaluate", "current", "no", "no", "2.000", "1.000", "1"]
    assert [line.split()[2:4] for line in lines[2:]] == [
        ["evaluate", "fresh"],
        ["step", "current"],
        ["evaluate", "current"],
        ["evaluate", "start"],
        ["step", "current"],
        ["evaluate", "current"],
        ["evaluate", "coarse"],
    ]
    later = search_table(2, decay=0.5, anneal_trials=2)
    assert text(later, 9) == text(later, 2) != text(later, 0)


@pytest.mark.parametrize(("asked", "slope"), [(True, 2.0), (False, np.inf)])
def test_what_is_not_asked_for_reaches_no_gradient(asked, slope):
    """Though it is computed, and would make NaN of a slope that is not asked for times an infinite one."""
    double, explode = lambda x: 2.0 * x, jnp.exp
    assert jax.jit(jax.grad(lambda x: either(jnp.asarray(asked), double, explode)(x)))(1e3) == slope
