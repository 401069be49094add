"""Records of an MCAP file as bytes, one after the other, with its checksums."""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode

from pea_record.bounds import RECORD_MAX
from pea_record.mcap import MAGIC, MESSAGE
from pea_record.recording import BagError

RECORD_HEAD = struct.Struct("<BQ")
CHANNEL_ID = struct.Struct("<H")
_CRC = 4
"""Bytes of a checksum."""

CHUNK_TIMES = struct.Struct("<QQ")
INDEX_HEAD = 6
"""Bytes of a message index before its pairs of time and offset."""

CHUNK, MESSAGE_INDEX = int(Opcode.CHUNK), int(Opcode.MESSAGE_INDEX)
CHUNK_INDEX = int(Opcode.CHUNK_INDEX)
DATA_END, FOOTER = int(Opcode.DATA_END), int(Opcode.FOOTER)

BLOCK = 1 << 20
"""Bytes of a file that are read at a time."""


@contextlib.contextmanager
def open_mcap(file: Path) -> Iterator[tuple[BinaryIO, int]]:
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


class RawRecord(NamedTuple):
    """One record of a file: where it begins and ends, and its bytes."""

    at: int
    end: int
    opcode: int
    head: bytes
    body: bytes


def raw_records(stream: BinaryIO, at: int, size: int, brief: bool = False) -> Iterator[RawRecord]:
    """Records from the byte `at` on, up to one that runs over the end.

    `brief` leaves out what messages and their indexes hold, and all but the times of chunks.
    """
    stream.seek(at)
    while size - at >= RECORD_HEAD.size:
        head = stream.read(RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            return
        opcode, length = RECORD_HEAD.unpack(head)
        end = at + RECORD_HEAD.size + length
        if end > size or length > RECORD_MAX or opcode == 0:  # a hole reads as zeros
            return
        wanted = length
        if brief and opcode in (MESSAGE, MESSAGE_INDEX):
            wanted = 0
        elif brief and opcode == CHUNK:
            wanted = min(CHUNK_TIMES.size, length)
        body = stream.read(wanted)
        if len(body) < wanted:
            return
        yield RawRecord(at, end, opcode, head, body)
        if wanted < length:
            stream.seek(end)
        at = end


class Checksums:
    """The checksums of a file's data and of its summary, as its records go by."""

    def __init__(self) -> None:
        self.data = zlib.crc32(MAGIC)
        self.summary = 0
        self.ended = self.closed = False
        self.wrong = False

    def add(self, record: RawRecord) -> None:
        """Take the next record of the file."""
        if record.opcode == DATA_END and not self.ended:
            self.ended = True
            self._compare(self.data, record.body)
        elif not self.ended:
            self.data = zlib.crc32(record.body, zlib.crc32(record.head, self.data))
        elif record.opcode == FOOTER:
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
