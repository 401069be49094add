"""Displacement from a recording: any bag with joint states or joint trajectories."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pea_core.params import ParameterError, nearest

STATE = "sensor_msgs/msg/JointState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"


def read_bag(path: Path, topic: str) -> tuple[np.ndarray, np.ndarray]:
    """Time (s) and displacement (um), (n) each, by the stamps in the messages.

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
    time: list[float] = []
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
                stamp = message.header.stamp
                first = stamp.sec + stamp.nanosec * 1e-9
                if connection.msgtype == STATE:
                    points = [(0.0, message.position)]
                else:
                    points = [
                        (p.time_from_start.sec + p.time_from_start.nanosec * 1e-9, p.positions)
                        for p in message.points
                    ]
                for after, positions in points:
                    if len(positions):
                        time.append(first + after)
                        w.append(float(positions[0]) * 1e6)
    except (AnyReaderError, ReaderError, OSError) as error:
        raise ParameterError(f"{where}: no readable bag: {error}") from None
    if not np.isfinite(w).all():
        raise ParameterError(f"{where}: a position on {topic} is not finite")
    if np.any(np.diff(time) <= 0.0):
        raise ParameterError(f"{where}: time on {topic} must rise from message to message")
    return np.array(time), np.array(w)
