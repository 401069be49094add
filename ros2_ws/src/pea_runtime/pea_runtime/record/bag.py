"""A recording as a rosbag2 bag: one MCAP file beside its ``metadata.yaml``."""

from __future__ import annotations

import contextlib
import io
import os
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import yaml

from pea_ros.topics import RECORDED_TOPICS, SAMPLED, Topic
from pea_runtime.record.definitions import schema_text, type_hash
from pea_runtime.record.mcap import McapWriter
from pea_runtime.record.origin import VERSION

LAYOUT = 9
"""Version of ``metadata.yaml``: the one of ROS 2 Jazzy."""

METADATA = "metadata.yaml"
TOPICS = "pea_topics"
"""Name of the metadata record that says what each topic holds."""

LIBRARY = f"pea {VERSION}"

FLUSH_EVERY = 0.5
"""Seconds after which what was recorded is in the file."""

_INFINITE = {"sec": 9223372036, "nsec": 854775807}


def offered_qos(topic: Topic) -> dict[str, Any]:
    """Quality of service that publishers of `topic` offer, in rosbag2's words."""
    return {
        "history": "keep_last",
        "depth": topic.depth,
        "reliability": "reliable",
        "durability": "transient_local" if topic.latched else "volatile",
        "deadline": dict(_INFINITE),
        "lifespan": dict(_INFINITE),
        "liveliness": "automatic",
        "liveliness_lease_duration": dict(_INFINITE),
        "avoid_ros_namespace_conventions": False,
    }


