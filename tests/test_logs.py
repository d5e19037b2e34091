"""Logs of earlier episodes as data: every kind of file, what is decided about it, and what is refused in one line."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pegasus_jax as pg
from pegasus_jax.checks import ConfigError, RunError
from pegasus_jax.learn import data as dataset
from pegasus_jax.logs.columns import layout
from pegasus_jax.logs.episodes import interpolated
from pegasus_jax.logs.read import read
from pegasus_jax.logs.table import Names, Table
from pegasus_jax.math import circles
from pegasus_jax.runs import config_io, logged, store
from pegasus_jax.types import Cost, RunState
from probes import cart, dial, tiny

# Five rows of the cart of probes.py, a period of .3 s apart: position, velocity, force.
ROWS = np.array([[0, 0, 0.5], [0.1, 1, -0.5], [0.3, 2, 1], [0.4, -1, 2], [0.2, 0, 0]])
SHIFTED = ROWS + np.array([1, 1, 0])
CART, DIAL = cart(), dial()


def written(path: Path, header: str, rows: np.ndarray) -> str:
    """A CSV file of rows, as its name."""
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.9g")
    return str(path)


def transitions(task, *files, **options):
    """(x, u, next x) of all rows that logs give, and the notes."""
    found, notes = read(files, task, **options)
    every = [(one.trajectory.x[:-1], one.trajectory.u, one.trajectory.x[1:]) for one in found]
    return [np.concatenate(parts) for parts in zip(*every, strict=True)], notes


def same(found, rows=ROWS):
    x, u, after = found
    np.testing.assert_allclose(x, rows[:-1, :2], atol=1e-6)
    np.testing.assert_allclose(u, rows[:-1, 2:], atol=1e-6)
    np.testing.assert_allclose(after, rows[1:, :2], atol=1e-6)


TIMED = np.column_stack([0.3 * np.arange(5), ROWS])


@pytest.mark.parametrize(
    ("header", "rows", "columns"),
    [
        ("x [m],v [m/s],u", ROWS, ()),
        ("u,gyro,v,x", np.column_stack([ROWS[:, 2], ROWS[:, 0], ROWS[:, 1], ROWS[:, 0]]), ()),  # by their names
        ("V [m/s],U,X [m]", ROWS[:, [1, 2, 0]], ()),  # by names in other letters
        ("t,pos,speed,force", TIMED, ()),  # by their order
        ("stamp,pos,speed,force", TIMED, ("t=stamp", "pos", "speed", "force")),
        ("ms,cm,u,speed", TIMED[:, [0, 1, 3, 2]] * [1e3, 100, 1, 1], ("t=ms*0.001", "x=cm*0.01", "speed", "u")),
    ],
)
def test_columns_are_found_by_map_by_name_or_by_order(header, rows, columns, tmp_path):
    found, notes = transitions(CART, written(tmp_path / "a.csv", header, rows), columns=columns)
    same(found)
    assert ("by their order, pos, speed, force are x, v, u" in " ".join(notes)) == (header == "t,pos,speed,force")
    assert ("no column t" in " ".join(notes)) == (rows.shape[1] == 3 or "gyro" in header)


@pytest.mark.parametrize(
    ("columns", "found", "time"),
    [
        ("Time,Position,Pitch_Rate,Torque", "Position,Pitch_Rate,Torque", "Time"),
        ("T,Pitch Rate [rad/s],POSITION,t_orque,torque", "POSITION,Pitch Rate [rad/s],torque", "T"),
        ("position,pitch rate,torque,T", "position,pitch rate,torque", None),  # a temperature, as likely
        ("time,Time,position,Position,pitch rate,torque", "position,pitch rate,torque", "time"),
    ],
)
def test_names_match_whatever_their_letters_are(columns, found, time):
    every = tuple(columns.split(","))
    table = Table("a.csv", every, np.zeros((3, len(every))), np.arange(3))
    known, note = layout(table, Names(("position", "pitch rate"), ("torque",), (False, False)), (), 0.1)
    assert [column.name for column in (*known.observation, *known.control)] == found.split(",")
    assert (known.time and known.time.name, note) == (time, "")


def test_a_column_that_is_one_names_own_is_no_other_names():
    names, rows = Names(("t", "T"), ("x",), (False, False)), np.zeros((3, 3))
    known, _ = layout(Table("a.csv", ("T", "X", "t"), rows, np.arange(3)), names, (), 0.1)
    assert [column.name for column in (*known.observation, *known.control)] == ["t", "T", "X"]
    twice = Table("a.csv", ("T", "X", "x ", "t", "X [m]"), np.zeros((3, 5)), np.arange(3))
    with pytest.raises(ConfigError, match="no column x"):
        layout(twice, names, (), 0.1)


def test_a_file_without_header_is_read_in_order(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("# by hand\n" + "\n".join(";".join(map(str, row)) for row in ROWS) + "\n\n")
    same(transitions(CART, str(path))[0])
    same(transitions(CART, str(path), columns=("1*1", "0", "2"))[0], ROWS[:, [1, 0, 2]])


@pytest.mark.parametrize("mark", [";", "\t"])
@pytest.mark.parametrize("header", ["", "x,v,u"])
def test_a_comma_is_a_decimal_one_where_another_mark_is_between_cells(header, mark, tmp_path):
    path, rows = tmp_path / "a.csv", [mark.join(map(str, row)).replace(".", ",") for row in ROWS]
    path.write_text("\n".join([header.replace(",", mark)] * bool(header) + rows))
    same(transitions(CART, str(path))[0])


@pytest.mark.parametrize("mark", [", ", ",\t"])
def test_what_follows_a_comma_between_cells_is_nothing(mark, tmp_path):
    path, rows = tmp_path / "a.csv", np.rint(ROWS).astype(int)  # "1," between tabs could be a 1
    path.write_text("\n".join(mark.join(map(str, row)) for row in [("v", "x", "u"), *rows[:, [1, 0, 2]]]))
    same(transitions(CART, str(path))[0], rows)


def test_a_control_is_the_one_sent_at_a_row_or_before_it(tmp_path):
    before = ROWS.copy()
    before[1:, 2], before[0, 2] = ROWS[:-1, 2], np.nan
    same(transitions(CART, written(tmp_path / "a.csv", "x,v,u", before), control="before")[0])


@pytest.mark.parametrize("column", ["episode", "t"])
def test_one_file_may_hold_several_episodes(column, tmp_path):
    first = np.arange(10) % 5 * 0.3 if column == "t" else np.repeat([3, 7], 5)
    other = np.vstack([ROWS, SHIFTED])
    x, u, after = transitions(CART, written(tmp_path / "a.csv", f"{column},x,v,u", np.column_stack([first, other])))[0]
    assert len(x) == 8
    same((x[:4], u[:4], after[:4]))
    same((x[4:], u[4:], after[4:]), SHIFTED)


@pytest.mark.parametrize("column", ["terminals", "Timeouts", "truncated"])
@pytest.mark.parametrize("kind", ["npz", "0", "False"])
def test_a_row_after_an_end_begins_another_episode(column, kind, tmp_path):
    rows, over = np.vstack([ROWS, SHIFTED]), np.arange(10) == 4
    if kind == "npz":
        file = tmp_path / "a.npz"
        np.savez(file, observations=rows[:, :2], actions=rows[:, 2:], **{column: over})
    else:
        told = over if kind == "False" else over.astype(int)
        file = tmp_path / "a.csv"
        lines = [f"x,v,u,{column}", *(",".join(map(str, (*row, end))) for row, end in zip(rows, told, strict=True))]
        file.write_text("\n".join(lines))
    (x, u, after), notes = transitions(CART, str(file))
    assert len(x) == 8
    same((x[4:], u[4:], after[4:]), SHIFTED)
    assert not [note for note in notes if column in note]


def test_a_column_of_other_numbers_ends_no_episode(tmp_path):
    """As one that counts, or the environment's own of that name."""
    path = written(tmp_path / "a.csv", "x,v,u,timeouts", np.column_stack([ROWS, [0, 0, 1, 2, 2]]))
    same(transitions(CART, path)[0])


