"""Displacement from a recording: any bag with joint states or joint trajectories."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pea_core.params import ParameterError, nearest
from pea_core.tables import Table
from pea_core.units import NS, SECOND

STATE = "sensor_msgs/msg/JointState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"


def read_bag(path: Path, topic: str) -> Table:
    """Time (s) and displacement (um), by the stamps in the messages.

    Parameters
    ----------
    path : Path
        Directory of a rosbag2 bag.
    topic : str
        Topic with the position of one axis, the first named.

    Raises
    ------
    ParameterError
        It is no bag, it lacks the topic, a position is not finite, or time does not rise.
    """
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.rosbag2 import ReaderError
    from rosbags.typesys import Stores, get_typestore

    where = f"path = '{path}'"
    time: list[int] = []  # ns: a time of day has too many digits for a float
    w: list[float] = []
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            fitting = {c.topic: c for c in reader.connections if c.msgtype in (STATE, TRAJECTORY)}
            if topic not in fitting:
                raise ParameterError(
                    f"{where}: no positions on topic {topic!r}, {nearest(topic, fitting)}"
                )
            for connection, _, raw in reader.messages([fitting[topic]]):
                message: Any = reader.deserialize(raw, connection.msgtype)
                first = _ns(message.header.stamp)
                if connection.msgtype == STATE:
                    points = [(0, message.position)]
                else:
                    points = [(_ns(p.time_from_start), p.positions) for p in message.points]
                for after, positions in points:
                    if len(positions):
                        time.append(first + after)
                        w.append(float(positions[0]) * 1e6)
    except (AnyReaderError, ReaderError, OSError) as error:
        raise ParameterError(f"{where}: no readable bag: {error}") from None
    if not np.isfinite(w).all():
        raise ParameterError(f"{where}: a position on {topic} is not finite")
    stamps = np.array(time, np.int64)
    if np.any(np.diff(stamps) <= 0):
        raise ParameterError(f"{where}: time on {topic} must rise from message to message")
    first = time[0] if time else 0
    said = f"{len(w)} positions of {topic}, in m, by the stamps of its messages"
    if first:
        said += f"; time counts from {first // SECOND}.{first % SECOND:09d} s"
    return Table((stamps - first) * NS, stamps * NS, np.array(w), said)


def _ns(time: Any) -> int:
    """A time or duration of a message."""
    return int(time.sec) * SECOND + int(time.nanosec)
