"""pegasus-watch: a page on localhost that renews itself. That Ctrl-C ends it is in test_docs."""

from __future__ import annotations

import os
import shutil
import socket
import struct
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest

import browser
from folders import a_run, row
from pegasus_jax.checks import ConfigError, RunError
from pegasus_jax.cli import watch
from pegasus_jax.report import progress, serve
from pegasus_jax.report.progress import state
from pegasus_jax.runs import store


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return a_run(tmp_path_factory.mktemp("watch") / "run")


@pytest.fixture
def run(made: Path, tmp_path: Path) -> Path:
    """A run of three trials, two of which are done."""
    copy = shutil.copytree(made, tmp_path / "run")
    store.write_trials(copy, [row(trial, seconds={"fit": 40.0, "compile": 99.0}) for trial in (1, 2)])
    return copy


@contextmanager
def served(path: Path) -> Iterator[str]:
    with serve.server([path], 0) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()
        thread.join()


def test_a_new_trial_appears_by_itself_and_what_is_open_stays_open(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The browser opens a fold; then the third trial is done; then the page has it, and the fold is still open."""
    asked: list[Path] = []

    def learn(paths: Sequence[Path]) -> str:
        asked.extend(paths)
        if len(asked) == 3:  # two seconds after the page was there
            store.write_trials(run, [row(trial) for trial in (1, 2, 3)])
        return state(paths)

    monkeypatch.setattr(serve, "state", learn)
    until = """(() => {
        const fold = document.getElementById('trial-1')
        if (fold && !window.was) { window.was = document.querySelector('#trials table').rows.length; fold.open = true }
        return Boolean(window.was && document.querySelector('#trials table').rows.length > window.was)
    })()"""
    with served(run) as address:
        script = "[window.was, document.querySelector('#trials table').rows.length,"
        script += " document.getElementById('trial-1').open, document.title]"
        seen = browser.opened(address, script, until=until)
    assert seen["found"] == [3, 4, True, "cartpole, seed 0"]  # rows with the head
    assert seen["console"] == []
    assert all(one.startswith((address, "data:")) for one in seen["asked"])


def test_a_page_is_sent_again_only_where_it_changed(run: Path) -> None:
    with served(run) as address:
        first = urlopen(f"{address}content")
        again = Request(f"{address}content", headers={"If-None-Match": first.headers["ETag"]})
        with pytest.raises(HTTPError, match="304"):
            urlopen(again)
        store.write_trials(run, [row(trial) for trial in (1, 2, 3)])
        assert urlopen(again).status == 200
        assert urlopen(Request(address, headers={"Host": "localhost"})).status == 200  # of port 80 a browser names none
        for wrong, headers in (("etc/passwd", {}), ("", {"Host": "example.com"})):
            with pytest.raises(HTTPError, match=r"40[34]"):
                urlopen(Request(address + wrong, headers=headers))


def test_what_happens_now_is_said(run: Path) -> None:
    now = time.time() + 0.4  # in which this second of the 40 begins
    os.utime(run / "trials.jsonl", (now, now))
    assert state([run]) == "trial 3 of 3: its episode has run, it is being learned from; about 40 s left"
    store.episode_path(run, 3).unlink()
    assert state([run]).startswith("trial 3 of 3: waiting for its episode")
    store.write_trials(run, [row(trial) for trial in (1, 2, 3)])
    assert state([run]) == "done: 3 of 3 trials"
    assert state([run.parent / "gone"]).startswith(f"{run.parent / 'gone'} is not a run")


def test_a_folder_that_is_moved_away_while_it_is_read_is_one_line(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(*_: object) -> None:
        raise FileNotFoundError(2, "No such file or directory", "trials.jsonl")

    monkeypatch.setattr(progress, "_left", gone)
    assert "No such file or directory" in state([run])


def test_a_tab_that_closes_before_its_answer_leaves_no_traceback(
    run: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    asked, closed = threading.Event(), threading.Event()

    def late(_: object) -> str:
        asked.set()
        assert closed.wait(20)
        return "x" * 10_000_000

    monkeypatch.setattr(serve, "state", late)
    with served(run) as address:
        host, port = address.removeprefix("http://").rstrip("/").split(":")
        with socket.create_connection((host, int(port))) as tab:
            tab.sendall(f"GET /state HTTP/1.0\r\nHost: {host}:{port}\r\n\r\n".encode())
            assert asked.wait(20)
            tab.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # closed at once
        closed.set()
        time.sleep(0.5)
    assert "Traceback" not in capfd.readouterr().err


def test_a_run_without_a_trial_is_waited_for(run: Path) -> None:
    (run / "trials.jsonl").unlink()
    with served(run) as address:
        assert b"No trial is finished yet" in urlopen(f"{address}content").read()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ([], "no run is named"),
        (["nowhere"], "nowhere is not a run"),
        (["RUN", "port=http"], "port=http is not a whole number; for example port=8765"),
        (["RUN", "port=70000"], r"port=70000 is out of range; expected a number in [0, 65535]; the nearest is 65535"),
        (["RUN", "prot=1"], "prot is not an option here; did you mean 'port'"),
        (["RUN", "port=TAKEN"], "is used by another program; for example port="),
    ],
)
def test_what_cannot_be_watched_is_one_line(run: Path, words: list[str], says: str) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        with pytest.raises((ConfigError, RunError)) as caught:
            watch.handle([word.replace("RUN", str(run)).replace("TAKEN", port) for word in words])
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