def test_a_long_episode_is_kept_in_parts_that_lose_no_row(tmp_path):
    rows = np.column_stack([np.linspace(0, 1, 30), np.linspace(0, 2, 30), np.linspace(-1, 1, 30)])
    found = read([written(tmp_path / "a.csv", "x,v,u", rows)], CART)[0]
    assert [len(one.trajectory.u) for one in found] == [8, 8, 8, 5]
    same(transitions(CART, str(tmp_path / "a.csv"))[0], rows)


def test_another_rate_is_resampled_and_controls_are_held(tmp_path):
    """States that are linear in time are exact; a control is that of the newest row."""
    t = np.arange(0, 2.41, 0.1)
    rows = np.column_stack([t, 2 * t, 1 - t, np.floor(t / 0.3 + 1e-9) / 10])
    (x, u, after), notes = transitions(CART, written(tmp_path / "a.csv", "time,x,v,u", rows))
    grid = 0.3 * np.arange(9)
    same((x, u, after), np.column_stack([2 * grid, 1 - grid, np.arange(9) / 10]))
    assert "resampled to dt=0.3" in notes[0]
    assert "change within" not in " ".join(notes)
    rows[4, 3] = 2  # in the middle of a period
    assert "controls change within" in " ".join(transitions(CART, written(tmp_path / "a.csv", "t,x,v,u", rows))[1])


