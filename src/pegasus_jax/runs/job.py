"""What the loop of Alg. 1 works with: the config, its compiled experiment, the display and the writer."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from pegasus_jax import tasks
from pegasus_jax.assembly.experiments import build, capacity, set_precision
from pegasus_jax.config import Config
from pegasus_jax.experiment import Experiment
from pegasus_jax.imagine import costs
from pegasus_jax.learn.data import grow
from pegasus_jax.runs import first, restore, traced, writers
from pegasus_jax.runs.display import Display
from pegasus_jax.runs.logged import NONE, Logs
from pegasus_jax.runs.programs import Program, is_main_process
from pegasus_jax.runs.writers import Writer
from pegasus_jax.tasks import guide
from pegasus_jax.types import Cost, RunState


class Job(NamedTuple):
    """S seeds of one config as one program."""

    config: Config
    seeds: Sequence[int]
    experiment: Experiment
    program: Program
    display: Display
    writer: Writer
    logs: Logs = NONE  # trial 1 of a run that has some
    cost_since: Sequence[int] = ()  # of each seed, where its user has changed the cost: the first trial with today's

    def random(self, trial: int) -> bool:
        """Whether the episode of this trial explores: by random controls, or a controller of its user's."""
        return trial <= self.config.explore.trials


@contextmanager
def opened(
    config: Config, seeds: Sequence[int], mesh: Mesh | None = None, logs: Logs = NONE, run: Path | None = None
) -> Iterator[Job]:
    """A job whose display is up and whose environment is closed afterwards. It writes nothing until told where.

    Its first controller is the one that `run`, a folder of its own, has a copy of. JAX has the config's precision from
    here on.
    """
    set_precision(config)
    loaded = first.loaded(config, run)
    experiment = build(loaded, mesh, logs.rows)
    try:
        rows = capacity(config, experiment.task, logs.rows)
        kept = traced.store(config, len(seeds), rows, alone=mesh is None)
        program = Program(experiment, config.search.steps, len(seeds), mesh, traced=kept)
        display = Display(config.trials, quiet=not is_main_process())
        display.exploring = guide.exploring(config)
        display.asks = experiment.task.environment is not None
        with display.running():
            program.on_compile = display.compiling
            yield Job(config, seeds, experiment, program, display, writers.nothing(len(seeds)), logs)
    finally:
        tasks.close(experiment.task)


def first_states(job: Job, stored: RunState | None = None, changed: bool = False) -> RunState:
    """The states [S, ...] that a job begins with: fresh ones, or `stored`, made to fit the config.

    With `changed` settings of fit or search the optimizers may have to start again. The search, which takes longest
    to compile, begins to be compiled here.
    """
    config, task = job.config, job.experiment.task
    done = 0 if stored is None else int(stored.trial[0])
    if max(done + 1, config.explore.trials) <= config.trials:  # else no policy is searched
        if isinstance(task.cost, Cost) and task.cost.expected is None:
            costs.nodes_for(len(task.state_names) + len(task.memory.names))  # not in the compiler's thread
        job.program.prepare("search")
    keys = jnp.stack([jax.random.key(seed) for seed in job.seeds])
    if stored is None:
        states = job.program("init", keys)
    elif changed or any(learner.optimizer is None for learner in (stored.model, stored.policy)):
        states = restore.suited(stored, job.program("init", keys))
    else:
        states = stored
    rows = capacity(config, task, job.logs.rows)
    if rows > states.data.x.shape[1]:
        states = states._replace(data=jax.vmap(partial(grow, capacity=rows))(states.data))
    return states
