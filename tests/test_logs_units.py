"""Logs beside what the environment says of itself: units of headers, times of other names, and where episodes start."""

from pathlib import Path

import numpy as np
import pytest

from pegasus_jax.checks import ConfigError
from pegasus_jax.config import Config
from pegasus_jax.logs.read import read
from pegasus_jax.runs import config_io
from pegasus_jax.runs.logged import read_config
from probes import cart, dial

CART = cart()._replace(state_names=("x [m]", "v [m/s]"), control_names=("u [N]",))
DIAL = dial()
ROWS = np.array([[1, 0, 0.5], [1.1, 1, -0.5], [1.3, 2, 1], [1.4, -1, 2], [1.2, 0, 0]])
TIMED = np.column_stack([0.3 * np.arange(5), ROWS])


def written(path: Path, header: str, rows: np.ndarray) -> str:
    """A CSV file of rows, as its name."""
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.9g")
    return str(path)


def typed(text: str) -> tuple[str, ...]:
    """What the word data_columns=[...] in a message makes of that setting, typed as it is there."""
    name, _, value = text[text.index("data_columns=[") :].partition("=")
    return config_io.parse({name: value[: value.index("]", value.rindex('"') if '"' in value else 0) + 1]}).data_columns


def first(file: str, task, columns=()):
    """States and controls of the first episode of a file, and the notes."""
    found, notes = read([file], task, columns)
    return np.column_stack([found[0].trajectory.x[:-1], found[0].trajectory.u]), notes


def noted(file: str, columns: tuple[str, ...] = (), task=CART) -> str:
    """What a command says of a file."""
    return "\n".join(read_config(Config(data=(file,), data_columns=columns), task)[1])


@pytest.mark.parametrize(
    ("header", "scale", "unit"),
    [
        ("x [cm],v [m/s],u [N]", (100, 1, 1), "x [cm] is in cm, and x is to be in m"),
        ("x (mm),v [mm/s],u [mN]", (1e3, 1e3, 1e3), "x (mm) is in mm, and x is to be in m"),
        ("x [m],v [km/h],u [kN]", (1, 3.6, 1e-3), "v [km/h] is in km/h, and v is to be in m/s"),
    ],
)
def test_another_unit_is_refused_with_the_word_that_converts_it(header, scale, unit, tmp_path):
    file = written(tmp_path / "a.csv", header, ROWS * scale)
    columns = tuple(header.split(",")) if "(" in header else ()
    with pytest.raises(ConfigError) as refused:
        read([file], CART, columns)
    for part in ("a.csv", unit, "*1 says that the header is wrong"):
        assert part in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1
    np.testing.assert_allclose(first(file, CART, typed(str(refused.value)))[0], ROWS[:-1], rtol=1e-5, atol=1e-6)


def test_a_unit_that_cannot_be_converted_is_refused_too(tmp_path):
    file = written(tmp_path / "a.csv", "x [ticks],v [m/s],u [N]", ROWS)
    with pytest.raises(ConfigError, match=r'"x \[ticks\]\*FACTOR".*how many m are 1 ticks'):
        read([file], CART)
    np.testing.assert_allclose(first(file, CART, ("x [ticks]*1", "v [m/s]", "u [N]"))[0], ROWS[:-1], atol=1e-6)
    swapped = written(tmp_path / "b.csv", "u [N],v [m/s],x [m]", ROWS)
    with pytest.raises(ConfigError, match=r"column u \[N\] is in N, and x is to be in m;.* if it is the right column"):
        read([swapped], CART, ("u [N]", "v [m/s]", "x [m]"))


@pytest.mark.parametrize("header", ["X [M],v [ m / s ],u [n]", "x[m],v [M/s],u", "x,v (m/s),u [N]"])
def test_units_that_are_written_otherwise_are_the_same(header, tmp_path):
    file = written(tmp_path / "a.csv", header, ROWS)
    np.testing.assert_allclose(first(file, CART, tuple(header.split(",")))[0], ROWS[:-1], atol=1e-6)


def test_an_angle_is_in_radians_whatever_its_name_says_not(tmp_path):
    file = written(tmp_path / "a.csv", "angle [deg],turn", np.column_stack([[5, 20, 35], [0, 0, 0]]))
    with pytest.raises(ConfigError, match=r'angle \[deg\] is in deg, .*rad; .*"angle \[deg\]\*0.0174533",turn'):
        read([file], DIAL)
    place = written(tmp_path / "b.csv", "angle[0],turn", np.column_stack([[2, 2.1, 2.2], [0, 0, 0]]))
    assert len(read([place], DIAL, ("angle[0]", "turn"))[0]) == 1  # a place in an array is no unit


