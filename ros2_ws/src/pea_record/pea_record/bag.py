"""A recording as a rosbag2 bag: MCAP files beside their ``metadata.yaml``."""

from __future__ import annotations

import contextlib
import io
import os
import re
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
import yaml

from pea_core.params import ParameterError
from pea_core.units import SECOND
from pea_record.definitions import schema_text, type_hash
from pea_record.mcap import McapWriter
from pea_record.origin import VERSION
from pea_wire.topics import RECORDED_TOPICS, SAMPLED, Topic

LAYOUT = 9
"""Version of ``metadata.yaml``: the one of ROS 2 Jazzy."""

METADATA = "metadata.yaml"
TOPICS = "pea_topics"
"""Name of the metadata record that says what each topic holds."""

LIBRARY = f"pea {VERSION}"

FLUSH_EVERY = 0.5
"""Seconds after which what was recorded is in the file."""


class Split(NamedTuple):
    """When a recording goes on in a new file, as in rosbag2; 0 is never.

    Attributes
    ----------
    size : int
        Bytes of a file.
    duration : float
        Loop time in a file (s): it ends with the first block of samples that reaches it.
    """

    size: int = 0
    duration: float = 0.0


WHOLE = Split()
"""One file, however long."""

SIZES = {"": 1, "kB": 10**3, "MB": 10**6, "GB": 10**9}
"""Bytes in each unit of a size."""

SMALLEST, SHORTEST = 100_000, 0.1
"""Bytes and seconds that a file of a split recording can have at least."""


def split_of(size: str | None, duration: str | None) -> Split:
    """What ``--split-size 100MB`` and ``--split-duration 60`` (s) ask for.

    Raises
    ------
    ParameterError
        One of them is no size, or no duration, or too small.
    """
    found = WHOLE
    if size is not None:
        parts = _SIZE.fullmatch(size)
        count = float(parts[1]) * SIZES[parts[2]] if parts else 0.0
        if not SMALLEST <= count <= 2**50:
            raise ParameterError(
                f"--split-size {size}: give {SMALLEST // 1000}kB or more, as 100MB"
            )
        found = found._replace(size=int(count))
    if duration is not None:
        parts = _SIZE.fullmatch(duration)
        seconds = float(parts[1]) if parts and not parts[2] else 0.0
        if not SHORTEST <= seconds <= 1e9:
            raise ParameterError(f"--split-duration {duration}: give seconds, {SHORTEST} or more")
        found = found._replace(duration=seconds)
    return found


_SIZE = re.compile(rf"(\d+(?:\.\d*)?) ?({'|'.join(SIZES)})")

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


