"""Trackers: offline, each has the numbers, settings and pictures of every trial, also of a run that went on."""

from __future__ import annotations

import gc
import re
import struct
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from tensorboardX.proto.event_pb2 import Event

from folders import a_run, row
from pegasus_jax.checks import ConfigError, RunError
from pegasus_jax.cli.train import understood
from pegasus_jax.runs import config_io, store, tracked, trackers
from pegasus_jax.viz.run_plots import trial_pictures


def learned(run: Path, trials: range, track: tuple[str, ...] | None, said: list[str] | None = None) -> None:
    """What a job tells the trackers of a run whose folder has what it learned: of these trials, after those before."""
    config, say = config_io.load(run / "config.yaml"), (said if said is not None else []).append
    with ExitStack() as closing:
        writer = tracked.writer({0: run}, config, store.task_of(run), track, trial_pictures, say, closing)
        writer.begin(trials.start - 1)
        for trial in trials:
            writer.trial(trial, None, [numbered(trial)])  # type: ignore[arg-type]


def numbered(trial: int) -> dict[str, Any]:
    return row(trial, seconds={"fit": 1.5}, mean_cost=trial / 8)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    made = a_run(tmp_path / "demo")
    store.write_trials(made, [numbered(trial) for trial in (1, 2, 3)])
    return made


def events(run: Path) -> Iterator[Any]:
    """What lies in a run's TensorBoard folder, in the order in which it was written."""
    for path in sorted((run / "tensorboard").iterdir(), key=lambda path: path.stat().st_mtime_ns):
        data = path.read_bytes()
        while data:
            (length,) = struct.unpack("<Q", data[:8])
            yield Event.FromString(data[12 : 12 + length])
            data = data[16 + length :]


@pytest.mark.filterwarnings("error::ResourceWarning", "error::pytest.PytestUnraisableExceptionWarning")
def test_tensorboard_leaves_no_file_open(run: Path) -> None:
    learned(run, range(1, 2), ("tensorboard",))
    gc.collect()  # a file that is still open warns when it is collected


def test_tensorboard_has_numbers_settings_and_pictures(run: Path) -> None:
    learned(run, range(1, 3), ("tensorboard",))
    learned(run, range(3, 4), None)
    found = [(event.step, value) for event in events(run) for value in event.summary.value]
    costs = {step: value.simple_value for step, value in found if value.tag == "mean_cost"}
    assert costs == {1: 0.125, 2: 0.25, 3: 0.375}
    assert {step for step, value in found if value.tag == "seconds/fit"} == {1, 2, 3}
    images = [value.image for _, value in found if value.tag == "learning"]
    assert len(images) == 3
    assert images[0].encoded_image_string.startswith(b"\x89PNG")
    assert (images[0].width, images[0].height) == (770, 605)
    assert b"search.particles | 8" in next(v for _, v in found if v.tag.startswith("config")).tensor.string_val[0]


