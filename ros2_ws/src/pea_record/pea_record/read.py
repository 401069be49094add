"""Reads a recording back: the samples of the loop, assembled by stamp.

The stamp is the one in the message, so bags of other recorders, which log the time of arrival,
are read alike. Messages of the layout that pea publishes are read a chunk at a time, others one
by one. Every checksum of the file is looked at.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import struct
import zlib
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError, UnsupportedCompressionError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Metadata, Schema, Statistics

from pea_core.axes import POINT, shape
from pea_core.config import AXIS
from pea_core.printable import printable
from pea_core.signals import SAMPLE, columns_of
from pea_core.units import SECOND
from pea_record.bounds import RECORD_MAX, Budget, TooMuchError, unpacked
from pea_record.large import Growing, empty, pieces, same
from pea_record.mcap import FIXED, MAGIC, MESSAGE
from pea_wire import convert, events
from pea_wire.convert import ConversionError, JointStateCodec
from pea_wire.events import ParameterEvent
from pea_wire.topics import (
    DISPLACEMENT,
    LOOP,
    PARAMETER_EVENTS,
    REFERENCE,
    SAMPLED,
    SIGNAL,
    Topic,
)

_FIELDS = ("position", "velocity", "effort")
_SAMPLED = {topic.name: topic for topic in SAMPLED}
_FREE = {"sec", "nanosec", *_FIELDS, *(f"pad_{field}" for field in _FIELDS)}
"""Fields of a row that may hold anything; the others are the same in every message."""

_RECORD = struct.Struct("<BQ")
_CHANNEL = struct.Struct("<H")
_CRC = 4
"""Bytes of a checksum."""

_TIMES = struct.Struct("<QQ")
_INDEX_HEAD = 6
"""Bytes of a message index before its pairs of time and offset."""

_CHUNK, _MESSAGE_INDEX = int(Opcode.CHUNK), int(Opcode.MESSAGE_INDEX)
_CHUNK_INDEX = int(Opcode.CHUNK_INDEX)
_DATA_END, _FOOTER = int(Opcode.DATA_END), int(Opcode.FOOTER)

BLOCK = 1 << 20
"""Bytes of a file that are read at a time."""

_READERS = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
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
    axes : tuple of str
        Names of the axes.
    samples : (n,) array of `SAMPLE`, or (n, axes)
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
    after : (m, axes x 3) array
        Reference (m, m/s, m/s^2) of the samples that follow the last complete one.
    events : list of ParameterEvent
        Changes of parameters, by stamp.
    metadata : dict of str to dict
        Records of names and texts, by name.
    damage : str
        What could not be read, empty where all could.
    signal : (n,) array or None
        The sample signal at each sample, NaN where none is recorded; None of a recording without.
    """

    axes: tuple[str, ...]
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
    signal: np.ndarray | None = None

    @property
    def first(self) -> int:
        """Stamp of the first complete sample (ns)."""
        return int(self.stamps[0])

    @property
    def last(self) -> int:
        """Stamp of the last complete sample (ns)."""
        return int(self.stamps[-1])

    def of(self, axis: str) -> Recording:
        """One axis of it."""
        if len(self.axes) == 1:
            return self
        i = self.axes.index(axis)
        samples = np.ascontiguousarray(self.samples[:, i])
        after = self.after[:, POINT * i : POINT * (i + 1)]
        events = [event.of(axis, self.axes) for event in self.events]
        events = [event for event in events if event.new or event.changed]
        return dataclasses.replace(self, axes=(axis,), samples=samples, after=after, events=events)


def load(path: Path) -> Recording:
    """Read a recording of one axis, or one axis of several: ``PATH@AXIS``.

    Raises
    ------
    BagError
        As `load_axes`; it has several axes.
    """
    found = load_axes(path)
    if len(found.axes) > 1:
        raise BagError(
            f"{path} has the axes {', '.join(found.axes)}, and this takes one: write "
            f"{path}@{found.axes[0]}"
        )
    return found


def path_and_axis(path: Path) -> tuple[Path, str]:
    """Path of a recording, and the axis that ``PATH@AXIS`` names; empty where it names none."""
    before, at, axis = path.name.rpartition("@")
    if not at or not before or path.exists():
        return path, ""
    return path.with_name(before), axis


