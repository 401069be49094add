"""Reads a recording back: the samples of the loop, assembled by stamp.

The stamp is the one in the message, so bags of other recorders, which log the time of arrival,
are read alike. Messages of the layout that pea publishes are read a chunk at a time, others one
by one.
"""

from __future__ import annotations

import struct
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError, UnsupportedCompressionError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata, Schema, Statistics
from mcap.stream_reader import get_chunk_data_stream

from pea_core.signals import SAMPLE
from pea_ros import convert, events
from pea_ros.convert import ConversionError, JointStateCodec
from pea_ros.events import ParameterEvent
from pea_ros.topics import (
    DISPLACEMENT,
    PARAMETER_EVENTS,
    REFERENCE,
    SAMPLED,
    STATE,
    VOLTAGE,
    Topic,
)
from pea_runtime.record.mcap import FIXED, MAGIC, MESSAGE

LOOP = (*SAMPLED, REFERENCE)
"""Topics that a sample is assembled from."""

_CODECS: dict[str, tuple[JointStateCodec, ...]] = {
    DISPLACEMENT.name: (convert.DISPLACEMENT, convert.DISPLACEMENT_IDEAL),
    STATE.name: (convert.STATE,),
    VOLTAGE.name: (convert.VOLTAGE,),
}
_FIELDS = ("position", "velocity", "effort")
_FREE = {"sec", "nanosec", *_FIELDS, *(f"pad_{field}" for field in _FIELDS)}
"""Fields of a row that may hold anything; the others are the same in every message."""

_RECORD = struct.Struct("<BQ")
_CHANNEL = struct.Struct("<H")

_READERS = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.CHUNK: Chunk.read,
    Opcode.METADATA: Metadata.read,
    Opcode.STATISTICS: Statistics.read,
}

_DAMAGES = (
    McapError,
    struct.error,
    ValueError,
    OverflowError,
    RuntimeError,
    MemoryError,
    zstandard.ZstdError,
)
"""What the readers of a record raise where its bytes are not what they should be."""


class BagError(Exception):
    """A recording that cannot be read; one line that says why."""


@dataclass(frozen=True)
class Recording:
    """What a recording holds.

    Attributes
    ----------
    samples : (n,) array of `SAMPLE`
        The complete samples, by stamp; a NaN where a message leaves a field out.
    stamps : (n,) array of int64
        Their stamps (ns).
    T_ns : int
        Sample period (ns): the commonest distance of stamps; 0 where there is one stamp only.
    counts : dict of str to int
        Messages of every topic.
    gaps : dict of str to int
        For each topic of the loop, stamps missing between its first and its last.
    repeats : dict of str to int
        For each topic of the loop, stamps that came again; the first of each counts.
    spans : dict of str to (int, int)
        For each topic of the loop, its first and last stamp (ns).
    after : (m, 3) array
        Reference (m, m/s, m/s^2) of the samples that follow the last complete one.
    events : list of ParameterEvent
        Changes of parameters, by stamp.
    metadata : dict of str to dict
        Records of names and texts, by name.
    damage : str
        What could not be read, empty where all could.
    """

    samples: np.ndarray
    stamps: np.ndarray
    T_ns: int
    counts: dict[str, int]
    gaps: dict[str, int]
    repeats: dict[str, int]
    spans: dict[str, tuple[int, int]]
    after: np.ndarray
    events: list[ParameterEvent]
    metadata: dict[str, dict[str, str]]
    damage: str

    @property
    def first(self) -> int:
        """Stamp of the first complete sample (ns)."""
        return int(self.stamps[0])

    @property
    def last(self) -> int:
        """Stamp of the last complete sample (ns)."""
        return int(self.stamps[-1])


def load(path: Path) -> Recording:
    """Read a recording.

    Parameters
    ----------
    path : Path
        A bag's directory, or an MCAP file.

    Raises
    ------
    BagError
        It is no recording, a topic of the loop is missing, or there is no complete sample.
    """
    tape = _Tape()
    for file in _files(path):
        tape.read(file)
    return tape.recording(path)


def topics(recording: Recording) -> dict[str, dict[str, int]]:
    """What each topic holds: messages, and of the loop's stamps (ns) the first, the last, gaps."""
    told = {}
    for name, count in recording.counts.items():
        told[name] = {"messages": count}
        if name in recording.spans:
            first, last = recording.spans[name]
            told[name] |= {
                "first_ns": first,
                "last_ns": last,
                "gaps": recording.gaps[name],
                "repeats": recording.repeats[name],
            }
    return told


