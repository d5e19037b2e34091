"""Minari data sets that are on this computer, as tables. Needs the extra `minari`."""

import numpy as np

from pegasus_jax.checks import ConfigError, did_you_mean
from pegasus_jax.logs.table import EPISODE, Names, Table, reason

PREFIX = "minari:"


def of_set(name: str, names: Names) -> Table:
    """The table of all episodes of a data set; rows are a control period apart. Raises ConfigError where it cannot be.

    Nothing is downloaded.
    """
    what = f"data={PREFIX}{name}"
    try:
        import h5py  # noqa: F401  what Minari reads most of its sets with
        import minari
    except ImportError as error:
        raise ConfigError(f"{what} needs Minari: pip install 'pegasus-jax[minari]'") from error
    there = list(minari.list_local_datasets())
    if name not in there:
        raise ConfigError(f"{what} is not on this computer; {did_you_mean(name, there) if there else 'no data set is'}")
    try:
        episodes = [(one.observations, one.actions) for one in minari.load_dataset(name).iterate_episodes()]
    except Exception as error:  # of what Minari cannot read it raises many kinds
        raise ConfigError(f"{what} cannot be read: {reason(error)}") from error
    rows = []
    for number, (x, u) in enumerate(episodes):
        if not isinstance(x, np.ndarray) or not isinstance(u, np.ndarray):
            raise ConfigError(f"{what} has observations or actions that are no arrays, but {type(x).__name__}")
        x, u = x.reshape(len(x), -1), u.reshape(len(u), -1)
        if (x.shape[1], u.shape[1]) != (len(names.observation), len(names.control)):
            raise ConfigError(
                f"{what} has {x.shape[1]} observations and {u.shape[1]} actions; expected {len(names.observation)} and"
                f" {len(names.control)}"
            )
        sent = np.vstack([u, np.full((len(x) - len(u), u.shape[1]), np.nan)])
        rows.append(np.column_stack([np.full(len(x), number), x, sent]))
    columns = (EPISODE, *names.observation, *names.control)
    return Table(
        what.removeprefix("data="), columns, np.vstack(rows), np.concatenate([np.arange(len(r)) for r in rows])
    )