def load_axes(path: Path) -> Recording:
    """Read a recording of any number of axes, or one axis of it: ``PATH@AXIS``.

    Parameters
    ----------
    path : Path
        A bag's directory, or an MCAP file.

    Raises
    ------
    BagError
        It is no recording, a topic of the loop is missing, there is no complete sample, or no such
        axis.
    """
    there, axis = path_and_axis(path)
    tape = Tape()
    for file in files_of(there):
        tape.read(file)
    found = tape.recording(there)
    if axis and axis not in found.axes:
        raise BagError(f"{path}: no axis {axis!r}: the axes are {', '.join(found.axes)}")
    return found.of(axis) if axis else found


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


def files_of(path: Path) -> list[Path]:
    """MCAP files of a recording, in order.

    Raises
    ------
    BagError
        There is none.
    """
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise BagError(f"{path} does not exist")
    files = sorted(path.glob("*.mcap"), key=_number)
    if not files:
        raise BagError(f"{path} is no recording: no .mcap file in it")
    return files


def _number(file: Path) -> tuple[str, int]:
    """Name and number of a file of a split recording: 10 comes after 9."""
    name, _, number = file.stem.rpartition("_")
    return (name, int(number)) if number.isdecimal() else (file.stem, -1)


@contextlib.contextmanager
def _opened(file: Path) -> Iterator[tuple[BinaryIO, int]]:
    """An MCAP file and its size.

    Raises
    ------
    BagError
        It is none, or cannot be read.
    """
    try:
        with open(file, "rb", buffering=BLOCK) as stream:
            start = stream.read(len(MAGIC))
            if start != MAGIC:
                raise BagError(f"{file} is no MCAP file" if start else f"{file} is empty")
            yield stream, os.fstat(stream.fileno()).st_size
    except OSError as error:
        raise BagError(f"{file} cannot be read: {error.strerror}") from None


class Place(NamedTuple):
    """Where a chunk is.

    Attributes
    ----------
    file : Path
    at : int
        Byte at which it begins.
    first, last : int
        Log times (ns) of its messages.
    """

    file: Path
    at: int
    first: int
    last: int


class _Record(NamedTuple):
    """One record of a file: where it begins and ends, and its bytes."""

    at: int
    end: int
    opcode: int
    head: bytes
    body: bytes


def _records(stream: BinaryIO, at: int, size: int, brief: bool = False) -> Iterator[_Record]:
    """Records from the byte `at` on, up to one that runs over the end.

    `brief` leaves out what messages and their indexes hold, and all but the times of chunks.
    """
    stream.seek(at)
    while size - at >= _RECORD.size:
        head = stream.read(_RECORD.size)
        if len(head) < _RECORD.size:
            return
        opcode, length = _RECORD.unpack(head)
        end = at + _RECORD.size + length
        if end > size or length > RECORD_MAX or opcode == 0:  # a hole reads as zeros
            return
        wanted = length
        if brief and opcode in (MESSAGE, _MESSAGE_INDEX):
            wanted = 0
        elif brief and opcode == _CHUNK:
            wanted = min(_TIMES.size, length)
        body = stream.read(wanted)
        if len(body) < wanted:
            return
        yield _Record(at, end, opcode, head, body)
        if wanted < length:
            stream.seek(end)
        at = end


class _Checksums:
    """The checksums of a file's data and of its summary, as its records go by."""

    def __init__(self) -> None:
        self.data = zlib.crc32(MAGIC)
        self.summary = 0
        self.ended = self.closed = False
        self.wrong = False

    def add(self, record: _Record) -> None:
        if record.opcode == _DATA_END and not self.ended:
            self.ended = True
            self._compare(self.data, record.body)
        elif not self.ended:
            self.data = zlib.crc32(record.body, zlib.crc32(record.head, self.data))
        elif record.opcode == _FOOTER:
            self.closed = True
            fields = record.body[:-_CRC]
            self.summary = zlib.crc32(fields, zlib.crc32(record.head, self.summary))
            self._compare(self.summary, record.body)
        else:
            self.summary = zlib.crc32(record.body, zlib.crc32(record.head, self.summary))

    def _compare(self, found: int, body: bytes) -> None:
        """Compare with the checksum at the end of `body`; 0 means that there is none."""
        written = int.from_bytes(body[-_CRC:], "little")
        self.wrong |= len(body) < _CRC or written not in (0, found)