@pytest.mark.parametrize("early", [1e-7, 1e-4, 2e-4])
def test_the_last_time_of_a_log_is_inside_it(early, tmp_path):
    """The last row may be early by a thousandth of a period: no state is then beyond all rows, and unknown."""
    t = np.linspace(0, 0.9 - early, 31)
    rows = np.column_stack([t, t, 0 * t, 0 * t])
    (x, _, after), _ = transitions(CART, written(tmp_path / "a.csv", "t,x,v,u", rows))
    assert x.shape == (3, 2)
    np.testing.assert_allclose(x[:, 0], [0, 0.3, 0.6], atol=1e-6)
    np.testing.assert_allclose(after[-1], [0.9 - early, 0], atol=1e-6)


@pytest.mark.parametrize("low", [-np.pi, 0])
def test_an_angle_is_interpolated_over_its_seam(low, tmp_path):
    t = np.arange(0, 6.01, 0.5)
    angle = 2.5 + 0.7 * t  # over the seam of either convention
    rows = np.column_stack([t, (angle - low) % (2 * np.pi) + low, 0.1 * t])
    rows[3:, 0] += 0.05  # so that nothing of it is on time
    found, _ = read([written(tmp_path / "a.csv", "t,angle,turn", rows)], DIAL)
    x = np.concatenate([one.trajectory.x for one in found])[:, 0]
    assert x.min() >= low - 1e-6
    assert x.max() <= low + 2 * np.pi + 1e-6
    true = np.interp(np.arange(len(found[0].trajectory.x)), rows[:, 0], angle)
    off = found[0].trajectory.x[:, 0] - true
    np.testing.assert_allclose(np.abs(np.exp(1j * off) - 1), 0, atol=1e-5)


def test_a_number_that_is_missing_in_an_angle_is_the_only_one():
    """As in a bag, whose messages are brought to the rows' times before it is cut where something is missing."""
    t, angle = np.arange(6.0), np.array([3.0, 3.1, -3.1, np.nan, -2.9, -2.8])
    np.testing.assert_allclose(interpolated(t, t, angle, turning=True), angle, atol=1e-12)
    between = interpolated(t + 0.5, t, angle, turning=True)
    np.testing.assert_array_equal(np.isnan(between), [False, False, True, True, False, True])  # the last is outside


def test_rows_out_of_order_are_said(tmp_path):
    """A time that goes back begins an episode; where it does not go back to a beginning, rows may be swapped."""
    swapped = TIMED[[0, 1, 3, 2, 4]]
    notes = transitions(CART, written(tmp_path / "a.csv", "t,x,v,u", swapped))[1]
    assert any("line 5: time goes back from 0.9 to 0.6 s, and another episode begins; sort" in note for note in notes)
    notes = transitions(CART, written(tmp_path / "b.csv", "t,x,v,u", np.concatenate([TIMED, TIMED])))[1]
    assert not notes


