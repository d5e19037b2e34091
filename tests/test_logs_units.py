"""Logs beside what the environment says of itself: units, names, times, and where episodes start; late controls."""

from pathlib import Path

import numpy as np
import pytest

import pegasus_jax as pg
from pegasus_jax.checks import ConfigError
from pegasus_jax.config import Config
from pegasus_jax.logs.read import read
from pegasus_jax.runs import config_io, store
from pegasus_jax.runs.logged import read_config
from pegasus_jax.types import Trajectory
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
    columns = value[: value.index("]", value.rindex('"') if '"' in value else 0) + 1]
    return config_io.parse({"data": "any.csv", name: columns}).data_columns


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


def test_a_piece_shorter_than_a_period_is_left_out_with_a_note(tmp_path):
    rows = np.column_stack([0.01 * np.arange(30), np.linspace(1, 1.2, 30), np.zeros((30, 2))])
    rows[4, 1] = np.nan
    found, notes = read([written(tmp_path / "a.csv", "t,x,v,u", rows)], CART._replace(dt=0.05))
    assert [len(one.trajectory.u) for one in found] == [4]
    assert any(note.endswith("a.csv: a piece is shorter than a period; left out") for note in notes)
    with pytest.raises(ConfigError, match=r"no episode: no rows follow each other for a period, 0\.3 s"):
        read([written(tmp_path / "a.csv", "t,x,v,u", rows)], CART)


@pytest.mark.parametrize("control", ["sent", "before"])
def test_a_late_control_does_not_move_those_after_it_by_a_period(control, tmp_path):
    sent = np.random.default_rng(0).uniform(-2, 2, 61)
    rows = np.column_stack([0.05 * np.arange(61), np.linspace(1, 1.2, 61), np.zeros(61), sent])
    rows[4:, 0] += 0.008
    rows[:, 3] = np.roll(sent, 1) if control == "before" else sent
    task = CART._replace(dt=0.05, horizon=60)
    (one,), notes = read([written(tmp_path / "a.csv", "t,x,v,u", rows)], task, control=control)
    np.testing.assert_allclose(one.trajectory.u[:, 0], sent[:60], atol=1e-6)
    assert "change within" not in " ".join(notes)