class Track:
    """Stamps (ns) of a topic of the loop as they came, and of each axis three numbers a message.

    They are position, velocity, effort, or w, w_dot, w_ddot.
    """

    def __init__(self, axes: int) -> None:
        self.stamps, self.values = Growing(np.int64), Growing(float, len(_FIELDS) * axes)

    def add(self, parts: Iterator[tuple[np.ndarray, np.ndarray]]) -> None:
        """Append parts of stamps and values."""
        for stamps, values in parts:
            self.stamps.add(stamps)
            self.values.add(values)


class Tape:
    """What has been read so far, of one file or several."""

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.damages: list[str] = []
        self.axes: tuple[str, ...] = ()
        self.early: list[tuple[Path, bytes]] = []  # of the reference, before the axes are known
        self.parts: dict[str, Track] = {}
        self.events: list[ParameterEvent] = []
        self.signals: list[tuple[np.ndarray, np.ndarray]] = []
        self.topics: dict[int, str] = {}
        self.types: dict[int, str] = {}
        self.taken = 0
        self.promised: int | None = None
        self.indexed = True
        self.budget = Budget(0)

    def read(self, file: Path) -> None:
        """Read a file.

        Raises
        ------
        BagError
            It is none of a recording.
        """
        with _opened(file) as (stream, size):
            self.budget = Budget(size)
            self._read(file, stream, size)

    def _read(self, file: Path, stream: BinaryIO, size: int) -> None:
        self.topics, self.types = {}, {}
        self.taken, self.promised = 0, None
        told = len(self.damages)
        checksums = _Checksums()
        chunk, indexes, loose = b"", list[bytes](), bytearray()
        end = len(MAGIC)
        for record in _records(stream, end, size):
            end = record.end
            checksums.add(record)
            if record.opcode == _MESSAGE_INDEX:
                indexes.append(record.body)
                continue
            if chunk:
                self._chunk(file, chunk, indexes)
            chunk, indexes = b"", []
            if record.opcode == MESSAGE and len(loose) < BLOCK:
                loose += record.head + record.body
                continue
            if loose:
                self._scan(file, bytes(loose))
                loose = bytearray()
            if record.opcode == MESSAGE:
                loose += record.head + record.body
            elif record.opcode == _CHUNK:
                chunk = record.body
            elif record.opcode in _READERS:
                self._record(file, record.opcode, record.body)
        if chunk:
            self._chunk(file, chunk, indexes)
        if loose:
            self._scan(file, bytes(loose))
        stream.seek(end)
        if stream.read(len(MAGIC) + 1) != MAGIC:
            self.damages.append(f"{file.name} is cut off")
        elif self.promised not in (None, self.taken):
            self.damages.append(f"{file.name}: {self.taken} messages of {self.promised}")
        elif len(self.damages) == told and (checksums.wrong or not checksums.closed):
            self.damages.append(f"{file.name}: a byte beside the messages has changed (checksum)")

    def survey(self, file: Path) -> list[Place]:
        """Read what a file holds beside its chunks; say where they are.

        Raises
        ------
        BagError
            It is none of a recording.
        """
        self.topics, self.types = {}, {}
        places, indexed = [], []
        end = len(MAGIC)
        with _opened(file) as (stream, size):
            self.budget = Budget(size)
            for record in _records(stream, len(MAGIC), size, brief=True):
                end = record.end
                if record.opcode == _CHUNK and len(record.body) == _TIMES.size:
                    places.append(Place(file, record.at, *_TIMES.unpack(record.body)))
                elif record.opcode == _CHUNK_INDEX:
                    with contextlib.suppress(*_DAMAGES):
                        chunk = ChunkIndex.read(ReadDataStream(BytesIO(record.body)))
                        times = chunk.message_start_time, chunk.message_end_time
                        indexed.append(Place(file, chunk.chunk_start_offset, *times))
                elif record.opcode in _READERS:
                    self._record(file, record.opcode, record.body)
            stream.seek(end)
            self.indexed &= places == indexed and stream.read(len(MAGIC) + 1) == MAGIC
        return places

    def read_chunks(self, file: Path, places: Sequence[Place], topics: dict[int, str]) -> None:
        """Read chunks of a file that was surveyed, with its `topics` by channel."""
        self.topics = topics
        with _opened(file) as (stream, size):
            self.budget = Budget(size)
            for place in places:
                chunk, indexes = b"", list[bytes]()
                for record in _records(stream, place.at, size):
                    if record.at == place.at:
                        chunk = record.body
                    elif record.opcode == _MESSAGE_INDEX:
                        indexes.append(record.body)
                    else:
                        break
                self._chunk(file, chunk, indexes)

    def _chunk(self, file: Path, body: bytes, indexes: Sequence[bytes]) -> None:
        try:
            chunk = Chunk.read(ReadDataStream(BytesIO(body)))
            data = unpacked(chunk, self.budget)
            crc = chunk.uncompressed_crc
            if crc and crc != zlib.crc32(data):
                raise McapError(f"crc validation failed in chunk: {crc} is {zlib.crc32(data)}")
        except TooMuchError as error:
            raise BagError(f"{file} cannot be read: {error}") from None
        except UnsupportedCompressionError as error:
            raise BagError(f"{file} cannot be read: {error}") from None
        except _DAMAGES as error:
            self._damaged(file, "chunk", error)
            return
        spans = _indexed(data, indexes)
        if spans is None:
            if not self._scan(file, data):
                self.damages.append(f"{file.name}: a chunk's last record is cut off")
            return
        self._name_axes(data, spans)
        for channel, of_channel in spans.items():
            self._messages(file, data, channel, of_channel)

    def _scan(self, file: Path, data: bytes) -> bool:
        """Read records one by one; False where one runs over the end."""
        places: dict[int, list[tuple[int, int]]] = defaultdict(list)
        at, size = 0, len(data)
        while at < size:
            start = at + _RECORD.size
            if start > size:
                break
            opcode, length = _RECORD.unpack_from(data, at)
            end = start + length
            if end > size or opcode == 0:
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
        spans = {channel: np.array(of_channel) for channel, of_channel in places.items()}
        self._name_axes(data, spans)
        for channel, of_channel in spans.items():
            self._messages(file, data, channel, of_channel)
        return at == size

    def _damaged(self, file: Path, what: str, error: Exception) -> None:
        why = error or type(error).__name__
        self.damages.append(f"{file.name}: a damaged {what}: {why}")

    def _record(self, file: Path, opcode: int, body: bytes) -> None:
        try:
            self.budget.define()
            record = _READERS[opcode](ReadDataStream(BytesIO(body)))
        except TooMuchError as error:
            raise BagError(f"{file} cannot be read: {error}") from None
        except _DAMAGES as error:
            self._damaged(file, Opcode(opcode).name.lower(), error)
            return
        if isinstance(record, Schema):
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
                    told = printable(f"{kind} in {channel.message_encoding}", 200)
                    raise BagError(f"{file}: {topic.name} is {told}, must be {topic.type} in cdr")

    def _name_axes(self, data: bytes, spans: Mapping[int, np.ndarray]) -> None:
        """Take the axes that the loop's topics share where they come first."""
        found = {}
        for channel, of_channel in spans.items() if not self.axes else ():
            topic = self.topics.get(channel, "")
            if topic in (*_SAMPLED, REFERENCE.name):
                start, end = of_channel[0]
                with contextlib.suppress(ConversionError):
                    found[topic] = convert.axes_of(data[start:end], topic == REFERENCE.name)
        if found.keys() & _SAMPLED.keys():
            for _, data in self.early[:1]:
                with contextlib.suppress(ConversionError):
                    found[REFERENCE.name] = convert.axes_of(data, trajectory=True)
            names = found.get(DISPLACEMENT.name) or next(iter(found.values()))
            shared = tuple(n for n in names if all(n in other for other in found.values()))
            self.axes = shared if 0 < len(set(shared)) == len(shared) else (AXIS,)
            self._take_early()

    def _take_early(self) -> None:
        """Read what of the reference came before the axes were known."""
        early, self.early = self.early, []
        for file, data in early:
            self._decode(file, REFERENCE.name, data, np.array([[0, len(data)]]))

    def track(self, topic: str) -> Track:
        """What there is of a topic of the loop so far."""
        if topic not in self.parts:
            self.parts[topic] = Track(max(len(self.axes), 1))
        return self.parts[topic]

    def _messages(self, file: Path, data: bytes, channel: int, spans: np.ndarray) -> None:
        self.taken += len(spans)
        topic = self.topics.get(channel)
        if topic is None:
            self.damages.append(f"{file.name}: {len(spans)} messages of an unknown topic")
            return
        self.counts[topic] = self.counts.get(topic, 0) + len(spans)
        if topic == REFERENCE.name and not self.axes:
            self.early += [(file, data[start:end]) for start, end in spans]
        else:
            self._decode(file, topic, data, spans)

    def _decode(self, file: Path, topic: str, data: bytes, spans: np.ndarray) -> None:
        try:
            forms = convert.forms(self.axes or (AXIS,))
            if topic == REFERENCE.name:
                self.track(topic).add(_trajectories(data, spans, forms))
            elif topic in _SAMPLED:
                if topic == DISPLACEMENT.name:  # between two samples a plant may show its stage
                    spans = _samples(data, spans)
                codecs = forms.codecs[_SAMPLED[topic]]
                self.track(topic).add(_joint_states(data, spans, tuple(dict.fromkeys(codecs))))
            elif topic == SIGNAL.name:
                self.signals += _joint_states(data, spans, (convert.DETECTED,))
            elif topic == PARAMETER_EVENTS.name:
                self.events += [events.decode(data[start:end]) for start, end in spans]
        except ConversionError as error:
            raise BagError(f"{file}: {topic}: {error}") from None

    def stamps(self, topic: Topic) -> np.ndarray:
        """Stamps (ns) of a topic, as they came."""
        return self.track(topic.name).stamps.whole()

    def samples(self) -> tuple[np.ndarray, np.ndarray]:
        """Stamps (ns) and complete samples, be there none."""
        if self._missing():
            return np.empty(0, np.int64), np.empty(shape(0, max(len(self.axes), 1)), SAMPLE)
        return _assemble(self._tracks()[0], len(self.axes))

    def _missing(self) -> list[str]:
        """Topics of the loop without a message."""
        if not self.axes:
            self.axes = (AXIS,)
            self._take_early()
        return [topic.name for topic in LOOP if not len(self.track(topic.name).stamps)]

    def _tracks(self) -> tuple[dict[Topic, tuple[np.ndarray, np.ndarray]], dict[str, int]]:
        """Stamps and values of each topic in order, each once; how many came again."""
        tracks, repeats = {}, {}
        for topic in LOOP:
            track = self.track(topic.name)
            stamps, values = track.stamps.whole(), track.values.whole()
            repeats[topic.name] = 0
            if not _rising(stamps):
                unique, index = np.unique(stamps, return_index=True)
                repeats[topic.name] = len(stamps) - len(unique)
                stamps, values = unique, values[index]
            tracks[topic] = stamps, values
        return tracks, repeats

    def recording(self, path: Path) -> Recording:
        """Assemble the samples.

        Raises
        ------
        BagError
            There is none.
        """
        if missing := self._missing():
            raise BagError(f"{path} holds no message of {', '.join(missing)}{self._damage(': ')}")
        tracks, repeats = self._tracks()
        T_ns = _period([stamps for stamps, _ in tracks.values()])
        gaps = {topic.name: _missing(stamps, T_ns) for topic, (stamps, _) in tracks.items()}
        stamps, samples = _assemble(tracks, len(self.axes))
        if not len(samples):
            raise BagError(f"{path} holds no sample that {', '.join(t.name for t in LOOP)} share")
        spans = {topic.name: (int(t[0]), int(t[-1])) for topic, (t, _) in tracks.items()}
        known, points = tracks[REFERENCE]
        return Recording(
            self.axes,
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
            self.signal(stamps) if self.signals else None,
        )

    def signal(self, stamps: np.ndarray) -> np.ndarray:
        """The sample signal at each of some rising stamps, NaN where none is recorded."""
        found = np.full(len(stamps), np.nan)
        for at, values in self.signals if len(stamps) else ():
            place = np.minimum(np.searchsorted(stamps, at), len(stamps) - 1)
            known = stamps[place] == at
            found[place[known]] = values[known, 0]
        return found

    def _damage(self, before: str = "") -> str:
        if not self.damages:
            return ""
        more = f" (and {len(self.damages) - 1} more)" if len(self.damages) > 1 else ""
        return f"{before}{self.damages[0]}{more}"


