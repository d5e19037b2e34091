"""A watchdog that stops a robot's motors where no control has been sent for too long."""

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import Self

from pegasus_jax import interrupt

GRACE = 0.2  # [s] that the main thread has to close the environment itself, and again to end its episode


class Watchdog:
    """In a `with` block: from the first `beat` on, stops the episode once there was none for `limit` seconds.

    The main thread is interrupted, as by Ctrl-C, and closes its environment. Where it hangs so that it cannot, the
    environment is closed from the watchdog's thread; where that does not set it free either, `last_words` is called and
    the process ends. What holds Python's lock, as some drivers do, stops this thread too: a robot needs a watchdog of
    its own besides.
    """

    def __init__(self, limit: float, close: Callable[[], None], last_words: Callable[[], str]) -> None:
        self.limit, self.fired = limit, False
        self._close, self._last_words = close, last_words
        self._last: float | None = None
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def beat(self) -> None:
        """A control is sent now."""
        self._last = time.monotonic()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()

    def _watch(self) -> None:
        while not self._done.wait(self.limit / 20):
            if self._last is not None and time.monotonic() - self._last > self.limit:
                self.fired = True
                self._stop()
                return

    def _stop(self) -> None:
        interrupt.to_main_thread(signal.SIGINT)
        if self._done.wait(GRACE):
            return
        interrupt.let_go(self._close)
        if not self._done.wait(GRACE):
            print(f"pegasus: {self._last_words()}", file=sys.stderr, flush=True)
            os._exit(2)
