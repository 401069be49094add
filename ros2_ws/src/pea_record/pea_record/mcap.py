"""MCAP files, written in compressed chunks with all indexes.

Messages come one at a time or as a whole block of rows; both cost a fraction of the reference
writer's time, since nothing is built per message but its bytes.
"""

from __future__ import annotations

import contextlib
import io
import os
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

MAGIC = b"\x89MCAP0\r\n"

CHUNK_SIZE = 768 * 1024
"""Bytes of records after which a chunk is closed."""

RESERVE, RESERVE_A_CHUNK = 64 * 1024, 256
"""Bytes that stay free behind a chunk: for what completes the file, and for its index there."""

_HEAD = struct.Struct("<BQHIQQ")
_INDEX = struct.Struct("<QQ")
_FOOTER_HEAD = struct.Struct("<BQQQ")
MESSAGE = int(Opcode.MESSAGE)
"""The opcode as a plain number: looking a member up costs as much as writing a message."""

FIXED = _HEAD.size - 9
"""Bytes of a message record's content before the data."""


def _rows_dtype(size: int) -> np.dtype:
    """Message records with `size` bytes of data each."""
    return np.dtype(
        [
            ("opcode", "u1"),
            ("length", "<u8"),
            ("channel", "<u2"),
            ("sequence", "<u4"),
            ("log_time", "<u8"),
            ("publish_time", "<u8"),
            ("data", f"V{size}"),
        ]
    )


class _Track:
    """What the writer keeps of one channel."""

    __slots__ = ("count", "id", "index", "written")

    def __init__(self, id: int) -> None:
        self.id = id
        self.count = 0  # messages taken
        self.written = 0  # messages of complete chunks
        self.index = bytearray()  # (time, offset) of the messages in the open chunk