def _indexed(data: bytes, indexes: Sequence[bytes]) -> dict[int, np.ndarray] | None:
    """Begin and end of the messages of each channel, as a chunk's indexes tell.

    None where they do not tell of every byte of the chunk: then it is read record by record.
    """
    places = {}
    for body in indexes:
        if len(body) < _INDEX_HEAD or (len(body) - _INDEX_HEAD) % _TIMES.size:
            return None
        pairs = np.frombuffer(body, "<u8", offset=_INDEX_HEAD)
        if len(pairs):
            places[_CHANNEL.unpack_from(body)[0]] = np.sort(pairs[1::2])
    if not places or max(at[-1] for at in places.values()) > len(data) - _RECORD.size - FIXED:
        return None
    begins = np.sort(np.concatenate(list(places.values()))).astype(np.int64)
    ends = begins + _RECORD.size + _at(data, begins + 1, "<u8").astype(np.int64)
    tiled = begins[0] == 0 and ends[-1] == len(data) and (ends[:-1] == begins[1:]).all()
    if not tiled or (_at(data, begins, "u1") != MESSAGE).any():
        return None
    spans = {}
    for channel, at in places.items():
        of_channel = at.astype(np.int64)
        start = of_channel + _RECORD.size
        if (_at(data, start, "<u2") != channel).any():
            return None
        ended = ends[np.searchsorted(begins, of_channel)]
        if (ended - start < FIXED).any():
            return None
        spans[channel] = np.stack([start + FIXED, ended], axis=1)
    return spans


