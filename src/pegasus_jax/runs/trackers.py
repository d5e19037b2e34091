"""Trackers: where the numbers, settings and pictures of a run also go. One is a value, which tracked.py tells."""

import logging
import math
import os
import secrets
import time
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pegasus_jax.checks import ConfigError, did_you_mean

if TYPE_CHECKING:  # a command looks at its words before JAX is there
    from pegasus_jax.runs.writers import Row

Say = Callable[[str], None]
Known = dict[str, Any]  # what a tracker calls a run


class Opening(NamedTuple):
    """What a tracker is opened with."""

    run: Path
    settings: dict[str, Any]  # config_io.plain
    first: int  # the first trial that it will be told
    known: Known  # what it called this run before; empty for a new one
    say: Say


class Tracker(NamedTuple):
    """Where one run's results also go. What a function raises ends its tracker, never the run."""

    known: Known
    trial: Callable[["Row"], None]
    picture: Callable[[int, str, Path], None]  # trial, name, PNG file
    close: Callable[[], None]


def tensorboard(opening: Opening) -> Tracker:
    """Event files in RUN/tensorboard; what earlier ones say of the trials from the first on is replaced."""
    from pegasus_jax.runs.tensorboard import Board

    board = Board(opening.run / "tensorboard", opening.first, opening.say)
    board.settings(opening.settings)
    return Tracker({}, lambda row: board.add(row["trial"], numbers(row)), board.picture, board.close)


def wandb(opening: Opening) -> Tracker:
    """A run of Weights & Biases: its own variables, as WANDB_MODE=offline, say where. Its files are in RUN/wandb."""
    import wandb  # pyright: ignore[reportMissingImports]

    known = opening.known or {"id": secrets.token_hex(4)}
    run = wandb.init(
        project=os.environ.get("WANDB_PROJECT", PROJECT),
        id=known["id"],
        name=title(opening.run),
        dir=str(opening.run),
        resume="allow",
        reinit="create_new",  # several seeds are several runs of one process
        config=opening.settings,
        allow_val_change=True,
        settings=wandb.Settings(console="off", silent=True),
    )
    if not run.offline:
        opening.say(f"wandb: {run.url}")
    return Tracker(
        known,
        trial=lambda row: run.log(numbers(row), step=row["trial"]),
        picture=lambda trial, name, file: run.log({name: wandb.Image(str(file))}, step=trial),
        close=run.finish,
    )


def mlflow(opening: Opening) -> Tracker:
    """A run of MLflow, in the store of MLFLOW_TRACKING_URI, or else mlflow.db where the command runs."""
    from mlflow import MlflowClient, get_tracking_uri  # pyright: ignore[reportMissingImports]
    from mlflow.entities import Metric, Param  # pyright: ignore[reportMissingImports]

    for name in ("mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.WARNING)  # of a new store: a line a table
    uri = opening.known.get("uri") or get_tracking_uri()
    client, project = MlflowClient(tracking_uri=uri), os.environ.get("MLFLOW_EXPERIMENT_NAME", PROJECT)
    if opening.known:
        run = opening.known["run"]
        client.update_run(run, status="RUNNING")
    else:
        found = client.get_experiment_by_name(project)
        experiment = found.experiment_id if found else client.create_experiment(project)
        run = client.create_run(experiment, run_name=title(opening.run)).info.run_id
        settings = [Param(name, str(value)) for name, value in opening.settings.items()]
        client.log_batch(run, params=settings)  # they cannot be changed there: config.yaml has those of today
    client.log_artifact(run, str(opening.run / "config.yaml"))
    opening.say(f"mlflow: run {run} in {uri}")

    def trial(row: "Row") -> None:
        now = int(time.time() * 1000)
        client.log_batch(run, [Metric(name, value, now, row["trial"]) for name, value in numbers(row).items()])

    return Tracker(
        {"run": run, "uri": uri},
        trial,
        picture=lambda trial, name, file: client.log_artifact(run, str(file), f"{name}/{trial:04d}"),
        close=lambda: client.set_terminated(run),
    )


TRACKERS: dict[str, Callable[[Opening], Tracker]] = {"tensorboard": tensorboard, "wandb": wandb, "mlflow": mlflow}
PACKAGES = {"tensorboard": "tensorboardX", "wandb": "wandb", "mlflow": "mlflow"}
NONE = "none"
PROJECT = "pegasus-jax"  # that of wandb, the experiment of mlflow, unless their variables say another


def asked(track: str | Sequence[str] | None) -> tuple[str, ...] | None:
    """The trackers that the word track= names; None where it is not there. Raises ConfigError for what cannot be."""
    if track is None:
        return None
    text = ",".join([track] if isinstance(track, str) else track).strip("[]")
    names = [name.strip() for name in text.split(",")]
    if names == [NONE]:
        return ()
    if NONE in names:
        raise ConfigError(f"track={text} has none beside others; type track=none, or leave it out")
    for name in names:
        if name not in TRACKERS:
            raise ConfigError(f"track={name} is unknown; {did_you_mean(name, (*TRACKERS, NONE))}")
        if find_spec(PACKAGES[name]) is None:
            raise ConfigError(f"track={name} needs the package {PACKAGES[name]}: pip install 'pegasus-jax[track]'")
    return tuple(dict.fromkeys(names))


def numbers(row: "Row") -> dict[str, float]:
    """The finite numbers of a trial's row, by name."""
    every = row | {f"seconds/{name}": value for name, value in row["seconds"].items()}
    return {name: value for name, value in every.items() if isinstance(value, int | float) and math.isfinite(value)}


def title(run: Path) -> str:
    """What a tracker calls a run at first: its folder, for one of many seeds with theirs."""
    return f"{run.parent.name}/{run.name}" if run.name.startswith("seed") else run.name
