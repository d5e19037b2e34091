"""A robot at the other end of a connection, as examples/remote_robot has it: what is lost, late or wrong stops it."""

from __future__ import annotations

import importlib
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import forked
from pegasus_jax.runs import config_io, store
from probes import TINY_WORDS

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "remote_robot"
NAMES = ("messages", "robot_side", "remote_robot")


@pytest.fixture
def sides(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The example's modules: what passes, the robot's side, and the environment."""
    monkeypatch.syspath_prepend(str(EXAMPLE))
    yield [importlib.import_module(name) for name in NAMES]
    gymnasium.registry.pop("Remote-v0")
    for name in NAMES:
        del sys.modules[name]


class Robot:
    """It remembers what it was sent, and reads it back; its reading may take long."""

    state_names, control_names = ["left [V]", "right [V]"], ["a [V]", "b [V]"]
    low, high = [-1.0, -1.0], [1.0, 2.0]

    def __init__(self) -> None:
        self.sent: list[list[float]] = []
        self.takes = 0.0

    def start(self, seed: int | None) -> None:
        self.sent.append([float(seed or 0)] * 2)

    def motors(self, control: list[float]) -> None:
        self.sent.append(control)

    def read(self) -> list[float]:
        time.sleep(self.takes)
        return self.sent[-1]


class Served:
    """A robot's side that answers one driver after the other in a thread, until the test ends."""

    def __init__(self, side: Any, messages: Any) -> None:
        self.robot, self.server = side.robot, socket.create_server(("127.0.0.1", 0))
        self.port = self.server.getsockname()[1]

        def answer() -> None:
            while True:
                try:
                    connected, _ = self.server.accept()
                except OSError:
                    return
                side.serve(messages.Connection(connected))

        threading.Thread(target=answer, daemon=True).start()

    def stopped(self, within: float = 5.0) -> bool:
        """Whether the last that its motors were sent is zeros, now or soon."""
        end = time.monotonic() + within
        while self.robot.sent[-1] != [0.0, 0.0] and time.monotonic() < end:
            time.sleep(0.005)
        return self.robot.sent[-1] == [0.0, 0.0]


@pytest.fixture
def served(sides: Any) -> Any:
    messages, robot_side, _ = sides
    made = Served(robot_side.Side(Robot(), 0.02, 25), messages)
    yield made
    made.server.close()


def driver(sides: Any, served: Served, **given: Any) -> Any:
    return sides[2].Remote(port=served.port, **given)


def test_it_is_an_environment_that_knows_itself(sides: Any, served: Served) -> None:
    robot = driver(sides, served)
    assert (robot.dt, robot.timeout) == (0.02, 0.5)
    assert (robot.state_names, robot.control_names) == (("left [V]", "right [V]"), ("a [V]", "b [V]"))
    np.testing.assert_allclose([robot.action_space.low, robot.action_space.high], [[-1, -1], [1, 2]])
    x, about = robot.reset(seed=3)
    np.testing.assert_allclose(x, [3, 3])
    times = [about["time"]]
    for u in ([0.5, -0.5], [1.0, 2.0], [0.0, 0.1]):
        x, _, *ended, about = robot.step(np.array(u))
        np.testing.assert_allclose(x, u)
        assert ended == [False, False]
        times.append(about["time"])
    assert np.all(np.array(times) - times[0] > 0.02 * np.arange(4) - 1e-3)  # the robot's side keeps the period
    robot.rest()
    assert served.stopped(within=0.0)
    np.testing.assert_allclose(robot.reset(seed=4)[0], [4, 4])
    robot.step(np.array([1.0, 1.0]))
    robot.close()
    assert served.stopped()


def test_a_driver_that_is_silent_or_gone_stops_the_motors(sides: Any, served: Served, capsys: Any) -> None:
    robot = driver(sides, served)
    robot.reset(seed=1)
    robot.step(np.array([1.0, 1.0]))
    began = time.monotonic()
    assert served.stopped()
    assert time.monotonic() - began > 0.3
    with pytest.raises(ValueError, match=r"answered control 2 by .*the motors were stopped; a reset comes first"):
        robot.step(np.array([1.0, 1.0]))
    with pytest.raises(ConnectionError, match="is not connected any more"):
        robot.step(np.array([1.0, 1.0]))
    assert served.stopped()
    another = driver(sides, served)
    another.reset(seed=1)
    another.step(np.array([0.5, 0.5]))
    another._let_go()  # as when its process is killed
    assert served.stopped(within=0.4)
    assert "motors stopped: no control for 25 periods" in capsys.readouterr().out


def test_a_connection_finds_out_that_the_other_computer_is_gone(sides: Any, served: Served) -> None:
    robot = driver(sides, served)
    assert robot._robot._socket.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
    robot.close()


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_signal_stops_the_motors(sides: Any, name: str) -> None:
    program = [sys.executable, "-u", str(EXAMPLE / "robot_side.py"), "port=0", "silence=1000"]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as side:
        assert side.stdout is not None
        found = re.search(r":(\d+), a period", side.stdout.readline())
        assert found
        robot = sides[2].Remote(port=int(found[1]))
        robot.reset()
        robot.step(np.array([1.0]))
        side.send_signal(signal.Signals[name])
        said, ended = side.communicate(timeout=30)
        robot.close()
    assert "motors stopped: this side ends" in said
    assert ended == "terminated\n"


@pytest.mark.parametrize(
    ("question", "says"),
    [
        ({"do": "control", "number": 3, "control": [0.1, 0.1]}, "control 3 came after 1"),
        ({"do": "control", "number": 2, "control": [0.1, 2.1]}, "is not from"),
        ({"do": "control", "number": 2, "control": [0.1, float("nan")]}, "is not from"),
        ({"do": "control", "number": 2, "control": [0.1]}, "ValueError: zip"),
        ({"do": "control", "number": 2, "control": [10**400, 0.1]}, "OverflowError"),
        ({"do": "control", "number": 2}, "KeyError: 'control'"),
        ({"do": "dance", "number": 2}, "KeyError: 'dance'"),
    ],
)
def test_a_question_that_makes_no_sense_stops_the_motors(
    sides: Any, served: Served, question: dict[str, Any], says: str
) -> None:
    robot = driver(sides, served)
    robot.reset()
    robot.step(np.array([1.0, 1.0]))
    robot._robot.send(question)
    answer = robot._robot.receive(5)
    assert says in answer["error"]
    assert served.stopped(within=0.0)
    robot.close()


@pytest.mark.parametrize("line", [b"[1, 2]\n", b"[" * 60_000 + b"\n"])
def test_what_is_no_message_ends_the_connection(sides: Any, served: Served, line: bytes) -> None:
    robot = driver(sides, served)
    robot.reset()
    robot.step(np.array([1.0, 1.0]))
    robot._robot._socket.sendall(line)
    assert served.stopped(within=0.4)
    with pytest.raises(ConnectionError, match="was lost at control 2, the other side closed the connection"):
        robot.step(np.array([1.0, 1.0]))
    driver(sides, served).close()  # the next one is answered


def test_a_robot_that_does_not_answer_in_time_is_let_go(sides: Any, served: Served) -> None:
    robot = driver(sides, served, timeout=0.1)
    robot.reset()
    served.robot.takes = 0.3
    with pytest.raises(TimeoutError, match=r"127.0.0.1:\d+ has not answered control 1 for 0.1 s"):
        robot.step(np.array([1.0, 1.0]))
    assert served.stopped()


def test_no_robot_is_one_line(sides: Any) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(ConnectionError, match=rf"no robot at 127.0.0.1:{port}, .*; start robot_side.py there"):
        sides[2].Remote(port=port)


def test_another_answer_than_the_one_asked_for_is_refused(sides: Any) -> None:
    """As one that came late would be: no control may follow from an old reading."""
    messages, _, remote_robot = sides
    with socket.create_server(("127.0.0.1", 0)) as server:
        here, (there, _) = socket.create_connection(server.getsockname()), server.accept()
    robot = object.__new__(remote_robot.Remote)
    robot.where, robot.number, robot.timeout, robot._robot = "here", 4, 0.5, messages.Connection(here)
    messages.Connection(there).send({"number": 4, "time": 0.0, "observation": [0.0]})
    with pytest.raises(ValueError, match=r"here answered control 5 by \{'number': 4"):
        robot.step([0.0])
    there.close()


# Whole commands

TINY = [*TINY_WORDS, "trials=2"]
WORDS = ["task=gym", "env=remote_robot:Remote-v0", "cost=remote_robot:cost", "angles=[0]", "eval_episodes=0"]
WORDS += ["start_mean=[3.14,0]", "horizon=10"]


def command(module: str, function: str, *words: str) -> subprocess.CompletedProcess[str]:
    path = f"{EXAMPLE}:{os.environ.get('PYTHONPATH', '')}"
    program = f"from pegasus_jax.cli.{module} import {function}; {function}()"
    return forked.run(program, words, Path.cwd(), os.environ | {"PYTHONPATH": path})


@pytest.mark.slow
def test_commands_learn_from_it_drive_it_and_lose_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its side is killed while it is driven: one line, and the rows until then.

    Its motors stop after 25 periods without a control; those of .1 s are longer than a busy machine hesitates.
    """
    monkeypatch.chdir(tmp_path)
    program = [sys.executable, "-u", str(EXAMPLE / "robot_side.py"), "port=0", "period=0.1"]
    side = subprocess.Popen(program, stdout=subprocess.PIPE, text=True)
    assert side.stdout is not None
    found = re.search(r"127.0.0.1:(\d+), a period of 0.1 s", side.stdout.readline())
    assert found
    words = [*WORDS, *TINY, f"env_args.port={found[1]}"]
    try:
        done = command("main", "train", *words, "out=run")
        assert done.returncode == 0, done.stderr
        assert [len(ran.trajectory.u) for n in (1, 2) if (ran := store.load_episode(Path("run"), n))] == [10, 10]
        assert store.task_of(Path("run")).state_names == ("angle [rad]", "rate [rad/s]")
        killer = threading.Thread(target=_kill_when_driven, args=(side, 2), daemon=True)
        killer.start()
        done = command("drive", "run", "run", "seconds=60")
        killer.join(60)
    finally:
        side.kill()
        side.wait()
    assert done.returncode == 2
    (line,) = (line for line in done.stderr.splitlines() if line.startswith("pegasus: "))
    kept = re.search(
        r"the robot at .* was lost at control \d+, .*; its (\d+) rows are kept in run/driven/0001.npz$", line
    )
    assert kept, line
    with np.load("run/driven/0001.npz") as log:
        assert log["u"].shape == (int(kept[1]), 1)
        assert np.isfinite(log["cost"]).all()


def _kill_when_driven(side: subprocess.Popen[str], drivers: int) -> None:
    """Kill the robot's side half a second after so many drivers in all have come."""
    assert side.stdout is not None
    while drivers and (line := side.stdout.readline()):
        drivers -= line.startswith("driven from")
    time.sleep(0.5)
    side.send_signal(signal.SIGKILL)


def test_its_readme_has_the_commands_of_its_programs() -> None:
    readme = " ".join((EXAMPLE / "README.md").read_text().replace("\\", " ").split())
    for name in ("robot_side", "remote_robot"):
        text = (EXAMPLE / f"{name}.py").read_text().split('"""')[1]
        (shown,) = re.findall(r"\n\n((?:    .*\n)+)", text)
        first = " ".join(shown.replace("\\", " ").split())
        assert first in readme or name == "robot_side"
        assert f"`{name}.py`" in readme
    assert "python robot_side.py host=127.0.0.1 port=5555 period=0.05" in readme
    words = re.findall(r"pegasus-train (task=.*?) out=", readme)[0].split()
    assert config_io.parse(config_io.split(words)[1]).env == "remote_robot:Remote-v0"