def _at(data: bytes, places: np.ndarray, kind: str) -> np.ndarray:
    """Numbers that begin at any bytes of `data`."""
    size = np.dtype(kind).itemsize
    every = np.ndarray((len(data) - size + 1,), kind, buffer=data, strides=(1,))
    return np.asarray(every[places])


@cache
def _template(codec: JointStateCodec) -> tuple[np.ndarray, np.ndarray]:
    """Words of 4 bytes that are the same in every message: their numbers, and what they are."""
    nothing = np.zeros(1) if len(codec.axes) == 1 else np.zeros((1, len(codec.axes)))
    plain = codec.encode_many(np.zeros(1, np.int64), *([nothing] * sum(codec.carries)))
    free = np.zeros(1, codec.dtype).view("<u4")
    marks = free.view(codec.dtype)
    for field, (kind, *_) in (codec.dtype.fields or {}).items():
        if field in _FREE:
            marks[field] = np.frombuffer(b"\xff" * kind.itemsize, kind.base)
    fixed = np.flatnonzero(free == 0)
    return fixed, plain.view("<u4")[fixed]


def _samples(data: bytes, spans: np.ndarray) -> np.ndarray:
    """The spans of displacements that are samples of a loop, not marked as shown in between."""
    bytes_ = np.frombuffer(data, np.uint8)
    places = np.minimum(spans[:, 0] + 12, len(bytes_) - 1)
    named = np.flatnonzero(bytes_[places] > 1)
    shown = [i for i in named if convert.marked(data[spans[i, 0] : spans[i, 1]])]
    return np.delete(spans, shown, axis=0) if shown else spans


