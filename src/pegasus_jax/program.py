"""The compiled parts of an experiment, for one seed or for many at once, and the clock on them."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax

from pegasus_jax.types import Experiment

NAMES = ("collect", "fit", "search", "imagine", "evaluate", "compile")


class Jitted:
    """A jitted function that says how long compiling took; compiles once, or it is a defect."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function, self.compiled, self.seconds = jax.jit(function), None, 0.0

    def __call__(self, *arguments: Any) -> Any:
        if self.compiled is None:
            began = time.monotonic()
            self.compiled = self.function.lower(*arguments).compile()
            self.seconds = time.monotonic() - began
        return jax.block_until_ready(self.compiled(*arguments))


class Program:
    """An experiment over S seeds: every argument and result has a leading axis [S], except those that all share."""

    def __init__(self, experiment: Experiment, search_steps: int, seeds: int = 1) -> None:
        over = partial(over_seeds, seeds=seeds)
        self.chunk = chunk(search_steps)
        self.chunks = search_steps // self.chunk
        self.parts = {
            "init": Jitted(over(experiment.init, (0,))),
            "episode": Jitted(over(experiment.episode, (0, 0, None))),
            "absorb": Jitted(over(experiment.absorb, (0, 0))),
            "fit": Jitted(over(experiment.fit, (0,))),
            "search": Jitted(over(partial(experiment.search, steps=self.chunk), (0, None))),
            "imagine": Jitted(over(experiment.imagine, (0,))),
        }
        self.spent: dict[str, float] = {}

    def __call__(self, part: str, *arguments: Any, purpose: str | None = None) -> Any:
        """Run a part; its time is counted as that of `purpose`."""
        jitted, name = self.parts[part], purpose or part
        began, compiled = time.monotonic(), jitted.seconds
        result = jitted(*arguments)
        compiling = jitted.seconds - compiled
        self.spent[name] = self.spent.get(name, 0.0) + time.monotonic() - began - compiling
        self.spent["compile"] = self.spent.get("compile", 0.0) + compiling
        return result

    def seconds(self) -> dict[str, float]:
        """Seconds spent in each part since the last call."""
        spent, self.spent = self.spent, {}
        return {name: round(spent.get(name, 0.0), 3) for name in NAMES}


def over_seeds(function: Callable[..., Any], axes: tuple[int | None, ...], *, seeds: int) -> Callable[..., Any]:
    """The function over a leading axis of `seeds`; one seed is the function itself, so that its numbers do not change.

    `axes` is 0 for an argument with that axis, None for one that all seeds share.
    """
    if seeds > 1:
        return jax.vmap(function, axes)

    def alone(*arguments: Any) -> Any:
        own = (
            argument if axis is None else jax.tree.map(lambda leaf: leaf[0], argument)
            for argument, axis in zip(arguments, axes, strict=True)
        )
        return jax.tree.map(lambda leaf: leaf[None], function(*own))

    return alone


def chunk(steps: int) -> int:
    """Search iterations between two looks at the clock: a divisor of `steps` near a tenth of it."""
    divisors = [d for d in range(1, steps + 1) if steps % d == 0]
    return next(d for d in divisors if d * 20 >= steps)
