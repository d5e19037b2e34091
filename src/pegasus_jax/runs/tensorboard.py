"""The numbers of trials as TensorBoard scalars, with settings and pictures.

They are written by who adds them: tensorboardX's own writer has a thread, which on a full disk dies with a traceback.
"""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog  # pyright: ignore[reportAttributeAccessIssue]
from tensorboardX.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]
from tensorboardX.summary import scalar, text


class Board:
    """A new event file in a folder, which takes the place of what earlier ones say of the trials from `first` on.

    A run needs none: what the file system refuses is said once, by `say`, and then left out.
    """

    def __init__(self, folder: Path, first: int, say: Callable[[str], None]) -> None:
        self._folder, self._first, self._say, self._writer = folder, first, say, None
        try:
            folder.mkdir(parents=True, exist_ok=True)
            # Its name ends with a second: a run that goes on within the same one would write over the file before.
            self._writer = EventsWriter(str(folder / "events"), f".{time.time_ns()}")
        except OSError as error:
            self._stop(error)
        version = Event(step=first, file_version="brain.Event:2")
        self._write([version, Event(step=first, session_log=SessionLog(status=SessionLog.START))])

    def add(self, trial: int, numbers: Mapping[str, float]) -> None:
        """The numbers of a trial."""
        self._summaries(trial, [scalar(name, value) for name, value in numbers.items()])

    def settings(self, settings: dict[str, Any]) -> None:
        """The settings, as a table."""
        lines = [f"| {name} | {value} |" for name, value in settings.items()]
        self._summaries(self._first, [text("config", "\n".join(["| setting | value |", "|---|---|", *lines]))])

    def picture(self, trial: int, name: str, file: Path) -> None:
        """A PNG file, as it is."""
        encoded = file.read_bytes()
        width, height = (int.from_bytes(encoded[at : at + 4]) for at in (16, 20))  # of its header
        image = Summary.Image(height=height, width=width, colorspace=4, encoded_image_string=encoded)
        self._summaries(trial, [Summary(value=[Summary.Value(tag=name, image=image)])])

    def close(self) -> None:
        """Nothing more is added."""
        if self._writer is None:
            return
        try:
            self._writer.close()
        except OSError as error:
            self._stop(error)
        self._writer = None

    def _summaries(self, step: int, summaries: list[Any]) -> None:
        self._write([Event(wall_time=time.time(), step=step, summary=summary) for summary in summaries])

    def _write(self, events: list[Event]) -> None:
        if self._writer is None:
            return
        try:
            for event in events:
                self._writer.write_event(event)
            self._writer.flush()
        except OSError as error:
            self._stop(error)

    def _stop(self, error: OSError) -> None:
        self._writer = None
        self._say(f"{self._folder} cannot be written: {error.strerror}; going on without it")
