"""Arrays of long recordings: beyond `LIMIT` they lie in a file, which the system pages in and out.

The file has no name, so nothing is left behind, however the process ends. Who goes through such
arrays in `pieces` needs the memory of a piece, however long they are.
"""

from __future__ import annotations

import contextlib
import math
import mmap
import os
import tempfile
from collections.abc import Iterator, Sequence
from typing import IO, Any

import numpy as np

LIMIT = 1 << 25
"""Bytes up to which an array is kept in memory."""

PIECE = 1 << 18
"""Rows that are looked at together."""

FOLDER = "/var/tmp"
"""Where the files are, unless TMPDIR is set: /tmp is memory on many systems."""


def _file() -> IO[bytes]:
    folder = None if os.environ.get("TMPDIR") else FOLDER
    with contextlib.suppress(OSError):
        return tempfile.TemporaryFile(dir=folder)
    return tempfile.TemporaryFile()


def _mapped(file: IO[bytes], dtype: Any, shape: tuple[int, ...]) -> np.ndarray:
    return np.asarray(np.memmap(file, dtype, "r+", shape=shape))


def pieces(rows: int, *arrays: np.ndarray, before: int = 0) -> Iterator[slice]:
    """Slices of `PIECE` rows, one after the other; each array's pages are given back after each.

    Parameters
    ----------
    rows : int
        Rows of all slices together.
    *arrays : array
        What is read or written at these slices.
    before : int
        Rows that a slice repeats of the one before, for what looks at neighbours.
    """
    for start in range(0, rows, PIECE):
        yield slice(max(start - before, 0), min(start + PIECE, rows))
        if rows > PIECE:
            for array in arrays:
                give_back(array)


def give_back(array: np.ndarray) -> None:
    """Let the system have the memory of an array that lies in a file; what it holds stays."""
    owner: Any = array
    while isinstance(owner, np.ndarray) and not isinstance(owner, np.memmap):
        owner = owner.base
    if isinstance(owner, np.memmap) and isinstance(held := owner.base, mmap.mmap):
        held.madvise(mmap.MADV_DONTNEED)


def same(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether two arrays hold the same."""
    if len(first) != len(second):
        return False
    parts = pieces(len(first), first, second)
    return first is second or all(np.array_equal(first[part], second[part]) for part in parts)


def empty(shape: int | tuple[int, ...], dtype: Any = float) -> np.ndarray:
    """An array as of `numpy.empty`; a large one lies in a file where there is room for it."""
    shape = (shape,) if isinstance(shape, int) else shape
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size > LIMIT:
        with contextlib.suppress(OSError):
            file = _file()
            os.posix_fallocate(file.fileno(), 0, size)  # a full disk shows here, not as SIGBUS
            return _mapped(file, dtype, shape)
    return np.empty(shape, dtype)


class Growing:
    """Rows that come in pieces, in memory up to `LIMIT` bytes, then in a file.

    Parameters
    ----------
    dtype : data-type
    width : int
        Columns; 0 for a plain array.
    """

    def __init__(self, dtype: Any, width: int = 0) -> None:
        self._dtype = np.dtype(dtype)
        self._row = (width,) if width else ()
        self._pieces: list[np.ndarray] = []
        self._held = 0
        self._file: IO[bytes] | None = None
        self._rows = 0

    def __len__(self) -> int:
        return self._rows

    def add(self, rows: np.ndarray) -> None:
        """Append rows.

        Raises
        ------
        OSError
            The disk is full.
        """
        rows = np.ascontiguousarray(rows, self._dtype)
        self._pieces.append(rows)
        self._rows += len(rows)
        self._held += rows.nbytes
        if self._held > LIMIT:
            self._spill()

    def _spill(self) -> None:
        if self._file is None:
            self._file = _file()
        for piece in self._pieces:
            self._file.write(piece.tobytes())
        self._pieces, self._held = [], 0

    def whole(self) -> np.ndarray:
        """All rows."""
        if self._file is None:
            return joined(self._pieces, self._dtype, self._row)
        self._spill()
        self._file.flush()
        return _mapped(self._file, self._dtype, (self._rows, *self._row))


def joined(pieces: Sequence[np.ndarray], dtype: Any, row: tuple[int, ...] = ()) -> np.ndarray:
    """The pieces one after the other."""
    return np.concatenate([np.empty((0, *row), dtype), *pieces])