def test_turns_are_told_of_an_angle_that_may_be_in_degrees(tmp_path):
    file = written(tmp_path / "a.csv", "angle,turn", np.column_stack([np.arange(0, 27.6, 2.5), np.zeros(12)]))
    assert "in the logs angle from 0 to 27.5 rad, 4.4 turns; turn from 0 to 0" in noted(file, task=DIAL)
    known = noted(file, ("angle*0.0174533", "turn"), DIAL)
    assert "angle is angle*0.0174533, from 0 to 0.48 rad; turn" in known
    assert "angle begins at 0, and episodes at 2.5 give or take 0.2: another column, or another unit?" in known


@pytest.mark.parametrize(
    ("header", "scale"),
    [("t [s]", 1), ("t [ms]", 1e3), ("Time [us]", 1e6), ("time (ms)", 1e3), ("TIME [ns]", 1e9), ("t [min]", 1 / 60)],
)
def test_a_time_with_a_unit_is_the_time(header, scale, tmp_path):
    """Rows at half the period: taken a period apart they would be slow motion."""
    rows = np.column_stack([0.15 * scale * np.arange(5), ROWS])
    for columns in ((), ("x", "v", "u")):
        found, notes = read([written(tmp_path / "a.csv", f"{header},x,v,u", rows)], CART, columns)
        np.testing.assert_allclose(found[0].trajectory.x, ROWS[::2, :2], atol=1e-6)
        assert "no column t" not in " ".join(notes)


@pytest.mark.parametrize(
    ("header", "scale", "word"),
    [
        ("Time_ms", 1e3, "data_columns=[x,v,u,t=Time_ms*0.001]"),
        ("timestamp", 1e3, "data_columns=[x,v,u,t=timestamp*0.001]"),  # of the milliseconds that are the period
        ("stamp (us)", 1e6, "'data_columns=[x,v,u,\"t=stamp (us)*1e-06\"]'"),
        ("k", 1, "data_columns=[x,v,u,t=k]"),  # it rises evenly
    ],
)
def test_a_missing_time_is_noted_with_what_may_be_it(header, scale, word, tmp_path):
    rows = np.column_stack([[0, 0, 1, 0, 1], TIMED * [scale, 1, 1, 1]])
    file = written(tmp_path / "a.csv", f"lamp,{header},x,v,u", rows)
    (note,) = [note for note in read([file], CART)[1] if "no column t" in note]
    assert note.endswith(f"nothing uses lamp, {header}; if {header} is the time, {word}")
    assert not [note for note in read([file], CART, typed(note))[1] if "no column t" in note]


def test_a_column_that_is_no_time_is_only_named(tmp_path):
    rows = np.column_stack([ROWS, [3, 1, 4, 1, 5], np.zeros(5)])
    (note,) = read([written(tmp_path / "a.csv", "x,v,u,clock,lamp", rows)], CART)[1]
    assert note.endswith("apart; nothing uses clock, lamp")
    np.savez(tmp_path / "a.npz", x=ROWS[:, 0], v=ROWS[:, 1], u=ROWS[:, 2], time_ms=TIMED[:, 0] * 1e3)
    assert "if time_ms is the time" in " ".join(read([str(tmp_path / "a.npz")], CART)[1])


def test_a_command_says_from_where_to_where_each_column_goes(tmp_path):
    file = written(tmp_path / "a.csv", "t,x [m],speed,u", TIMED)
    told = noted(file, ("x [m]", "speed*1", "u"))
    assert "in the logs x from 1 to 1.4 m; v is speed*1, from -1 to 2 m/s; u from -0.5 to 2 N" in told


def test_columns_of_another_name_of_the_environment_are_noted(tmp_path):
    file = written(tmp_path / "a.csv", "t,x,v,u", TIMED)
    assert "by data_columns=, v is taken for x, and x is taken for v" in noted(file, ("v", "x", "u"))
    assert "taken for" not in noted(file, ("x", "v", "u"))


def test_logs_that_begin_where_no_episode_does_are_noted(tmp_path):
    """Only where an episode begins: not where a gap ended, or a horizon."""
    long = np.column_stack([0.3 * np.arange(20), np.linspace(1, 9, 20), np.zeros((20, 2))])
    long[12:, 0] += 5
    file = written(tmp_path / "a.csv", "t,x,v,u", long)
    assert "begins at" not in noted(file)
    long[:, 1] += 1.2
    file = written(tmp_path / "a.csv", "t,x,v,u", long)
    assert f"{file}: x [m] begins at 2.2, and episodes at 1 give or take 0.1: another column" in noted(file)
    twice = np.vstack([long, long])
    assert "a.csv and 1 more: x [m] begins" in noted(written(tmp_path / "a.csv", "t,x,v,u", twice))
