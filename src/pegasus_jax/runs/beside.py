"""Work that nobody has to wait for: a thread does it while the robot moves, and during the next search."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager

from pegasus_jax.runs.programs import begun

PATIENCE = 2.0  # [s] that a command which was asked to stop waits for what is under way


class Beside:
    """Does one piece of work after the other. Its error is raised when the next one is handed over, or by `check`."""

    def __init__(self, threads: bool = True) -> None:
        self.threads = threads
        self.last: Future | None = None

    def __call__(self, work: Callable[[], None]) -> None:
        """Begin this as soon as what came before has ended; without threads, do it now."""
        self.finish()
        if self.threads:
            self.last = begun(work)
        else:
            work()

    def finish(self) -> None:
        """Wait until all is done."""
        if self.last is not None:
            wait([self.last])
            last, self.last = self.last, None
            last.result()

    def check(self) -> None:
        """Raise what has been raised; wait for nothing."""
        if self.last is not None and self.last.done():
            self.finish()


@contextmanager
def beside(threads: bool = True) -> Iterator[Beside]:
    """A `Beside` whose work is done when the block ends, by an error too; after a signal it has 2 s to end."""
    worker = Beside(threads)
    try:
        yield worker
        worker.finish()
    except BaseException as error:
        if worker.last is not None:
            wait([worker.last], PATIENCE if isinstance(error, KeyboardInterrupt) else None)
        raise