@pytest.mark.slow
def test_wandb_and_mlflow_go_on_offline_in_the_same_run(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mlflow = pytest.importorskip("mlflow")
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    uri = f"sqlite:///{run.parent}/mlflow.db"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
    monkeypatch.chdir(run.parent)  # where MLflow puts its files
    learned(run, range(1, 2), ("wandb", "mlflow"))
    first = tracked.remembered(run)
    monkeypatch.delenv("MLFLOW_TRACKING_URI")
    learned(run, range(3, 4), None)  # trial 2 was learned, and the process was killed before it told it
    assert first is not None
    assert tracked.remembered(run) == {name: (known, 3) for name, (known, _) in first.items()}

    client = mlflow.MlflowClient(tracking_uri=uri)
    (found,) = client.search_runs([client.get_experiment_by_name(trackers.PROJECT).experiment_id])
    assert found.info.status == "FINISHED"
    assert found.info.run_name == "demo"
    history = client.get_metric_history(found.info.run_id, "mean_cost")
    assert [(one.step, one.value) for one in history] == [(1, 0.125), (2, 0.25), (3, 0.375)]
    assert found.data.params["search.particles"] == "8"
    assert {one.path for one in client.list_artifacts(found.info.run_id)} == {"config.yaml", "learning"}
    assert len(client.list_artifacts(found.info.run_id, "learning")) == 3

    runs = sorted((run / "wandb").glob(f"offline-run-*-{first['wandb'][0]['id']}"))
    assert len(runs) == 2  # `wandb sync` puts them together: they have one id
    assert len(list((run / "wandb").glob("offline-*/files/media/images/learning*.png"))) == 3
    logged = b"".join(next(path.glob("*.wandb")).read_bytes() for path in runs)
    costs = re.findall(rb"mean_cost.{1,6}?(0\.\d+)", logged, re.DOTALL)  # in its records, and in its summaries
    assert [*dict.fromkeys(costs)] == [b"0.125", b"0.25", b"0.375"]


class Service:
    """A tracker that notes what it is told, and may fail at a trial."""

    def __init__(self, fails: int = 0) -> None:
        self.told: list[int] = []
        self.pictures: list[tuple[int, str]] = []
        self.closed = 0
        self.fails = fails

    def open(self, opening: trackers.Opening) -> trackers.Tracker:
        return trackers.Tracker({"id": "a"}, self.trial, self.picture, self.close)

    def trial(self, row: Any) -> None:
        if row["trial"] == self.fails:
            raise ConnectionError("no\nanswer")
        self.told.append(row["trial"])

    def picture(self, trial: int, name: str, file: Path) -> None:
        assert file.exists()
        self.pictures.append((trial, name))

    def close(self) -> None:
        self.closed += 1


def test_a_tracker_that_fails_ends_no_run_and_is_told_later(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    service, said = Service(fails=2), []
    monkeypatch.setitem(trackers.TRACKERS, "wandb", service.open)
    learned(run, range(1, 4), ("wandb",), said)
    assert said == ["track=wandb: no answer; going on without it"]
    assert (service.told, service.pictures, service.closed) == ([1], [(1, "learning")], 0)
    service.fails = 0
    learned(run, range(4, 5), None, said)
    assert (service.told, service.closed, len(said)) == ([1, 2, 3, 4], 1, 1)
    learned(run, range(5, 6), ())  # track=none
    assert service.told[-1] == 4
    learned(run, range(6, 7), None)
    assert service.told[-1] == 4
    (run / tracked.FILE).write_text("{")
    with pytest.raises(RunError, match=r"tracked\.json cannot be read"):
        learned(run, range(6, 7), None)


def test_a_tracker_that_cannot_be_opened_is_said_before_anything_moves(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(opening: trackers.Opening) -> trackers.Tracker:
        raise RuntimeError("no API key\nconfigured")

    monkeypatch.setitem(trackers.TRACKERS, "wandb", refuse)
    with pytest.raises(RunError, match=r"track=wandb: no API key configured .*track=none without it") as refusal:
        learned(run, range(1, 2), ("wandb",))
    assert "\n" not in str(refusal.value)


def test_the_words_of_trackers(monkeypatch: pytest.MonkeyPatch) -> None:
    for text, names in {"none": (), "[wandb,mlflow]": ("wandb", "mlflow"), "wandb,wandb": ("wandb",)}.items():
        monkeypatch.setattr(trackers, "find_spec", lambda name: name)
        assert understood(["task=cartpole", f"track={text}"])[0].track == names
    with pytest.raises(ConfigError, match=r"track=wandbb is unknown; did you mean 'wandb'"):
        understood(["task=cartpole", "track=wandbb"])
    with pytest.raises(ConfigError, match=r"track=none,wandb has none beside others; type track=none, or leave it out"):
        understood(["task=cartpole", "track=none,wandb"])
    monkeypatch.setattr(trackers, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"track=mlflow needs .*'pegasus-jax\[track\]'"):
        understood(["task=cartpole", "track=mlflow"])