def test_a_folder_of_logs_and_another_unit_of_time_get_a_way_out(tmp_path):
    slow = written(tmp_path / "a.csv", "t,x,v,u", TIMED * [1e9, 1, 1, 1])
    with pytest.raises(ConfigError, match=r"a row every 3e\+08 s is too rare.*t=COLUMN\*1e-09,"):
        read([slow], CART)
    with pytest.raises(ConfigError, match=rf"data={tmp_path} is a folder; data='{tmp_path}/\*.csv' names its files"):
        read([str(tmp_path)], CART)


def test_a_file_in_another_code_is_said_to_be_that(tmp_path):
    (tmp_path / "a.csv").write_bytes("x,größe,u\n0,0,0\n".encode("latin-1"))
    with pytest.raises(ConfigError, match=r"a.csv is not in UTF-8, and has bytes at 4 that are not; save it so"):
        read([str(tmp_path / "a.csv")], CART)


def test_an_episode_of_one_control_is_one(tmp_path):
    """As a robot's log that ends in its first period, whose time of the last observation nobody wrote."""
    rows = dict(x=ROWS[:2, :2], u=ROWS[:1, 2:], time=np.zeros(1), dt=0.3, state_names=("x", "v"), control_names=("u",))
    np.savez(tmp_path / "0001.npz", **rows)
    same(transitions(CART, str(tmp_path / "0001.npz"))[0], ROWS[:2])


@pytest.mark.parametrize("lost", [np.nan, np.inf, -np.inf])
def test_what_is_missing_cuts_an_episode_and_is_said(lost, tmp_path):
    rows = np.column_stack([0.3 * np.arange(12), np.linspace(0, 1, 12), np.ones(12), np.zeros(12)])
    rows[3, 2] = lost  # line 5: of the observation
    rows[6, 3] = np.nan  # line 8: of the control
    rows[9:, 0] += 3  # line 11 comes late
    (x, u, after), notes = transitions(CART, written(tmp_path / "a.csv", "t,x,v,u", rows))
    np.testing.assert_allclose(x[:, 0], rows[[0, 1, 4, 5, 7, 9, 10], 1], atol=1e-6)
    np.testing.assert_allclose(after[:, 0], rows[[1, 2, 5, 6, 8, 10, 11], 1], atol=1e-6)
    assert np.isfinite(u).all()
    for part in ("line 5 lacks a number of the observation", "line 8 lacks", "line 11 comes 3.3 s after"):
        assert part in " ".join(notes)


GOOD = "t,x,v,u\n0,0,0,0\n.3,0,0,0\n"


@pytest.mark.parametrize(
    ("text", "part"),
    [
        (GOOD + ".6,0,0\n", "line 4 has 3 columns; expected 4"),
        (GOOD + ".6,0,x,0\n", "line 4: v is 'x'; expected a number"),
        (GOOD + ".6,0,0,7\n", "line 4: u is 7, beyond its limits -2 to 2"),
        (GOOD + ".3,0,0,0\n", "line 4: time stands still at 0.3 s"),
        (GOOD + ",0,0,0\n", "line 4: its time is missing"),
        ("t,x,v,u\n0,0,0,0\n300,0,0,0\n", "a row every 300 s is too rare for dt=0.3"),
        ("t,x,speed,u\n0,0,0,0\n", "has no column v, it has t, x, speed, u; data_columns=[...] says"),
        ("t,a,b,c,d\n0,0,0,0,0\n", "has 4 columns, a, b, c, d; expected 3: x, v, u; data_columns=[...]"),
        ("x,v,v\n0,0,0\n", "two columns called 'v'"),
        ("t,x,v,u\n" + "0" * 200_000, "line 2 has 200,000 letters; expected a row of numbers"),
        ("", "is empty"),
        ("t,x,v,u\n", "has a header and no rows; expected rows of numbers"),
        ("t,x,v,u\n0,0,0,0\n", "has no episode"),
    ],
)
def test_what_cannot_be_an_episode_is_refused_in_one_line(text, part, tmp_path):
    (tmp_path / "bad.csv").write_text(text)
    with pytest.raises(ConfigError) as refused:
        read([str(tmp_path / "bad.csv")], CART)
    assert part in str(refused.value)
    assert "bad.csv" in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("columns", "part"),
    [
        (("x", "v"), "has 2 columns without a name; expected 3, for x, v, u"),
        (("x=x", "x=v", "u"), "names x twice"),
        (("angle=x", "v", "u"), "angle is no name of the environment"),
        (("x=x*deg", "v", "u"), "x=x*deg is not COLUMN*FACTOR"),
        (("x", "v", "w"), "has no column w"),
    ],
)
def test_a_map_that_cannot_be_is_refused(columns, part, tmp_path):
    (tmp_path / "a.csv").write_text(GOOD)
    with pytest.raises(ConfigError, match=part.replace("*", r"\*")):
        read([str(tmp_path / "a.csv")], CART, columns)


