"""A small file that promises, or unpacks to, very much is refused at once."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import pytest
import zstandard

from pea_record.bounds import CHUNK_MAX, RECORD_MAX
from pea_record.mcap import MAGIC
from pea_record.messages import Messages
from pea_record.read import load
from pea_record.recording import BagError
from pea_record.tape import Tape

CHUNK, MESSAGE, CHANNEL = 6, 5, 4


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def text(word: str) -> bytes:
    return struct.pack("<I", len(word)) + word.encode()


def chunk(data: bytes, size: int, compression: str) -> bytes:
    return record(
        CHUNK,
        struct.pack("<QQQI", 0, 0, size, 0)
        + text(compression)
        + struct.pack("<Q", len(data))
        + data,
    )


def zeros(size: int) -> bytes:
    return zstandard.compress(bytes(size), 19)


def lying(size: int) -> bytes:
    """A frame that does not say what it unpacks to."""
    packer = zstandard.ZstdCompressor(write_content_size=False)
    return packer.compress(bytes(size))


FILES: dict[str, Callable[[], bytes]] = {
    "zeros": lambda: chunk(zeros(CHUNK_MAX), CHUNK_MAX, "zstd"),
    "zeros, many": lambda: chunk(zeros(1 << 20), 1 << 20, "zstd") * 500,
    "zeros, lz4": lambda: chunk(lz4.frame.compress(bytes(1 << 20)), 100, "lz4"),
    "too large a chunk": lambda: chunk(b"", 2**40, "zstd"),
    "more than it says": lambda: chunk(zeros(1 << 20), 1000, "zstd"),
    "more, unsaid": lambda: chunk(lying(1 << 20), 1000, "zstd"),
    "too long a record": lambda: struct.pack("<BQ", MESSAGE, RECORD_MAX + 1) + bytes(1000),
    "channels": lambda: (
        record(CHANNEL, struct.pack("<HH", 1, 0) + text("a") + text("") + text("")) * 100_001
    ),
    "a compression that clears the screen": lambda: chunk(b"", 10, "\x1b[2Jzstd"),
    "records of nothing": lambda: record(0x80, b"") * 1000,
}


@pytest.mark.timeout(30)
@pytest.mark.parametrize("make", FILES.values(), ids=FILES)
def test_it_is_refused(tmp_path: Path, make: Callable[[], bytes]) -> None:
    file = tmp_path / "bomb.mcap"
    file.write_bytes(MAGIC + make())
    with pytest.raises(BagError, match="bomb") as refused:
        load(file)
    assert str(refused.value).isprintable()
    with pytest.raises(BagError, match="bomb") as refused, Messages(file):
        pass
    assert str(refused.value).isprintable()


@pytest.mark.timeout(30)
def test_a_hole_of_a_terabyte_is_no_recording(tmp_path: Path) -> None:
    file = tmp_path / "sparse.mcap"
    file.write_bytes(MAGIC)
    with open(file, "r+b") as stream:
        stream.truncate(2**40)
    with pytest.raises(BagError, match="sparse"):
        load(file)
    assert Tape().survey(file) == []
    with pytest.raises(BagError), Messages(file):
        pass
