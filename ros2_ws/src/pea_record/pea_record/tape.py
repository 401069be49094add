"""Reads the messages of a recording's files, and the samples they hold.

The stamp is the one in the message, so bags of other recorders, which log the time of arrival,
are read alike. Messages of the layout that pea publishes are read a chunk at a time, others one
by one. Every checksum of the file is looked at.
"""

from __future__ import annotations

import contextlib
import struct
import zlib
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError, UnsupportedCompressionError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Metadata, Schema, Statistics

from pea_core.axes import shape
from pea_core.config import AXIS
from pea_core.printable import printable
from pea_core.signals import SAMPLE
from pea_core.units import SECOND
from pea_record.assembly import FIELDS, assemble, commonest_period, following, missing_in, rising
from pea_record.bounds import Budget, TooMuchError, unpacked
from pea_record.large import Growing
from pea_record.mcap import FIXED, MAGIC, MESSAGE
from pea_record.raw_records import (
    BLOCK,
    CHANNEL_ID,
    CHUNK,
    CHUNK_INDEX,
    CHUNK_TIMES,
    INDEX_HEAD,
    MESSAGE_INDEX,
    RECORD_HEAD,
    Checksums,
    Place,
    open_mcap,
    raw_records,
)
from pea_record.recording import BagError, Recording
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

SAMPLED_BY_NAME = {topic.name: topic for topic in SAMPLED}
_FREE = {"sec", "nanosec", *FIELDS, *(f"pad_{field}" for field in FIELDS)}
"""Fields of a row that may hold anything; the others are the same in every message."""

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


class Track:
    """Stamps (ns) of a topic of the loop as they came, and of each axis three numbers a message.

    They are position, velocity, effort, or w, w_dot, w_ddot.
    """

    def __init__(self, axes: int) -> None:
        self.stamps, self.values = Growing(np.int64), Growing(float, len(FIELDS) * axes)

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
        self.filled: set[str] = set()  # topics that have a message, by the indexes of a survey
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
        with open_mcap(file) as (stream, size):
            self.budget = Budget(size)
            self._read(file, stream, size)

    def _read(self, file: Path, stream: BinaryIO, size: int) -> None:
        self.topics, self.types = {}, {}
        self.taken, self.promised = 0, None
        told = len(self.damages)
        checksums = Checksums()
        chunk, indexes, loose = b"", list[bytes](), bytearray()
        end = len(MAGIC)
        for record in raw_records(stream, end, size):
            end = record.end
            checksums.add(record)
            if record.opcode == MESSAGE_INDEX:
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
            elif record.opcode == CHUNK:
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
        places, indexed, filled = [], [], set[int]()
        end = len(MAGIC)
        with open_mcap(file) as (stream, size):
            self.budget = Budget(size)
            for record in raw_records(stream, len(MAGIC), size, brief=True):
                end = record.end
                if record.opcode == CHUNK and len(record.body) == CHUNK_TIMES.size:
                    places.append(Place(file, record.at, *CHUNK_TIMES.unpack(record.body)))
                elif record.opcode == CHUNK_INDEX:
                    with contextlib.suppress(*_DAMAGES):
                        chunk = ChunkIndex.read(ReadDataStream(BytesIO(record.body)))
                        times = chunk.message_start_time, chunk.message_end_time
                        indexed.append(Place(file, chunk.chunk_start_offset, *times))
                        filled.update(chunk.message_index_offsets)
                elif record.opcode in _READERS:
                    self._record(file, record.opcode, record.body)
            stream.seek(end)
            self.indexed &= places == indexed and stream.read(len(MAGIC) + 1) == MAGIC
        self.filled |= {topic for channel, topic in self.topics.items() if channel in filled}
        return places

    def read_chunks(self, file: Path, places: Sequence[Place], topics: dict[int, str]) -> None:
        """Read chunks of a file that was surveyed, with its `topics` by channel."""
        self.topics = topics
        with open_mcap(file) as (stream, size):
            self.budget = Budget(size)
            for place in places:
                chunk, indexes = b"", list[bytes]()
                for record in raw_records(stream, place.at, size):
                    if record.at == place.at:
                        chunk = record.body
                    elif record.opcode == MESSAGE_INDEX:
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
            start = at + RECORD_HEAD.size
            if start > size:
                break
            opcode, length = RECORD_HEAD.unpack_from(data, at)
            end = start + length
            if end > size or opcode == 0:
                break
            if opcode == MESSAGE:
                if length >= FIXED:
                    channel = CHANNEL_ID.unpack_from(data, start)[0]
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
            if topic in (*SAMPLED_BY_NAME, REFERENCE.name):
                start, end = of_channel[0]
                with contextlib.suppress(ConversionError):
                    found[topic] = convert.axes_of(data[start:end], topic == REFERENCE.name)
        if found.keys() & SAMPLED_BY_NAME.keys():
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
            elif topic in SAMPLED_BY_NAME:
                if topic == DISPLACEMENT.name:  # between two samples a plant may show its stage
                    spans = _samples(data, spans)
                codecs = forms.codecs[SAMPLED_BY_NAME[topic]]
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
        return assemble(self._tracks()[0], len(self.axes))

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
            if not rising(stamps):
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
        T_ns = commonest_period([stamps for stamps, _ in tracks.values()])
        gaps = {topic.name: missing_in(stamps, T_ns) for topic, (stamps, _) in tracks.items()}
        stamps, samples = assemble(tracks, len(self.axes))
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
            following(known, points, int(stamps[-1]), T_ns),
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
        if len(body) < INDEX_HEAD or (len(body) - INDEX_HEAD) % CHUNK_TIMES.size:
            return None
        pairs = np.frombuffer(body, "<u8", offset=INDEX_HEAD)
        if len(pairs):
            places[CHANNEL_ID.unpack_from(body)[0]] = np.sort(pairs[1::2])
    if not places or max(at[-1] for at in places.values()) > len(data) - RECORD_HEAD.size - FIXED:
        return None
    begins = np.sort(np.concatenate(list(places.values()))).astype(np.int64)
    ends = begins + RECORD_HEAD.size + _at(data, begins + 1, "<u8").astype(np.int64)
    tiled = begins[0] == 0 and ends[-1] == len(data) and (ends[:-1] == begins[1:]).all()
    if not tiled or (_at(data, begins, "u1") != MESSAGE).any():
        return None
    spans = {}
    for channel, at in places.items():
        of_channel = at.astype(np.int64)
        start = of_channel + RECORD_HEAD.size
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
    values = np.full((len(spans), axes, len(FIELDS)), np.nan)
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
        for column, (field, carried) in enumerate(zip(FIELDS, codec.carries)):
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