def test_an_angle_that_a_log_lacks_is_not_in_degrees(tmp_path):
    (tmp_path / "a.csv").write_text("angle,turn\n0.1,0\n0.2,0\ninf,0\n0.3,0\n0.4,0\n")
    (first, second), notes = read([str(tmp_path / "a.csv")], DIAL)
    assert (len(first.trajectory.u), len(second.trajectory.u)) == (1, 1)
    assert "line 4 lacks a number of the observation" in " ".join(notes)


@pytest.mark.parametrize("degrees", [[170.0, 160, 150], [5.0, 20, 35, 55]])
def test_degrees_are_told_from_radians(degrees, tmp_path):
    text = "episode,angle,turn\n0,0,0\n0,0,0\n" + "".join(f"1,{angle},0\n" for angle in degrees)
    (tmp_path / "a.csv").write_text(text)
    line = 4 if degrees[0] > 100 else 5
    with pytest.raises(ConfigError, match=rf"line {line}: angle is .*looks like degrees.*angle\*0.0174533"):
        read([str(tmp_path / "a.csv")], DIAL)
    (x, _, _), _ = transitions(DIAL, str(tmp_path / "a.csv"), columns=("angle*0.017453293", "turn"))
    np.testing.assert_allclose(x[1:, 0], np.deg2rad(degrees[:-1]), atol=1e-6)
    spins = "angle,turn\n" + "".join(f"{angle:.3f},0\n" for angle in np.arange(0, 40, 1.5))  # an encoder that goes on
    (tmp_path / "a.csv").write_text(spins)
    assert len(read([str(tmp_path / "a.csv")], DIAL)[0]) == 5


def test_a_file_that_is_not_there_or_of_no_kind_is_named(tmp_path):
    (tmp_path / "a.mat").touch()
    for name, part in (("b*.csv", "there is no such file"), ("a.mat", "is no log that we read"), ("a.npz", "no such")):
        with pytest.raises(ConfigError, match=part):
            read([str(tmp_path / name)], CART)


def test_arrays_of_numpy_are_columns(tmp_path):
    np.savez(tmp_path / "a.npz", observations=ROWS[:, :2], actions=ROWS[:-1, 2:], rewards=np.zeros(4), note="a word")
    same(transitions(CART, str(tmp_path / "a.npz"))[0])
    np.savez(tmp_path / "b.npz", t=TIMED[:, 0], v=ROWS[:, 1], x=ROWS[:, 0], u=ROWS[:, 2])
    same(transitions(CART, str(tmp_path / "b.npz"))[0])
    np.savez(tmp_path / "c.npz", x=np.zeros((5, 3)), u=np.zeros(4))
    with pytest.raises(ConfigError, match=r"c.npz has no column x, it has x.0, x.1, x.2, u;"):
        read([str(tmp_path / "c.npz")], CART)


