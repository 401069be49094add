"""Paths and names of files that somebody has given: one place that takes or refuses them."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

from pea_core.params import ParameterError
from pea_core.printable import printable

SHOWN_MAX = 80
"""Characters of a path that an error repeats."""

NAME_MAX, PATH_MAX = 255, 4095
"""Bytes that Linux takes in a name, and in a path."""

STEM_MAX = 100
"""Bytes of a name that others are made from: a time, a number, an ending come behind it."""

TEXT_MAX = 64 << 20
"""Bytes of a text file that is read whole."""


def given(text: str | Path, what: str = "") -> Path:
    """A path as somebody has given it, with ``~`` for a home.

    Parameters
    ----------
    text : str or Path
    what : str
        What it is for, as an error names it: ``--out``, ``reference.path``.

    Raises
    ------
    ParameterError
        No file can have this path.
    """
    found = os.fspath(text)
    shown = f"{what} {printable(found, SHOWN_MAX)!r}".lstrip().replace("\\\\", "\\")
    if "\0" in found:
        raise ParameterError(f"{shown}: a path holds no NUL character")
    data = os.fsencode(found) if _encodes(found) else b""
    if found and not data:
        raise ParameterError(f"{shown}: is no text that a file can be named with")
    if len(data) > PATH_MAX or any(len(part) > NAME_MAX for part in data.split(b"/")):
        raise ParameterError(
            f"{shown}: is too long, a path has up to {PATH_MAX} bytes, each name {NAME_MAX}"
        )
    try:
        return Path(found).expanduser()
    except RuntimeError:
        user = found.split("/")[0]
        raise ParameterError(
            f"{shown}: there is no user {printable(user[1:], SHOWN_MAX)!r}; write ./{user} for a "
            "file of that name"
        ) from None


def _encodes(text: str) -> bool:
    try:
        os.fsencode(text)
    except UnicodeEncodeError:
        return False
    return True


def stem(name: str, what: str) -> str:
    """A name that directories and files may be named after.

    Raises
    ------
    ParameterError
        It would lead to another place, or be hidden, or no terminal could show it.
    """
    shown = f"{what} = {printable(name, SHOWN_MAX)!r}"
    if not name or "/" in name or name.startswith((".", "-", "~")) or not name.isprintable():
        raise ParameterError(
            f"{shown}: directories are named after it; give letters, digits, _ and -, without a / "
            "and not a dot, - or ~ first"
        )
    if len(name.encode()) > STEM_MAX:
        raise ParameterError(f"{shown}: is too long, give up to {STEM_MAX} bytes")
    return name


def bytes_of(path: Path, most: int = TEXT_MAX, what: str = "") -> bytes:
    """What a regular file holds.

    Parameters
    ----------
    path : Path
    most : int
        Bytes that it may have.
    what : str
        How an error names the file, where not by its path.

    Raises
    ------
    ParameterError
        It cannot be read, is no regular file, or is larger than `most` bytes.
    """
    shown = what or printable(str(path))
    try:  # a FIFO without a writer does not block
        with open(path, "rb", opener=lambda p, flags: os.open(p, flags | os.O_NONBLOCK)) as file:
            found = os.fstat(file.fileno())
            if stat.S_ISDIR(found.st_mode):
                raise ParameterError(f"{shown}: {os.strerror(errno.EISDIR)}")
            if not stat.S_ISREG(found.st_mode):
                raise ParameterError(
                    f"{shown}: is a device, a pipe or a socket; give a file on a disk"
                )
            data = b"" if found.st_size > most else file.read(most + 1)
    except OSError as error:
        raise ParameterError(f"{shown}: {error.strerror}") from None
    if found.st_size > most or len(data) > most:
        has = max(found.st_size, len(data))
        raise ParameterError(f"{shown}: has {has} bytes, more than {most}; give a smaller file")
    return data


def text_of(path: Path, most: int = TEXT_MAX, encoding: str = "utf-8") -> str:
    """Text of a regular file.

    Raises
    ------
    ParameterError
        It cannot be read, is no regular file, is larger than `most` bytes, or is no text.
    """
    try:
        return bytes_of(path, most).decode(encoding)
    except UnicodeDecodeError as error:
        raise ParameterError(
            f"{path}: no {encoding} text: byte {error.object[error.start]:#04x} at {error.start}"
        ) from None


def own(directory: Path) -> bool:
    """Whether nobody else can put files into a directory, where they are code that is run."""
    try:
        found = directory.stat()
    except FileNotFoundError:
        return True  # it is made
    except OSError:
        return False
    return found.st_uid in (0, os.geteuid()) and not found.st_mode & stat.S_IWOTH