class _Seen:
    """What has come of one topic."""

    __slots__ = ("count", "first", "gaps", "last", "repeats")

    def __init__(self) -> None:
        self.count = 0
        self.first = self.last = -1
        self.gaps = self.repeats = 0

    def add(self, stamp: int, T_ns: int) -> None:
        step = stamp - self.last
        if step != T_ns and self.count:
            self.repeats += step <= 0
            self.gaps += max(step // T_ns - 1, 0) if T_ns else 0
        elif not self.count:
            self.first = stamp
        self.count += 1
        self.last = stamp

    def add_many(self, stamps: np.ndarray, T_ns: int) -> None:
        if not len(stamps):
            return
        self.add(int(stamps[0]), T_ns)
        steps = np.diff(stamps)
        self.repeats += int(np.count_nonzero(steps <= 0))
        self.gaps += int((steps // T_ns - 1).clip(0).sum()) if T_ns else 0
        self.count += len(steps)
        self.last = int(stamps[-1])


class BagWriter:
    """Records the topics of `RECORDED_TOPICS` into a directory that rosbag2 plays.

    Messages reach the file a chunk at a time: a writer that is killed loses at most what came
    since the last `flush`. What comes after a failed write is refused, and `close` leaves what
    was complete.

    Parameters
    ----------
    directory : Path
        The bag; made where it is missing. It may hold other files, but no recording.
    T_ns : int
        Sample period (ns), by which missing samples are counted; 0 where it is not known.

    Raises
    ------
    FileExistsError
        There is a recording in it already.
    OSError
        It cannot be written.
    DefinitionError
        A message type is not installed.
    """

    def __init__(self, directory: Path, T_ns: int = 0) -> None:
        self.directory = directory
        self.T_ns = T_ns
        self._flush_at = time.monotonic() + FLUSH_EVERY
        self._seen = {topic.name: _Seen() for topic in RECORDED_TOPICS}
        self.path = directory / f"{directory.resolve().name}_0.mcap"
        definitions = {
            topic.type: (schema_text(topic.type), type_hash(topic.type))
            for topic in RECORDED_TOPICS
        }
        directory.mkdir(parents=True, exist_ok=True)
        for old in (*directory.glob("*.mcap"), directory / METADATA):
            if old.exists():
                raise FileExistsError(f"{old} is there already: a recording is never overwritten")
        self._file = io.FileIO(self.path, "x")
        try:
            self._mcap = McapWriter(self._file, LIBRARY)
            schemas = {
                name: self._mcap.schema(name, text) for name, (text, _) in definitions.items()
            }
            self._channels = {
                topic.name: self._mcap.channel(
                    topic.name,
                    schemas[topic.type],
                    {
                        "offered_qos_profiles": _yaml([offered_qos(topic)]),
                        "topic_type_hash": definitions[topic.type][1],
                    },
                )
                for topic in RECORDED_TOPICS
            }
        except OSError:
            self._file.close()
            self.path.unlink()
            raise

    def write(self, topic: Topic, stamp: int, data: bytes) -> None:
        """Record one message.

        Parameters
        ----------
        topic : Topic
            One of `RECORDED_TOPICS`.
        stamp : int
            Loop time (ns), 0 or later.
        data : bytes
            CDR.

        Raises
        ------
        ValueError
            The topic is none of these, or the stamp is negative.
        OSError
            A chunk was full and could not be written.
        """
        self._mcap.message(self._channel(topic), stamp, data)
        self._seen[topic.name].add(stamp, self.T_ns)

    def write_many(self, topic: Topic, stamps: np.ndarray, rows: np.ndarray) -> None:
        """Record messages of equal size.

        Parameters
        ----------
        topic : Topic
            One of `RECORDED_TOPICS`.
        stamps : (n,) array of int64
            Loop times (ns), 0 or later.
        rows : (n,) structured array
            CDR of one message a row, as from `JointStateCodec.encode_many`.

        Raises
        ------
        ValueError
            The topic is none of these, a stamp is negative, or there are not as many stamps
            as rows.
        OSError
            A chunk was full and could not be written.
        """
        self._mcap.messages(self._channel(topic), stamps, rows)
        self._seen[topic.name].add_many(stamps, self.T_ns)

    def _channel(self, topic: Topic) -> int:
        channel = self._channels.get(topic.name)
        if channel is None:
            raise ValueError(f"{topic.name} is not recorded: one of {', '.join(self._channels)} is")
        return channel

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a record of names and texts; it is in the file at once."""
        self._mcap.metadata(name, values)

    def flush(self) -> None:
        """Bring every message so far into the file.

        Raises
        ------
        OSError
            It cannot be written.
        """
        self._mcap.flush()

    def keep(self) -> None:
        """`flush`, where the last time is `FLUSH_EVERY` seconds ago.

        Raises
        ------
        OSError
            It cannot be written.
        """
        now = time.monotonic()
        if now >= self._flush_at:
            self._flush_at = now + FLUSH_EVERY
            self.flush()

    def close(self) -> None:
        """Complete the file and write ``metadata.yaml``; a second call does nothing.

        Raises
        ------
        OSError
            Something could not be written, and no call before had said so. What was complete is
            there all the same.
        """
        if self._file.closed:
            return
        told = self._mcap.failed is not None
        failure: OSError | None = None
        for step in (self._complete, self._write_metadata):
            try:
                step()
            except OSError as error:
                failure = failure or error
        self._file.close()
        if failure is not None and not told:
            raise failure

    def _complete(self) -> None:
        failure: OSError | None = None
        try:
            self._mcap.flush()
        except OSError as error:
            failure = error
        if self._mcap.failed is None:
            self._mcap.metadata(TOPICS, self._topics())
        self._mcap.metadata("rosbag2", {"serialized_metadata": _yaml(self._information())})
        self._mcap.finish()
        os.fsync(self._file.fileno())
        if failure is not None:
            raise failure

    def _write_metadata(self) -> None:
        draft = self.directory / f"{METADATA}.tmp"
        try:
            with open(draft, "w", encoding="utf-8") as file:
                file.write(_yaml({"rosbag2_bagfile_information": self._information()}))
                file.flush()
                os.fsync(file.fileno())
            os.replace(draft, self.directory / METADATA)
        except OSError:
            with contextlib.suppress(OSError):
                draft.unlink()
            raise

    def _topics(self) -> dict[str, str]:
        """First and last stamp, count, missing and repeated stamps of each topic, as YAML."""
        told = {}
        for topic in RECORDED_TOPICS:
            seen = self._seen[topic.name]
            if not seen.count:
                continue
            facts = {"messages": seen.count, "first_ns": seen.first, "last_ns": seen.last}
            if topic in SAMPLED and self.T_ns:
                facts |= {"gaps": seen.gaps, "repeats": seen.repeats}
            told[topic.name] = _yaml(facts)
        return told

    def _information(self) -> dict[str, Any]:
        """What ``metadata.yaml`` says of the complete chunks."""
        counts = self._mcap.counts
        first, last = self._mcap.span

        def extent() -> dict[str, Any]:  # made anew each time, or YAML would make an alias of it
            return {
                "duration": {"nanoseconds": last - first},
                "starting_time": {"nanoseconds_since_epoch": first},
                "message_count": sum(counts.values()),
            }

        topics = [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.type,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": [offered_qos(topic)],
                    "type_description_hash": type_hash(topic.type),
                },
                "message_count": counts[self._channels[topic.name]],
            }
            for topic in RECORDED_TOPICS
        ]
        return {
            "version": LAYOUT,
            "storage_identifier": "mcap",
            **extent(),
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self.path.name],
            "files": [{"path": self.path.name, **extent()}],
            "custom_data": {},
            "ros_distro": "jazzy",
        }

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _yaml(value: Any) -> str:
    return str(yaml.safe_dump(value, sort_keys=False))