def test_the_episodes_of_another_run_are_read_as_they_are(tmp_path):
    """Also where its user observes a cosine and a sine of the angle."""
    pair = ((1, 2),)
    task = DIAL._replace(
        state_names=("x0", "atan2(x2, x1)"), circles=pair, angles=(1,), cost=Cost(lambda x: jnp.cos(x[1]))
    )
    x = np.column_stack([np.arange(4), [3.0, -3.0, -2.5, -2.0]]).astype(np.float32)
    u = np.ones((3, 1), np.float32)
    np.savez(tmp_path / "0001.npz", x=x, u=u, dt=1.0, cost=np.zeros(3), observation=circles.to_observation(x, pair))
    (one,), notes = read([str(tmp_path / "0001.npz")], task)
    np.testing.assert_allclose(one.trajectory.x, x, atol=1e-5)
    np.testing.assert_allclose(one.trajectory.cost, np.cos(x[1:, 1]), atol=1e-5)
    assert notes == []
    np.savez(tmp_path / "0001.npz", observation=np.ones((4, 3)), u=u)
    with pytest.raises(ConfigError, match=r"0001.npz row 0: x1 and x2 are no cosine and sine .* is 1.41"):
        read([str(tmp_path / "0001.npz")], task)


def test_python_adds_them_as_episodes(tmp_path):
    """In arrays of a horizon's length, so that one compiled program adds all."""
    with pytest.warns(UserWarning, match="b.csv: by their order"):
        (one,) = pg.load_logs(written(tmp_path / "b.csv", "t,a,b,c", TIMED), CART)
    assert one.x.shape == (9, 2)
    data = dataset.add(dataset.empty(16, 2, 1), one, ())
    assert int(data.size) == 4
    np.testing.assert_allclose(data.y[:4], np.diff(ROWS[:, :2], axis=0), atol=1e-6)
    with pytest.raises(ConfigError, match="did you mean 'sent'"):
        pg.load_logs("a.csv", CART, control="send")


# In a run's folder

LOGS = pg.Config(data=("logs/*.csv",))


def logs_of(path: Path, episodes: int = 3):
    for number in range(episodes):
        written(path / f"{number}.csv", "t,x,v,u", TIMED + np.array([0, number, 0, 0]))
    return read([str(path / "*.csv")], CART)[0]


def test_the_data_are_those_of_add_episode(tmp_path):
    logs, experiment = logs_of(tmp_path), pg.compose(tiny(trials=4, explore__trials=0), CART, logged=12)
    state = jax.eval_shape(experiment.init, jax.random.key(0))
    assert state.data.x.shape == (1024, 2)  # room for 4 * 8 + 12 rows, and more
    data = jax.tree.map(lambda leaf: leaf[None], dataset.empty(40, 2, 1))
    counts = jnp.zeros(1, int)
    states = RunState(None, data, None, None, counts, counts, counts > 0, None, counts)  # type: ignore[arg-type]
    found = logged.added(states, logs, experiment)
    one = dataset.empty(40, 2, 1)
    for log in logs:
        one = dataset.add(one, log.trajectory, ())
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[0], b), found.data, one)
    assert (int(found.trial[0]), bool(found.succeeded[0])) == (1, False)
    assert logged.told(logs, CART)["log_seconds"] == pytest.approx(3 * 4 * 0.3)


def test_the_folder_keeps_them_all_or_says_what_is_missing(tmp_path):
    run = store.create(tmp_path / "run")
    logged.save(run, logs_of(tmp_path, 5), CART)
    logs = logs_of(tmp_path)
    logged.save(run, logs[:3], CART)  # after a command that was killed before it began
    store.note(run, "pegasus-train", 0, CART)
    assert logged.of_run(LOGS, run).rows == 12
    for one, other in zip(logged.of_run(LOGS, run).episodes(), logs, strict=False):
        assert one.source == other.source
        jax.tree.map(np.testing.assert_array_equal, one.trajectory, other.trajectory)
    (run / "logged" / "0002.npz").unlink()
    with pytest.raises(RunError, match="logged does not hold all logs that the run began with: 2 of 3"):
        logged.of_run(LOGS, run)
    (run / "logged" / "0002.npz").write_bytes(b"damaged")
    with pytest.raises(RunError, match=r"0002.npz cannot be read"):
        logged.of_run(LOGS, run)


