"""MCAP files and ROS bags as tables, read by `rosbags` without ROS. Needs the extra `logs`."""

from collections.abc import Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from pegasus_jax.checks import ConfigError, did_you_mean
from pegasus_jax.logs.columns import SETTING, mapped
from pegasus_jax.logs.episodes import interpolated
from pegasus_jax.logs.table import EPISODE, Names, Table, reason

SUFFIXES = (".mcap", ".db3", ".bag")
Series = tuple[np.ndarray, np.ndarray]  # times [s], values


def of_bag(path: Path, names: Names, columns: Sequence[str], control: str = "sent") -> Table:
    """The table of a bag: a row for each message of the topic of the observation's first entry.

    The map says of each entry a topic and a field, as /joint_states.position.0. Times are when messages were recorded.
    Other observations are interpolated linearly to the rows' times, and controls are those held in the middle of the
    period after a row, or before it where `control` is "before": a loop sends one a little after it has read. Raises
    ConfigError for topics and fields that are not there, and for a map that names t or episode.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ConfigError(f"data={path} needs rosbags: pip install 'pegasus-jax[logs]'") from error
    said = mapped(columns, names)
    for name in ("t", EPISODE):
        if name in said and name not in (*names.observation, *names.control):
            raise ConfigError(f"{path}: {SETTING} names {name}, and a bag has the times of its messages; leave it out")
    try:
        with AnyReader([whole(path)], default_typestore=get_typestore(Stores.LATEST)) as bag:
            if not said:
                topics = ", ".join(sorted(f"{c.topic} ({c.msgtype})" for c in bag.connections))
                raise ConfigError(f"{path} needs {SETTING}=[/topic.field,...]; its topics are {topics}")
            wanted = {said[name].name for name in (*names.observation, *names.control)}
            series = {column: _series(path, bag, column) for column in sorted(wanted)}
    except ConfigError:
        raise
    except Exception as error:  # of a damaged or foreign file rosbags and its libraries raise whatever they come across
        raise ConfigError(f"data={path} cannot be read: {reason(error)}") from error
    grid = series[said[names.observation[0]].name][0]
    table: dict[str, np.ndarray] = {"t": grid}
    for name, turning in zip(names.observation, names.turning, strict=True):
        column, factor, _ = said[name]
        table[column] = interpolated(grid, *series[column], turning, abs(2 * np.pi / factor))
    half = (0.5 if control == "sent" else -0.5) * (np.median(np.diff(grid)) if len(grid) > 1 else 0)
    for name in names.control:
        t, values = series[said[name].name]
        held = np.searchsorted(t, grid + half, side="right") - 1
        table[said[name].name] = np.where(held < 0, np.nan, values[held])
    return Table(str(path), tuple(table), np.column_stack([*table.values()]), np.arange(len(grid)), "message")


def whole(path: Path) -> Path:
    """What is to be opened: of a bag that is a folder with its metadata, the folder."""
    return path.parent if path.suffix.lower() == ".db3" and (path.parent / "metadata.yaml").exists() else path


def _series(path: Path, bag: Any, column: str) -> Series:
    """The times and the numbers of a field of a topic."""
    topics = sorted({c.topic for c in bag.connections})
    topic = max((t for t in topics if column == t or column.startswith(f"{t}.")), key=len, default=None)
    if topic is None:
        raise ConfigError(f"{path} has no topic of {column}; {did_you_mean(column.partition('.')[0], topics)}")
    fields = column.removeprefix(topic).strip(".").split(".")
    t, values = [], []
    for connection, stamp, raw in bag.messages([c for c in bag.connections if c.topic == topic]):
        t.append(stamp)
        values.append(_field(path, column, bag.deserialize(raw, connection.msgtype), fields))
    if not t:
        raise ConfigError(f"{path} has no message of {topic}")
    order = np.unique(np.array(t), return_index=True)[1]
    return (np.array(t)[order] - bag.start_time) * 1e-9, np.array(values)[order]


def _field(path: Path, column: str, value: Any, fields: Sequence[str]) -> float:
    """The number in a message where the path of fields leads, those of arrays by their place."""
    try:
        for field in fields:
            value = value[int(field)] if field.isdecimal() else attrgetter(field)(value)
        return float(value)
    except (AttributeError, IndexError, TypeError, ValueError):
        wanted = f"{SETTING}=[/topic.field.0,...]"
        raise ConfigError(f"{path}: {column} is no number in a message; expected {wanted}") from None