@pytest.mark.parametrize("rate", [0.25, 0.5, 2, 3, 10])
def test_controls_held_for_a_period_are_found_at_any_rate(rate, tmp_path):
    """Rows that many a period; where they are rarer, each control acts until the next row."""
    t = np.round(np.arange(int(8 * rate) + 1) / rate, 6)
    rows = np.column_stack([0.3 * t, t, 0 * t, np.floor(t) / 10])
    (one,), _ = read([written(tmp_path / "a.csv", "t,x,v,u", rows)], CART)
    step = max(1, round(1 / rate))
    np.testing.assert_allclose(one.trajectory.u[:, 0], np.arange(8) // step * step / 10, atol=1e-6)


def test_episodes_are_read_by_the_names_that_they_have(tmp_path):
    """Also of a run whose state had more than is observed here; without a name of here they are read in order."""
    file, states, controls = str(tmp_path / "a.npz"), ROWS[:, [1, 0]], ROWS[:-1, 2:]
    np.savez(file, x=states, u=controls, dt=0.3, state_names=["v [m/s]", "X"], control_names=["u [N]"])
    np.testing.assert_allclose(first(file, CART)[0], ROWS[:-1], atol=1e-6)
    more = np.column_stack([np.zeros(5), states])
    np.savez(file, x=more, u=controls, dt=0.3, state_names=["w", "v", "x"], control_names=["u"])
    np.testing.assert_allclose(first(file, CART)[0], ROWS[:-1], atol=1e-6)
    np.savez(file, x=ROWS[:, :2], u=controls, dt=0.3, state_names=["a", "b"], control_names=["c"])
    np.testing.assert_allclose(first(file, CART)[0], ROWS[:-1], atol=1e-6)
    np.savez(file, x=states, u=controls, dt=0.3, state_names=["v [km/h]", "x"], control_names=["u"])
    with pytest.raises(ConfigError, match=r"the column v \[km/h\] is in km/h"):
        read([file], CART)


def test_episodes_with_computed_rates_are_read_by_name(tmp_path):
    words = {"task": "cartpole", "sensors.measured": "[0,3]", "sensors.velocity": "difference"}
    task = pg.build(config_io.parse(words)).task
    x, u = np.random.default_rng(0).uniform(-0.5, 0.5, (6, len(task.state_names))), np.ones((5, 1))
    ran = Trajectory(x, u, np.zeros(5))  # type: ignore[arg-type]
    np.savez(tmp_path / "a.npz", **store.arrays_of("cartpole", 1, ran, task, policy=0, ended="horizon"))
    (one,), _ = read([str(tmp_path / "a.npz")], task)
    seen = [i for i in range(len(task.state_names)) if i not in task.rates]
    np.testing.assert_allclose(one.trajectory.x[:, seen], x[:, seen], atol=1e-6)


def test_observed_cosines_and_sines_are_read_by_name(tmp_path):
    task = DIAL._replace(state_names=("w", "atan2(s, c)"), circles=((1, 2),), angles=(1,), cost=CART.cost)
    x = np.array([[0.1, 1], [0.2, 2], [0.3, 3], [0.4, 4]])
    seen = np.column_stack([np.cos(x[:, 0]), np.sin(x[:, 0]), x[:, 1]])
    file, names = str(tmp_path / "a.npz"), ["atan2(s, c)", "w"]
    np.savez(file, x=x, u=np.zeros((3, 1)), dt=1.0, state_names=names, circles=((0, 1),), observation=seen)
    np.testing.assert_allclose(first(file, task)[0][:, :2], x[:-1, ::-1], atol=1e-6)


@pytest.mark.parametrize(("text", "line"), [('"v\n[m/s]",x,u\n0,1,0\n', 1), ('x,v,u\n1,0,0\n1,"0,0\n1,0,0\n', 3)])
def test_a_quote_that_goes_on_is_one_line(text, line, tmp_path):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(ConfigError, match=rf"a.csv line {line}: a quote is not closed on its line") as refused:
        read([str(tmp_path / "a.csv")], CART)
    assert len(str(refused.value).splitlines()) == 1
    (tmp_path / "a.csv").write_text('"v","x","u"\n0,"1",0\n0,1,0\n')
    np.testing.assert_allclose(first(str(tmp_path / "a.csv"), CART)[0], [[1, 0, 0]])


@pytest.mark.parametrize(
    ("head", "swapped"),
    [
        ("# hand-driven\n# v [m/s],x,u\n", True),
        ("# v,x,u\n# by hand\n", False),  # only the last one
        ("# by hand,,\n", False),  # as spreadsheets fill up a remark
        ("0,1,2\n", False),
    ],
)
def test_headers_as_numpy_and_pandas_write_them(head, swapped, tmp_path):
    rows = ROWS[:, [1, 0, 2]] if swapped else ROWS
    (tmp_path / "a.csv").write_text(head + "".join(f"{a:g},{b:g},{c:g}\n" for a, b, c in rows))
    found, notes = first(str(tmp_path / "a.csv"), CART)
    np.testing.assert_allclose(found, ROWS[:-1], atol=1e-6)
    assert ("by their order" in " ".join(notes)) != swapped


def test_a_file_is_read_once_whatever_the_letters_of_its_suffix(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "UP.CSV", "t,x,v,u", TIMED)
    np.savez(tmp_path / "b", x=ROWS[:, :2], u=ROWS[:, 2:])
    (tmp_path / "b.npz").rename(tmp_path / "b.NPZ")
    found, _ = read(["UP.CSV", "*", str(tmp_path / "*.CSV")], CART)
    assert [one.source for one in found] == ["UP.CSV", "b.NPZ"]


COLUMNS = np.random.default_rng(0).uniform(-1, 1, (12, 3))  # position, velocity, force of a cart
COUNT = np.arange(12.0)


@pytest.mark.parametrize(
    ("header", "more", "told", "columns"),
    [
        (",a,b,c", [COUNT], "4 columns, (no name), a, b, c; expected 3: x, v, u; the first column looks", "[a,b,c]"),
        (",0,1,2", [COUNT + 40], "leave it out, with index=False where pandas writes it, or with", "[0,1,2]"),
        ("", [COUNT], "the first column looks like a row number (0, 1, 2, ...): leave it out", "[1,2,3]"),
        (",0,1,2,3", [COUNT, 0.3 * COUNT], "row number (0, 1, 2, ...), and 0 like the time: leave", "[1,2,3,t=0]"),
        ("", [0.3 * COUNT], "expected 3: x, v, u; if 0 is the time, data_columns=[1,2,3,t=0] says so", "[1,2,3,t=0]"),
        ("q,a,b,c", [300 * COUNT], "if q is the time", "[a,b,c,t=q*0.001]"),
        ("", [COLUMNS[:, 0]], "4 columns, 0, 1, 2, 3; expected 3: x, v, u; data_columns=[...] says which is which", ""),
        ("", [np.zeros(12)], "data_columns=[...] says which is which", ""),
    ],
)
def test_a_column_too_many_that_counts_rows_or_is_the_time_is_told(header, more, told, columns, tmp_path):
    file, rows = str(tmp_path / "a.csv"), np.column_stack([*more, COLUMNS])
    np.savetxt(file, rows, delimiter=",", header=header, comments="", fmt="%.9g")
    with pytest.raises(ConfigError) as refused:
        read([file], cart())
    assert told in str(refused.value)
    assert f"data_columns={columns}" in str(refused.value)
    if columns:  # and what it says to type is read
        (one, *_), notes = read([file], cart(), config_io.parse({"data": file, "data_columns": columns}).data_columns)
        np.testing.assert_allclose(one.trajectory.x[:, 0], COLUMNS[:9, 0], atol=1e-6)
        assert not any("resampled" in note for note in notes)


def test_row_numbers_are_taken_for_no_time_and_are_noted_where_they_are_read(tmp_path):
    file = str(tmp_path / "a.csv")
    np.savetxt(file, np.column_stack([COUNT, COLUMNS]), delimiter=",", header=",x,v,u", comments="", fmt="%.9g")
    (note,) = read([file], cart())[1]
    assert note.endswith("rows are taken to be dt=0.3 s apart; nothing uses (no name)")
    np.savetxt(file, np.column_stack([COUNT, COLUMNS[:, 1:]]), delimiter=",", fmt="%.9g")
    assert "by their order, 0, 1, 2 are x, v, u; 0 looks like a row number" in read([file], cart())[1][0]


def test_an_episode_of_one_row_is_left_out_and_said(tmp_path):
    file = tmp_path / "a.csv"
    file.write_text("episode,x,v,u\n" + "".join(f"{episode},0,0,0\n" for episode in (1, 1, 1, 2, 3, 3, 4)))
    found, notes = read([str(file)], cart())
    assert [len(one.trajectory.u) for one in found] == [2, 1]
    assert f"{file}: line 5 is an episode of one row (2 such): nothing follows from it; left out" in notes


SAME = CART._replace(state_names=("elbow [rad]", "elbow [rad/s]"), control_names=("elbow",))


@pytest.mark.parametrize("header", ["elbow [rad],elbow [rad/s],elbow", "elbow [rad],elbow [rad/s],elbow [N m]"])
def test_columns_that_differ_in_their_unit_alone_are_told_apart(header, tmp_path):
    file = written(tmp_path / "a.csv", header, ROWS)
    np.testing.assert_allclose(first(file, SAME)[0], ROWS[:-1], atol=1e-6)
    turned = written(tmp_path / "b.csv", ",".join(header.split(",")[::-1]), ROWS[:, ::-1])
    np.testing.assert_allclose(first(turned, SAME)[0], ROWS[:-1], atol=1e-6)


def test_of_columns_that_only_a_unit_would_tell_apart_none_is_taken(tmp_path):
    file = written(tmp_path / "a.csv", "elbow,rate,u", ROWS)
    with pytest.raises(ConfigError, match=r"has no column elbow \[rad\], it has elbow, rate, u; data_columns"):
        read([file], SAME)


@pytest.mark.parametrize("names", [("elbow [rad]", "elbow [rad/s]"), ("elbow", "rate")])
def test_an_episode_of_ours_is_read_back_whatever_a_motor_is_called(names, tmp_path):
    task, file = SAME._replace(state_names=names), str(tmp_path / "a.npz")
    ran = Trajectory(ROWS[:, :2], ROWS[:-1, 2:], np.zeros(4))
    np.savez(file, **store.arrays_of("cart", 1, ran, task, policy=0, ended="truncated"))
    np.testing.assert_allclose(first(file, task)[0], ROWS[:-1], atol=1e-6)


@pytest.mark.parametrize("header", ["Episode,x,v,u", "EPISODE,x,v,u"])
def test_an_episode_column_may_be_written_in_capitals(header, tmp_path):
    rows = np.column_stack([[1, 1, 2, 2, 2], ROWS])
    found, _ = read([written(tmp_path / "a.csv", header, rows)], CART)
    assert [len(one.trajectory.u) for one in found] == [1, 2]
    state = CART._replace(state_names=("episode", "v"))
    assert len(read([written(tmp_path / "b.csv", "episode,v,u", ROWS)], state)[0]) == 1


@pytest.mark.parametrize(
    ("text", "rows"),
    [
        ("x;v;u\n1,5;-2;0,25\n2,5;3e-1;0\n", [[1.5, -2, 0.25]]),
        ("1,5;-2;0,25\n2,5;3e-1;0\n", [[1.5, -2, 0.25]]),
        ("x [m], first;v;u\n1.5;-2;0.25\n2.5;0.3;0\n", [[1.5, -2, 0.25]]),
        ("1.5,-2,0.25,\n2.5,0.3,0,\n", [[1.5, -2, 0.25]]),
        ("x,v,u,,\n1.5,-2,0.25,,\n2.5,0.3,0,,\n", [[1.5, -2, 0.25]]),
        ("x,\tv,\tu\n1.5,\t-2,\t0.25\n2.5,\t0.3,\t0\n", [[1.5, -2, 0.25]]),
        ("x,v,u,note (a; b)\n1.5,-2,0.25,0\n2.5,0.3,0,0\n", [[1.5, -2, 0.25]]),
        ("x,v,u\t\n1.5,-2,0.25\n2.5,0.3,0\n", [[1.5, -2, 0.25]]),
        ("x\tv\tu\n1.5\t-2\t0.25\n2.5\t0.3\t0\n", [[1.5, -2, 0.25]]),
    ],
)
def test_marks_between_cells_and_in_numbers(text, rows, tmp_path):
    (tmp_path / "a.csv").write_text(text)
    np.testing.assert_allclose(first(str(tmp_path / "a.csv"), CART)[0], rows, atol=1e-6)


def test_the_numbers_of_an_arrays_columns_are_a_header(tmp_path):
    """As pandas writes some of them: over those of its rows is an empty cell."""
    (tmp_path / "a.csv").write_text(",2,3,4,5\n0,1.5,-2,0.25,9\n1,2.5,0.3,0,9\n")
    np.testing.assert_allclose(first(str(tmp_path / "a.csv"), CART, ("2", "3", "4"))[0], [[1.5, -2, 0.25]])


def test_a_column_of_labels_is_no_episode(tmp_path):
    (tmp_path / "a.csv").write_text("x,v,u,Episode\n1,2,0.5,run a\n2,3,0.5,run a\n")
    assert len(read([str(tmp_path / "a.csv")], CART)[0]) == 1
    (tmp_path / "b.csv").write_text("x,v,u,Episode,episode\n1,2,0.5,1,1\n2,3,0.5,2,1\n2,3,0.5,3,1\n")
    assert len(read([str(tmp_path / "b.csv")], CART)[0][0].trajectory.u) == 2