def _joint_states(
    data: bytes, spans: np.ndarray, codecs: tuple[JointStateCodec, ...]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Stamps (ns) and position, velocity, effort of the messages at `spans`, in their order."""
    axes = len(codecs[0].axes)
    stamps = np.empty(len(spans), np.int64)
    values = np.full((len(spans), axes, len(_FIELDS)), np.nan)
    sizes = spans[:, 1] - spans[:, 0]
    rest = np.ones(len(spans), bool)
    for codec in codecs:
        at = np.flatnonzero(rest & (sizes == codec.size))
        if not len(at):
            continue
        # every byte of the data starts a message that overlaps the next: pick those at `spans`
        start = (len(data) - codec.size + 1,)
        messages = np.ndarray(start, f"V{codec.size}", buffer=data, strides=(1,))[spans[at, 0]]
        fixed, plain = _template(codec)
        alike = (messages.view("<u4").reshape(len(at), -1)[:, fixed] == plain).all(axis=1)
        if not alike.all():
            messages, at = messages[alike], at[alike]
        rows = messages.view(codec.dtype)
        stamps[at] = rows["sec"].astype(np.int64) * SECOND + rows["nanosec"]
        for column, (field, carried) in enumerate(zip(_FIELDS, codec.carries)):
            if carried:
                values[at, :, column] = rows[field].reshape(len(at), axes)
        rest[at] = False
    for i in np.flatnonzero(rest):
        message = codecs[0].decode(data[spans[i, 0] : spans[i, 1]])
        stamps[i] = message.stamp
        values[i] = np.transpose(message[1:])
    yield stamps, values.reshape(len(spans), -1)


def _trajectories(
    data: bytes, spans: np.ndarray, forms: convert.Forms
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Stamps (ns) and w, w_dot, w_ddot of the points of each message at `spans`."""
    for start, end in spans:
        stamp, times, points = forms.reference.decode(data[start:end])
        yield stamp + times, points


def _rising(stamps: np.ndarray) -> bool:
    """Whether each stamp is later than the one before."""
    return all((np.diff(stamps[part]) > 0).all() for part in pieces(len(stamps), stamps, before=1))


def _period(tracks: list[np.ndarray]) -> int:
    """The commonest distance of stamps (ns), the smallest where several are."""
    found: dict[int, int] = defaultdict(int)
    for track in tracks:
        for part in pieces(len(track), track, before=1):
            every = np.diff(track[part])
            if len(every) and every.min() == every.max():
                found[int(every[0])] += len(every)
            else:
                for step, count in zip(*np.unique(every, return_counts=True)):
                    found[int(step)] += int(count)
    return min(found, key=lambda step: (-found[step], step)) if found else 0


def _missing(stamps: np.ndarray, T_ns: int) -> int:
    if not T_ns:
        return 0
    parts = pieces(len(stamps), stamps, before=1)
    return sum(int((np.diff(stamps[part]) // T_ns - 1).clip(0).sum()) for part in parts)


def _following(known: np.ndarray, points: np.ndarray, last: int, T_ns: int) -> np.ndarray:
    """Points without a gap after the stamp `last`."""
    first = int(np.searchsorted(known, last, side="right"))
    expected = last + T_ns * np.arange(1, len(known) - first + 1)
    right = known[first:] == expected
    count = len(right) if right.all() else int(np.argmin(right))
    following: np.ndarray = points[first : first + count]
    return following


def _assemble(
    tracks: dict[Topic, tuple[np.ndarray, np.ndarray]], axes: int
) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and samples that every topic of the loop knows."""
    common = tracks[DISPLACEMENT][0]
    for stamps, _ in tracks.values():
        if not same(stamps[: len(common)], common):
            common = np.intersect1d(common, stamps, assume_unique=True)
    samples = empty(shape(len(common), axes), SAMPLE)
    for topic in LOOP:
        stamps, values = tracks[topic]
        alike = same(stamps[: len(common)], common)
        for part in pieces(len(common), common, stamps, values, samples):
            rows = values[part if alike else np.searchsorted(stamps, common[part])].T
            for column in columns_of(topic.relative):
                own = rows[convert.place(column) :: len(_FIELDS)]
                samples[column.name][part] = own[0] if axes == 1 else own.T
    return common, samples
