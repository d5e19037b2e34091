"""What a person sees while a run goes on: a live line on a terminal, plain lines elsewhere."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from pegasus_jax.types import Array


class Display:
    """Shows where a run is. `phase` and `advance` move the live line; `line` prints one that stays."""

    def __init__(self, trials: int, done: int, console: Console | None = None, quiet: bool = False) -> None:
        self.console = console or Console(file=sys.stderr, highlight=False, quiet=quiet)
        self.trials, self.done, self.began = trials, done, time.monotonic()
        self.ran = 0.0  # trials finished here, in fractions
        self.live: Progress | None = None
        self.task = None

    @contextmanager
    def running(self) -> Iterator["Display"]:
        """Keep the live line up, where there is a terminal, until the block ends."""
        if not self.console.is_terminal:
            yield self
            return
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[left]}"))
        with Progress(*columns, console=self.console, transient=True) as self.live:
            self.task = self.live.add_task("starting", total=1.0, left="")
            yield self
        self.live = None

    def phase(self, trial: int, what: str, fraction: float = 0.0, cost: float | Array | None = None) -> None:
        """Trial `trial` is doing `what`, `fraction` of the whole trial is behind."""
        if self.live is None or self.task is None:
            return
        self.ran = trial - 1 - self.done + fraction
        spent = time.monotonic() - self.began
        left = spent / self.ran * (self.trials - self.done - self.ran) if self.ran > 0.2 else None
        note = "" if cost is None else f"  imagined cost {float(cost):.3f}"
        self.live.update(
            self.task,
            completed=fraction,
            description=f"trial {trial}/{self.trials}  {what:<8}{note}",
            left="" if left is None else f"{left:.0f} s left",
        )

    def line(self, text: str) -> None:
        """Print a line that stays."""
        self.console.print(text, markup=False, soft_wrap=True)
