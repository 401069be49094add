"""What a recording may cost who reads it: a small file can promise, or unpack to, very much.

A recording of ours has chunks of a megabyte, and unpacks to some ten times its size.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from pathlib import Path

import zstandard
from mcap.exceptions import McapError, UnsupportedCompressionError
from mcap.opcode import Opcode
from mcap.records import Chunk

RECORD_MAX = 256 << 20
"""Bytes of one record of a file."""

CHUNK_MAX = 128 << 20
"""Bytes that a chunk unpacks to."""

UNPACKED_MIN, RATIO_MAX = 128 << 20, 500
"""A file's chunks unpack to so many bytes together, or to so many times its size."""

DEFINITIONS_MAX = 100_000
"""Schemas, channels and texts in a file."""

_RECORD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
"""Times, size, checksum, and length of the compression's name."""


class TooMuchError(McapError):
    """A recording that promises or unpacks to more than one can hold."""


class Budget:
    """How much a file may still unpack to, and define."""

    def __init__(self, size: int) -> None:
        self._bytes = max(UNPACKED_MIN, RATIO_MAX * size)
        self._definitions = DEFINITIONS_MAX

    def unpack(self, size: int) -> None:
        """Take so many bytes.

        Raises
        ------
        TooMuchError
            There are no more left.
        """
        if size > CHUNK_MAX:
            raise TooMuchError(f"a chunk of {size} bytes, more than {CHUNK_MAX}")
        self._bytes -= size
        if self._bytes < 0:
            raise TooMuchError("it unpacks to more than a recording of its size can")

    def define(self) -> None:
        """Take a schema, a channel or a text; errors as `unpack`."""
        self._definitions -= 1
        if self._definitions < 0:
            raise TooMuchError(f"more than {DEFINITIONS_MAX} schemas, channels and texts")


def unpacked(chunk: Chunk, budget: Budget) -> bytes:
    """What is in a chunk.

    Raises
    ------
    TooMuchError
        More than may be.
    UnsupportedCompressionError
        It is packed in another way than with zstd or lz4.
    Exception
        Of the packer, where it is damaged.
    """
    budget.unpack(chunk.uncompressed_size)
    unpack = _UNPACK.get(chunk.compression)
    if unpack is None:
        raise UnsupportedCompressionError(chunk.compression)
    data = unpack(chunk.data, chunk.uncompressed_size)
    if len(data) != chunk.uncompressed_size:
        raise TooMuchError(f"a chunk has {len(data)} bytes in place of {chunk.uncompressed_size}")
    return data


def _zstd(data: bytes, size: int) -> bytes:
    if zstandard.frame_content_size(data) not in (-1, size):
        raise TooMuchError("a chunk unpacks to another size than it says")
    found: bytes = zstandard.decompress(data, size)
    return found


def _lz4(data: bytes, size: int) -> bytes:
    from lz4.frame import LZ4FrameDecompressor

    found: bytes = LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    return found


_UNPACK: dict[str, Callable[[bytes, int], bytes]] = {
    "": lambda data, size: data,
    "zstd": _zstd,
    "lz4": _lz4,
}


def check(file: Path, magic: bytes) -> None:
    """See that a file promises no more than it may, before another reader believes it.

    Raises
    ------
    TooMuchError
        It does.
    """
    with open(file, "rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        budget = Budget(size)
        at = len(magic)
        if stream.read(at) != magic:
            return  # the other reader says what it thinks of it
        while at + _RECORD.size <= size:
            opcode, length = _RECORD.unpack(stream.read(_RECORD.size))
            if opcode == 0 or length > RECORD_MAX or at + _RECORD.size + length > size:
                return  # cut off there, or filled up
            if opcode == Opcode.CHUNK and length >= _CHUNK_HEAD.size:
                *_, unpacks, _, _ = _CHUNK_HEAD.unpack(stream.read(_CHUNK_HEAD.size))
                budget.unpack(unpacks)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT):
                budget.define()
            at += _RECORD.size + length
            stream.seek(at)
