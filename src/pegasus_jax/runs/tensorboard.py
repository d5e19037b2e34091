"""The numbers of trials as TensorBoard scalars.

They are written by who adds them: tensorboardX's own writer has a thread, which on a full disk dies with a traceback.
"""

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog  # pyright: ignore[reportAttributeAccessIssue]
from tensorboardX.summary import scalar


class Board:
    """A new event file in a folder, which takes the place of what earlier ones say of the trials from `first` on.

    A run needs none: what the file system refuses is said once, by `say`, and then left out.
    """

    def __init__(self, folder: Path, first: int, say: Callable[[str], None]) -> None:
        self._folder, self._say, self._writer = folder, say, None
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._writer = EventsWriter(str(folder / "events"))
        except OSError as error:
            self._stop(error)
        version = Event(step=first, file_version="brain.Event:2")
        self._write([version, Event(step=first, session_log=SessionLog(status=SessionLog.START))])

    def add(self, row: dict[str, Any]) -> None:
        """The finite numbers of a trial's row."""
        numbers = row | {f"seconds/{name}": value for name, value in row["seconds"].items()}
        known = {name: value for name, value in numbers.items() if isinstance(value, int | float)}
        summaries = [scalar(name, value) for name, value in known.items() if math.isfinite(value)]
        self._write([Event(wall_time=time.time(), step=row["trial"], summary=summary) for summary in summaries])

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