class McapWriter:
    """Writes an MCAP file of the profile ``ros2``.

    A chunk that is closed is in the file: a writer that is killed loses at most what came since
    the last `flush`. A chunk is written only where there is room to complete the file after it.
    Where there is none, or a write fails, the file ends with its last complete chunk and the
    open one is dropped; `finish` then closes the file with what is complete.

    Parameters
    ----------
    stream : io.FileIO or io.BytesIO
        Empty and unbuffered: what it has taken counts as written.
    library : str
        Name of the writer, kept in the file.
    chunk_size : int
        Bytes of records after which a chunk is closed.
    level : int
        Compression level of zstd.
    """

    def __init__(
        self,
        stream: io.FileIO | io.BytesIO,
        library: str,
        chunk_size: int = CHUNK_SIZE,
        level: int = 1,
    ) -> None:
        self.failed: OSError | None = None
        self._full = chunk_size
        self._stream = stream
        self._compress = zstandard.ZstdCompressor(level=level).compress
        self._position = 0
        self._crc = 0
        self._buffer = bytearray()
        self._tracks: dict[int, _Track] = {}
        self._dtypes: dict[int, np.dtype] = {}
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunks = 0
        self._chunk_indexes = bytearray()  # encoded: as objects they take ten times the memory
        self._metadata_indexes: list[MetadataIndex] = []
        self._first = 0
        self._last = 0
        self._append(MAGIC + _bytes([Header(profile="ros2", library=library)]))

    @property
    def counts(self) -> dict[int, int]:
        """Messages in complete chunks, by channel."""
        return {track.id: track.written for track in self._tracks.values()}

    @property
    def size(self) -> int:
        """Bytes in the file, and of messages that will be compressed into it."""
        return self._position + len(self._buffer)

    @property
    def span(self) -> tuple[int, int]:
        """First and last log time (ns) in complete chunks; 0, 0 where there is no message."""
        return self._first, self._last

    def schema(self, name: str, text: str) -> int:
        """Add a message type with its ``ros2msg`` definition; returns its number."""
        schema = Schema(
            id=len(self._schemas) + 1, name=name, encoding="ros2msg", data=text.encode()
        )
        self._append(_bytes([schema]))
        self._schemas.append(schema)
        return schema.id

    def channel(self, topic: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Add a topic of CDR messages; returns the number that its messages are written under."""
        channel = Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding="cdr",
            metadata=dict(metadata),
            schema_id=schema,
        )
        self._append(_bytes([channel]))
        self._channels.append(channel)
        self._tracks[channel.id] = _Track(channel.id)
        return channel.id

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a record of names and texts."""
        record = _bytes([Metadata(name=name, metadata=dict(values))])
        index = MetadataIndex(offset=self._position, length=len(record), name=name)
        self._append(record)
        self._metadata_indexes.append(index)

    def message(self, channel: int, time: int, data: bytes) -> None:
        """Add one message.

        Parameters
        ----------
        channel : int
            Number of the channel.
        time : int
            Log and publish time (ns), 0 or later.
        data : bytes
            CDR.

        Raises
        ------
        ValueError
            The time is negative.
        OSError
            The chunk was full and could not be written.
        """
        track = self._tracks[channel]
        buffer = self._buffer
        sequence = track.count & 0xFFFFFFFF
        try:
            head = _HEAD.pack(MESSAGE, FIXED + len(data), channel, sequence, time, time)
        except struct.error:
            raise ValueError(f"log time = {time} ns: must be 0 or later") from None
        track.index += _INDEX.pack(time, len(buffer))
        track.count += 1
        buffer += head
        buffer += data
        if len(buffer) >= self._full:
            self.flush()

    def messages(self, channel: int, times: np.ndarray, rows: np.ndarray) -> None:
        """Add messages of equal size, one a row.

        Parameters
        ----------
        channel : int
            Number of the channel.
        times : (n,) array of int64
            Log and publish times (ns), 0 or later.
        rows : (n,) structured array
            The bytes of a row are the CDR of a message.

        Raises
        ------
        ValueError
            A time is negative, or there are not as many times as rows.
        OSError
            A chunk was full and could not be written.
        """
        times = np.asarray(times, np.int64)
        if times.shape != rows.shape or times.ndim != 1:
            raise ValueError(f"{times.size} times for {rows.size} rows: give one a row")
        if not times.size:
            return
        if times.min() < 0:
            raise ValueError(f"log time = {times.min()} ns: must be 0 or later")
        track = self._tracks[channel]
        records = self._records(track, times, rows)
        size = records.itemsize
        start = 0
        while start < len(records):
            room = max(1, -(-(self._full - len(self._buffer)) // size))
            part = records[start : start + room]
            index = np.empty((len(part), 2), "<u8")
            index[:, 0] = part["log_time"]
            index[:, 1] = len(self._buffer) + size * np.arange(len(part))
            track.index += index.tobytes()
            track.count += len(part)
            self._buffer += part.tobytes()
            start += len(part)
            if len(self._buffer) >= self._full:
                self.flush()

    def _records(self, track: _Track, times: np.ndarray, rows: np.ndarray) -> np.ndarray:
        size = rows.dtype.itemsize
        dtype = self._dtypes.get(size)
        if dtype is None:
            dtype = self._dtypes.setdefault(size, _rows_dtype(size))
        records = np.empty(len(rows), dtype)
        records["opcode"] = MESSAGE
        records["length"] = FIXED + size
        records["channel"] = track.id
        records["sequence"] = np.arange(track.count, track.count + len(rows))
        records["log_time"] = times
        records["publish_time"] = times
        records["data"] = np.ascontiguousarray(rows).view(f"V{size}")
        return records

    def flush(self) -> None:
        """Close the open chunk, if it holds a message: from here on it survives a kill.

        Raises
        ------
        OSError
            It could not be written, or an earlier one could not.
        """
        if self.failed is not None:
            self._clear()
            raise self.failed
        if not self._buffer:
            return
        tracks = [track for track in self._tracks.values() if track.index]
        times = np.concatenate([np.frombuffer(track.index, "<u8")[::2] for track in tracks])
        first, last = int(times.min()), int(times.max())
        raw = bytes(self._buffer)
        chunk = Chunk(
            compression="zstd",
            data=self._compress(raw),
            message_start_time=first,
            message_end_time=last,
            uncompressed_crc=zlib.crc32(raw),
            uncompressed_size=len(raw),
        )
        builder = RecordBuilder()
        chunk.write(builder)
        length = builder.count
        offsets = {}
        for track in tracks:
            offsets[track.id] = self._position + builder.count
            builder.start_record(Opcode.MESSAGE_INDEX)
            builder.write2(track.id)
            builder.write4(len(track.index))
            builder.write(track.index)
            builder.finish_record()
        index = ChunkIndex(
            chunk_length=length,
            chunk_start_offset=self._position,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            message_end_time=last,
            message_index_length=builder.count - length,
            message_index_offsets=offsets,
            message_start_time=first,
            uncompressed_size=len(raw),
        )
        data = builder.end()
        self._reserve(len(data))
        self._append(data)
        self._first = min(self._first, first) if self._chunks else first
        self._last = max(self._last, last)
        self._chunks += 1
        self._chunk_indexes += _bytes([index])
        for track in tracks:
            track.written += len(track.index) // _INDEX.size
        self._clear()

    def finish(self) -> None:
        """Close the open chunk and write the summary: the file is complete then.

        The stream stays open. After a failure the open chunk is gone, and the summary tells of
        the complete ones.

        Raises
        ------
        OSError
            There is no room for it; the file ends with its last complete chunk.
        """
        if self.failed is None:
            self.flush()
        builder = RecordBuilder()
        DataEnd(data_section_crc=self._crc).write(builder)
        data_end = builder.end()
        start = self._position + len(data_end)
        counts = self.counts
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=counts,
            chunk_count=self._chunks,
            message_count=sum(counts.values()),
            message_end_time=self._last,
            message_start_time=self._first,
            metadata_count=len(self._metadata_indexes),
            schema_count=len(self._schemas),
        )
        groups = [
            (Opcode.SCHEMA, _bytes(self._schemas)),
            (Opcode.CHANNEL, _bytes(self._channels)),
            (Opcode.STATISTICS, _bytes([statistics])),
            (Opcode.CHUNK_INDEX, bytes(self._chunk_indexes)),
            (Opcode.METADATA_INDEX, _bytes(self._metadata_indexes)),
        ]
        summary = b""
        offsets = []
        for opcode, group in groups:
            if group:
                offsets.append(
                    SummaryOffset(
                        group_opcode=opcode,
                        group_start=start + len(summary),
                        group_length=len(group),
                    )
                )
            summary += group
        offset_start = start + len(summary)
        summary += _bytes(offsets)
        head = _FOOTER_HEAD.pack(Opcode.FOOTER, 20, start, offset_start)
        footer = Footer(
            summary_start=start,
            summary_offset_start=offset_start,
            summary_crc=zlib.crc32(head, zlib.crc32(summary)),
        )
        self._append(data_end + summary + _bytes([footer]) + MAGIC)

    def _reserve(self, size: int) -> None:
        """See that there is room for a chunk of `size` bytes, and to complete the file after it."""
        if isinstance(self._stream, io.FileIO):
            room = size + RESERVE + RESERVE_A_CHUNK * self._chunks
            with self._or_as_it_was():
                os.posix_fallocate(self._stream.fileno(), self._position, room)
                self._stream.truncate(self._position)

    def _append(self, data: bytes) -> None:
        """Write `data` whole, or leave the file as it was."""
        rest = memoryview(data)
        with self._or_as_it_was():
            while rest:
                rest = rest[self._stream.write(rest) :]
        self._position += len(data)
        self._crc = zlib.crc32(data, self._crc)

    @contextlib.contextmanager
    def _or_as_it_was(self) -> Iterator[None]:
        """Leave the file as it was where something fails; all further messages are refused then."""
        try:
            yield
        except OSError as error:
            name = getattr(self._stream, "name", None)
            self.failed = OSError(error.errno, error.strerror, name)
            self._full = 0
            self._clear()
            with contextlib.suppress(OSError):
                self._stream.seek(self._position)
                self._stream.truncate()
            raise self.failed from None

    def _clear(self) -> None:
        """Begin a new chunk."""
        self._buffer = bytearray()
        for track in self._tracks.values():
            track.index = bytearray()


def _bytes(records: Iterable[McapRecord]) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())