def test_words_of_a_command_name_patterns():
    """One, or several; a * would be no YAML."""
    for text, files in (("*.csv", ("*.csv",)), ("[a/*.csv, b.npz]", ("a/*.csv", "b.npz")), ("minari:a/b-v0",) * 2):
        config = config_io.parse({"data": text, "data_columns": "[t=ms*0.001,a,b]", "data_control": "before"})
        assert config.data == (files if isinstance(files, tuple) else (files,))
        assert config.data_columns == ("t=ms*0.001", "a", "b")
        assert config_io.stored_config(config_io.plain(config)) == config
    with pytest.raises(ConfigError, match="data_control=after is not a choice"):
        config_io.parse({"data_control": "after"})
    with pytest.raises(ConfigError, match=r"data_control=before needs data=; expected both, or neither"):
        config_io.parse({"data_control": "before"})


# Files that need a library


@pytest.fixture
def sets(tmp_path, monkeypatch):
    """A folder for Minari's data sets, with one of two episodes of the cart."""
    minari = pytest.importorskip("minari")
    from gymnasium.spaces import Box
    from minari.data_collector.episode_buffer import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    ends = dict(rewards=np.zeros(4), terminations=np.zeros(4, bool), truncations=np.arange(4) == 3)
    episodes = [
        EpisodeBuffer(
            id=i, observations=ROWS[:, :2].astype(np.float32), actions=ROWS[:-1, 2:].astype(np.float32), **ends
        )
        for i in range(2)
    ]
    spaces = dict(action_space=Box(-2, 2, (1,)), observation_space=Box(-np.inf, np.inf, (2,)))
    minari.create_dataset_from_buffers("cart/byhand-v0", episodes, **spaces)


@pytest.mark.filterwarnings("ignore")
def test_a_minari_set_on_this_computer_is_read(sets):
    (x, u, after), notes = transitions(CART, "minari:cart/byhand-v0")
    assert len(x) == 8
    same((x[:4], u[:4], after[:4]))
    same((x[4:], u[4:], after[4:]))
    assert notes == ["minari:cart/byhand-v0: no column t or time: rows are taken to be dt=0.3 s apart"]
    with pytest.raises(ConfigError, match=r"cart/byhands-v0 is not on this computer; did you mean 'cart/byhand-v0'"):
        read(["minari:cart/byhands-v0"], CART)
    with pytest.raises(ConfigError, match="has 2 observations and 1 actions; expected 1 and 1"):
        read(["minari:cart/byhand-v0"], DIAL)


TOPICS = ("x=/joints.position.0*0.01", "v=/joints.velocity.0", "u=/force.data")


@pytest.fixture(params=[("SQLITE3", -0.1), ("MCAP", 0.001)])
def bag(request, tmp_path):
    """A ROS 2 bag of joints in cm every .3 s, and of forces, each sent .1 s before, or 1 ms after."""
    storage, after = request.param
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store_of = get_typestore(Stores.LATEST)
    joints, force = store_of.types["sensor_msgs/msg/JointState"], store_of.types["std_msgs/msg/Float64"]
    header = store_of.types["std_msgs/msg/Header"](store_of.types["builtin_interfaces/msg/Time"](0, 0), "")
    with rosbag2.Writer(tmp_path / "bag", version=9, storage_plugin=rosbag2.StoragePlugin[storage]) as writer:
        to = {t.__msgtype__: writer.add_connection(n, t.__msgtype__, typestore=store_of) for n, t in
              (("/joints", joints), ("/force", force))}  # fmt: skip
        for i, (x, v, u) in enumerate(ROWS):
            at, read_ = round(1e9 + 3e8 * i), joints(header, ["j"], np.array([100 * x]), np.array([v]), np.array([]))
            for message, when in ((force(u), at + round(1e9 * after)), (read_, at)):
                raw = store_of.serialize_cdr(message, message.__msgtype__)
                writer.write(to[message.__msgtype__], when, raw)
    return tmp_path / "bag"