class File:
    """One MCAP file of a bag, with every topic declared.

    Raises
    ------
    OSError
        It cannot be written; it is not there then.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file = io.FileIO(path, "x")
        try:
            self.mcap = McapWriter(self.file, LIBRARY)
            schemas = {
                name: self.mcap.schema(name, schema_text(name))
                for name in dict.fromkeys(topic.type for topic in RECORDED_TOPICS)
            }
            self.channels = {
                topic.name: self.mcap.channel(
                    topic.name,
                    schemas[topic.type],
                    {
                        "offered_qos_profiles": _yaml([offered_qos(topic)]),
                        "topic_type_hash": type_hash(topic.type),
                    },
                )
                for topic in RECORDED_TOPICS
            }
        except OSError:
            self.file.close()
            path.unlink()
            raise

    def part(self) -> _Part:
        """What its complete chunks hold."""
        counts = self.mcap.counts
        held = {name: counts[channel] for name, channel in self.channels.items()}
        return _Part(self.path.name, *self.mcap.span, held)


class _Part(NamedTuple):
    """What ``metadata.yaml`` says of a file.

    Attributes
    ----------
    name : str
    first, last : int
        Log times (ns).
    counts : dict of str to int
        Messages of each topic.
    """

    name: str
    first: int
    last: int
    counts: dict[str, int]

    @property
    def messages(self) -> int:
        """Messages of all topics."""
        return sum(self.counts.values())


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
    split : Split
        When `keep` goes on in a new file. Every file has schemas, topics and records of names and
        texts of its own; each message is in one of them.

    Raises
    ------
    FileExistsError
        There is a recording in it already.
    OSError
        It cannot be written.
    DefinitionError
        A message type is not installed.
    """

    def __init__(self, directory: Path, T_ns: int = 0, split: Split = WHOLE) -> None:
        self.directory = directory
        self.T_ns = T_ns
        self.split = split
        self._flush_at = time.monotonic() + FLUSH_EVERY
        self._seen = {topic.name: _Seen() for topic in RECORDED_TOPICS}
        self._texts: dict[str, dict[str, str]] = {}
        self._parts: list[_Part] = []
        self._since = self._until = -1  # loop times (ns): the file begins; the samples reach
        self._full = False
        for topic in RECORDED_TOPICS:
            schema_text(topic.type)
            type_hash(topic.type)
        directory.mkdir(parents=True, exist_ok=True)
        for old in (*directory.glob("*.mcap"), directory / METADATA):
            if old.exists():
                raise FileExistsError(f"{old} already exists: a recording is never overwritten")
        self._file = self._next()

    def _next(self) -> File:
        name = f"{self.directory.resolve().name}_{len(self._parts)}.mcap"
        return File(self.directory / name)

    @property
    def path(self) -> Path:
        """The file that is written now."""
        return self._file.path

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
        if self._full:
            self._go_on()
        self._file.mcap.message(self._channel(topic), stamp, data)
        self._seen[topic.name].add(stamp, self.T_ns)
        if topic in SAMPLED:
            self._reach(stamp, stamp)

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
        if self._full:
            self._go_on()
        self._file.mcap.messages(self._channel(topic), stamps, rows)
        self._seen[topic.name].add_many(stamps, self.T_ns)
        if len(stamps) and topic in SAMPLED:
            self._reach(int(stamps[0]), int(stamps[-1]))

    def _reach(self, first: int, last: int) -> None:
        """Note how far the samples are; a reference is sent ahead of them, an event at any time."""
        if self._since < 0:
            self._since = first
        self._until = max(self._until, last + self.T_ns)

    def _channel(self, topic: Topic) -> int:
        channels = self._file.channels
        channel = channels.get(topic.name)
        if channel is None:
            raise ValueError(f"{topic.name} is not recorded: one of {', '.join(channels)} is")
        return channel

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a record of names and texts, to later files as well; it is in the file at once."""
        self._file.mcap.metadata(name, values)
        self._texts[name] = dict(values)

    def flush(self) -> None:
        """Bring every message so far into the file.

        Raises
        ------
        OSError
            It cannot be written.
        """
        self._file.mcap.flush()

    def keep(self) -> None:
        """`flush`, where the last time is `FLUSH_EVERY` seconds ago.

        Where the file is long enough, the next message begins a new one.

        Raises
        ------
        OSError
            It cannot be written.
        """
        self._full = self._due()
        now = time.monotonic()
        if now >= self._flush_at:
            self._flush_at = now + FLUSH_EVERY
            self.flush()

    def _due(self) -> bool:
        size, duration = self.split
        return bool(
            (size and self._file.mcap.size >= size)
            or (duration and self._until - self._since >= duration * SECOND)
        )

    def _go_on(self) -> None:
        """Complete the file and go on in a new one; what cannot be stays with the old one."""
        self.flush()
        old = self._file
        self._parts.append(old.part())
        try:
            self._file = self._next()
        except OSError:
            self._parts.pop()
            raise
        self._since = self._until  # not the next stamp: a topic may lag behind the others
        self._full = False
        try:
            self._complete(old, [self._parts[-1]])
            for name, values in self._texts.items():
                self._file.mcap.metadata(name, values)
        finally:
            old.file.close()

    def close(self) -> None:
        """Complete the file and write ``metadata.yaml``; a second call does nothing.

        Raises
        ------
        OSError
            Something could not be written, and no call before had said so. What was complete is
            there all the same.
        """
        if self._file.file.closed:
            return
        told = self._file.mcap.failed is not None
        failure: OSError | None = None
        for step in (self._end, self._write_metadata):
            try:
                step()
            except OSError as error:
                failure = failure or error
        self._file.file.close()
        if failure is not None and not told:
            raise failure

    def _end(self) -> None:
        """Complete the last file."""
        failure: OSError | None = None
        try:
            self.flush()
        except OSError as error:
            failure = error
        self._parts.append(self._file.part())
        self._complete(self._file, self._parts[-1:])
        os.fsync(self._file.file.fileno())
        if failure is not None:
            raise failure

    def _complete(self, file: File, parts: list[_Part]) -> None:
        if file.mcap.failed is None:
            file.mcap.metadata(TOPICS, self._topics())
        told = {"serialized_metadata": _yaml(self._information(parts))}
        file.mcap.metadata("rosbag2", told)
        file.mcap.finish()

    def _write_metadata(self) -> None:
        draft = self.directory / f"{METADATA}.tmp"
        try:
            with open(draft, "w", encoding="utf-8") as file:
                file.write(_yaml({"rosbag2_bagfile_information": self._information(self._parts)}))
                file.flush()
                os.fsync(file.fileno())
            os.replace(draft, self.directory / METADATA)
        except OSError:
            with contextlib.suppress(OSError):
                draft.unlink()
            raise

    def _topics(self) -> dict[str, str]:
        """First and last stamp, count, gaps and repeats of each topic so far, as YAML."""
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

    def _information(self, parts: list[_Part]) -> dict[str, Any]:
        """What ``metadata.yaml`` says of the complete chunks of some files."""
        held = [part for part in parts if part.messages]

        def extent(parts: list[_Part]) -> dict[str, Any]:  # anew each time: YAML makes no alias
            first = min((part.first for part in parts), default=0)
            return {
                "duration": {"nanoseconds": max((part.last for part in parts), default=0) - first},
                "starting_time": {"nanoseconds_since_epoch": first},
                "message_count": sum(part.messages for part in parts),
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
                "message_count": sum(part.counts[topic.name] for part in parts),
            }
            for topic in RECORDED_TOPICS
        ]
        return {
            "version": LAYOUT,
            "storage_identifier": "mcap",
            **extent(held),
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [part.name for part in parts],
            "files": [{"path": part.name, **extent([part])} for part in parts],
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


def _yaml(value: object) -> str:
    return str(yaml.safe_dump(value, sort_keys=False))