def _files(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise BagError(f"{path} does not exist")
    files = sorted(path.glob("*.mcap"))
    if not files:
        raise BagError(f"{path} is no recording: no .mcap file in it")
    return files


class _Tape:
    """What has been read so far, of one file or several."""

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.damages: list[str] = []
        self.parts: dict[str, list[tuple[np.ndarray, np.ndarray]]] = defaultdict(list)
        self.events: list[ParameterEvent] = []
        self.topics: dict[int, str] = {}
        self.types: dict[int, str] = {}
        self.taken = 0
        self.promised: int | None = None

    def read(self, file: Path) -> None:
        try:
            data = file.read_bytes()
        except OSError as error:
            raise BagError(f"{file} cannot be read: {error.strerror}") from None
        if data[: len(MAGIC)] != MAGIC:
            raise BagError(f"{file} is no MCAP file" if data else f"{file} is empty")
        self.topics, self.types = {}, {}
        self.taken, self.promised = 0, None
        ended = data.endswith(MAGIC)
        whole = self._scan(file, data, len(MAGIC), len(data) - ended * len(MAGIC))
        if not (ended and whole):
            self.damages.append(f"{file.name} is cut off")
        elif self.promised not in (None, self.taken):
            self.damages.append(f"{file.name}: {self.taken} messages of {self.promised}")

    def _scan(self, file: Path, data: bytes, at: int, size: int) -> bool:
        """Read the records of a file or a chunk; False where one runs over the end."""
        places: dict[int, list[tuple[int, int]]] = defaultdict(list)
        while at < size:
            start = at + _RECORD.size
            if start > size:
                break
            opcode, length = _RECORD.unpack_from(data, at)
            end = start + length
            if end > size:
                break
            if opcode == MESSAGE:
                if length >= FIXED:
                    channel = _CHANNEL.unpack_from(data, start)[0]
                    places[channel].append((start + FIXED, end))
                else:
                    self.damages.append(f"{file.name}: a message of {length} bytes")
            elif opcode in _READERS:
                self._record(file, opcode, data[start:end])
            at = end
        for channel, spans in places.items():
            self._messages(file, data, channel, np.array(spans))
        return at == size

    def _record(self, file: Path, opcode: int, body: bytes) -> None:
        try:
            record = _READERS[opcode](ReadDataStream(BytesIO(body)))
            if isinstance(record, Chunk):
                stream, size = get_chunk_data_stream(record, validate_crc=True)
                inner = stream.read(size)
        except UnsupportedCompressionError as error:
            raise BagError(f"{file} cannot be read: {error}") from None
        except _DAMAGES as error:
            name = Opcode(opcode).name.lower()
            self.damages.append(f"{file.name}: a damaged {name}: {error or type(error).__name__}")
            return
        if isinstance(record, Chunk):
            if not self._scan(file, inner, 0, len(inner)):
                self.damages.append(f"{file.name}: a chunk's last record is cut off")
        elif isinstance(record, Schema):
            self.types[record.id] = record.name
        elif isinstance(record, Channel):
            self._declare(file, record)
        elif isinstance(record, Statistics):
            self.promised = record.message_count
        else:
            self.metadata[record.name] = record.metadata

    def _declare(self, file: Path, channel: Channel) -> None:
        self.topics[channel.id] = channel.topic
        self.counts.setdefault(channel.topic, 0)
        for topic in LOOP:
            if topic.name == channel.topic:
                kind = self.types.get(channel.schema_id, "of no type")
                if kind != topic.type or channel.message_encoding != "cdr":
                    raise BagError(
                        f"{file}: {topic.name} is {kind} in {channel.message_encoding},"
                        f" must be {topic.type} in cdr"
                    )

    def _messages(self, file: Path, data: bytes, channel: int, spans: np.ndarray) -> None:
        self.taken += len(spans)
        topic = self.topics.get(channel)
        if topic is None:
            self.damages.append(f"{file.name}: {len(spans)} messages of an unknown topic")
            return
        self.counts[topic] += len(spans)
        try:
            if topic == REFERENCE.name:
                self.parts[topic] += _trajectories(data, spans)
            elif topic in _CODECS:
                self.parts[topic] += _joint_states(data, spans, _CODECS[topic])
            elif topic == PARAMETER_EVENTS.name:
                self.events += [events.decode(data[start:end]) for start, end in spans]
        except ConversionError as error:
            raise BagError(f"{file}: {topic}: {error}") from None

    def recording(self, path: Path) -> Recording:
        """Assemble the samples.

        Raises
        ------
        BagError
            There is none.
        """
        missing = [topic.name for topic in LOOP if not self.parts.get(topic.name)]
        if missing:
            raise BagError(f"{path} holds no message of {', '.join(missing)}{self._damage(': ')}")
        tracks = {}
        gaps, repeats = {}, {}
        for topic in LOOP:
            stamps, values = (np.concatenate(column) for column in zip(*self.parts[topic.name]))
            unique, index = np.unique(stamps, return_index=True)
            repeats[topic.name] = len(stamps) - len(unique)
            tracks[topic] = unique, values[index]
        T_ns = _period([stamps for stamps, _ in tracks.values()])
        for topic, (stamps, _) in tracks.items():
            gaps[topic.name] = _missing(stamps, T_ns)
        stamps, samples = _assemble(tracks)
        if not len(samples):
            raise BagError(f"{path} holds no sample that {', '.join(t.name for t in LOOP)} share")
        spans = {topic.name: (int(t[0]), int(t[-1])) for topic, (t, _) in tracks.items()}
        known, points = tracks[REFERENCE]
        return Recording(
            samples,
            stamps,
            T_ns,
            self.counts,
            gaps,
            repeats,
            spans,
            _following(known, points, int(stamps[-1]), T_ns),
            sorted(self.events, key=lambda event: event.stamp),
            self.metadata,
            self._damage(),
        )

    def _damage(self, before: str = "") -> str:
        if not self.damages:
            return ""
        more = f" (and {len(self.damages) - 1} more)" if len(self.damages) > 1 else ""
        return f"{before}{self.damages[0]}{more}"


def _joint_states(
    data: bytes, spans: np.ndarray, codecs: tuple[JointStateCodec, ...]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Stamps (ns) and position, velocity, effort of the messages at `spans`, in their order."""
    stamps = np.empty(len(spans), np.int64)
    values = np.full((len(spans), len(_FIELDS)), np.nan)
    sizes = spans[:, 1] - spans[:, 0]
    rest = np.ones(len(spans), bool)
    for codec in codecs:
        at = np.flatnonzero(rest & (sizes == codec.size))
        if not len(at):
            continue
        # every byte of the data starts a row that overlaps the next: pick those of the messages
        rows = np.ndarray((len(data) - codec.size + 1,), codec.dtype, buffer=data, strides=(1,))[
            spans[at, 0]
        ]
        plain = codec.encode_many(np.zeros(1, np.int64), *([np.zeros(1)] * sum(codec.carries)))[0]
        alike = np.ones(len(rows), bool)
        for field in codec.dtype.fields or {}:
            if field not in _FREE:
                alike &= rows[field] == plain[field]
        rows, at = rows[alike], at[alike]
        stamps[at] = rows["sec"].astype(np.int64) * 1_000_000_000 + rows["nanosec"]
        for column, (field, carried) in enumerate(zip(_FIELDS, codec.carries)):
            if carried:
                values[at, column] = rows[field]
        rest[at] = False
    for i in np.flatnonzero(rest):
        message = codecs[0].decode(data[spans[i, 0] : spans[i, 1]])
        stamps[i] = message.stamp
        values[i] = message[1:]
    yield stamps, values


def _trajectories(data: bytes, spans: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Stamps (ns) and w, w_dot, w_ddot of the points of each message at `spans`."""
    for start, end in spans:
        stamp, times, points = convert.REFERENCE.decode(data[start:end])
        yield stamp + times, points


def _period(tracks: list[np.ndarray]) -> int:
    """The commonest distance of stamps (ns), the smallest where several are."""
    steps, counts = np.unique(np.concatenate([np.diff(t) for t in tracks]), return_counts=True)
    return int(steps[np.argmax(counts)]) if len(steps) else 0


def _missing(stamps: np.ndarray, T_ns: int) -> int:
    return int((np.diff(stamps) // T_ns - 1).clip(0).sum()) if T_ns else 0


def _following(known: np.ndarray, points: np.ndarray, last: int, T_ns: int) -> np.ndarray:
    """Points without a gap after the stamp `last`."""
    first = int(np.searchsorted(known, last, side="right"))
    expected = last + T_ns * np.arange(1, len(known) - first + 1)
    right = known[first:] == expected
    count = len(right) if right.all() else int(np.argmin(right))
    following: np.ndarray = points[first : first + count]
    return following


def _assemble(tracks: dict[Topic, tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and samples that every topic of the loop knows."""
    common = tracks[DISPLACEMENT][0]
    for stamps, _ in tracks.values():
        common = np.intersect1d(common, stamps, assume_unique=True)

    def columns(topic: Topic) -> np.ndarray:
        stamps, values = tracks[topic]
        return values[np.searchsorted(stamps, common)].T

    samples = np.empty(len(common), SAMPLE)
    samples["w"], samples["w_dot"], samples["w_ddot"] = columns(REFERENCE)
    samples["y"], samples["y_dot"], samples["u_applied"] = columns(DISPLACEMENT)
    samples["x1_hat"], samples["x2_hat"], samples["eps_hat"] = columns(STATE)
    samples["u"] = columns(VOLTAGE)[2]
    return common, samples