def test_a_bag_is_read_by_topics_and_fields(bag):
    same(transitions(CART, str(bag), columns=TOPICS)[0])
    (one,) = [*bag.glob("*.mcap"), *bag.glob("*.db3")]
    same(transitions(CART, str(one), columns=TOPICS, control="before")[0])
    for columns, part in (
        ((), r"needs data_columns=.*topics are /force \(std_msgs/msg/Float64\), /joints"),
        (("x=/joint.position.0", *TOPICS[1:]), "did you mean '/joints'"),
        (("x=/joints.position.7", *TOPICS[1:]), "/joints.position.7 is no number"),
        (("x=/joints.header", *TOPICS[1:]), "/joints.header is no number"),
        (("t=/joints.position.0", *TOPICS), "names t, and a bag has the times of its messages; leave it out"),
        (("episode=/force.data", *TOPICS), "names episode, and a bag has the times"),
    ):
        with pytest.raises(ConfigError, match=part):
            read([str(bag)], CART, columns)
    one.write_bytes(one.read_bytes()[:100])
    with pytest.raises(ConfigError, match="cannot be read"):
        read([str(one)], CART, TOPICS)


def test_a_library_that_is_missing_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "minari", None)
    monkeypatch.setitem(__import__("sys").modules, "rosbags.highlevel", None)
    (tmp_path / "a.mcap").touch()
    for name, extra in (("minari:cart/byhand-v0", "minari"), (str(tmp_path / "a.mcap"), "logs")):
        with pytest.raises(ConfigError, match=rf"pip install 'pegasus-jax\[{extra}\]'"):
            read([name], CART, TOPICS)


# Tasks whose state is more than what is measured


def test_rates_that_a_robot_computes_are_computed_of_a_log(tmp_path):
    """From row to row, across the seam of an angle; at the start as after it."""
    config = config_io.parse({"task": "cartpole", "sensors.measured": "[0,3]", "sensors.velocity": "difference"})
    task = pg.build(config).task
    t = np.arange(40)
    x, angle = 0.1 * np.sin(t), (3 + 0.3 * t + np.pi) % (2 * np.pi) - np.pi
    rows = np.column_stack([x, angle, np.cos(t)])
    found = read([written(tmp_path / "a.csv", "x,theta,force", rows)], task)[0]
    names = [name.partition(" [")[0] for name in task.state_names]
    seen = np.concatenate([one.trajectory.x[: len(one.trajectory.u)] for one in found])
    assert [len(one.trajectory.u) for one in found] == [25, 14]
    np.testing.assert_allclose(seen[1:, names.index("theta'")], 3.0, atol=1e-4)
    np.testing.assert_allclose(seen[1:, names.index("x'")], np.diff(x)[:-1] / task.dt, atol=1e-5)
    assert seen[0, names.index("theta'")] == pytest.approx(3.0, abs=1e-4)


def test_what_a_controller_remembers_goes_on_from_part_to_part(tmp_path):
    """Each part begins with the rows before it, and its costs are those of the whole."""
    config = config_io.parse({"task": "cartpole", "history": "2", "model.hidden": "[4]", "policy.hidden": "[4]"})
    experiment = pg.build(config)
    rows = np.random.default_rng(0).uniform(-1, 1, (40, 5))
    first, second = read([written(tmp_path / "a.csv", "x,x',theta',theta,force", rows)], experiment.task)[0]
    assert first.trajectory.memory is not None
    place = [i for i, name in enumerate(experiment.task.memory.names) if "force" in name]
    np.testing.assert_allclose(second.trajectory.memory[place], rows[24, 4:], atol=1e-5)
    logged.save(tmp_path, [first, second], experiment.task)  # as another run reads what this one was given
    again = read([str(tmp_path / "logged" / "*.npz")], experiment.task)[0]
    for one, other in zip([first, second], again, strict=True):
        np.testing.assert_allclose(other.trajectory.memory, one.trajectory.memory, atol=1e-6)
        assert other.begins == one.begins
    state = jax.eval_shape(experiment.init, jax.random.key(0))
    for one in pg.load_logs(str(tmp_path / "a.csv"), experiment.task):
        state = jax.eval_shape(experiment.add_episode, state, one)
