"""Only one process drives a device: a second one is refused before it sends anything.

A claim is a lock (`flock`) that the system releases when the process ends, in whatever way. A
process may hold it more than once, for example for the watchdog's connection. A process that
inherits the descriptor of the lock holds it, too.

=========== ========================================== ========================================
a device    the lock is on                             it excludes
=========== ========================================== ========================================
serial line its device file                            every process that locks it, of any user
TCP         a file of the user's own, which no other   every process of this user; of other
            user can lock                              users, those that are connected now
=========== ========================================== ========================================

Only the device can see a client on another machine, or a program that does not use this lock.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import pwd
import socket
import stat
import struct
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary, finalize

from pea_core.params import ParameterError

RUNTIME, TEMPORARY = "/run/user", "/tmp"
"""Where a user's own folder is, and where one is made if the system has none."""

ESTABLISHED = "01"
"""State of a connection in ``/proc/net/tcp``."""


class Claim:
    """A lock that is held as long as the object exists.

    Parameters
    ----------
    address : str
        As the user gave it.
    path : Path
        File to lock; for a TCP device a file that is made for the lock.
    made : bool
        Whether the file is made.

    Raises
    ------
    ParameterError
        Another process holds the lock.
    OSError
        The file cannot be opened.
    """

    def __init__(self, address: str, path: Path, made: bool) -> None:
        self._file, self.path = -1, path if made else None
        flags = os.O_CREAT | os.O_NOFOLLOW if made else os.O_NOCTTY | os.O_NONBLOCK
        while self._file < 0 or (made and not _is(self._file, path)):  # removed by the last holder
            self._close()
            self._file = os.open(path, os.O_RDWR | os.O_CLOEXEC | flags, 0o600)
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                who = _holder(self._file)
                self._close()
                raise ParameterError(
                    f"address = {address!r}: another process of this machine drives it{who}; end "
                    "that first"
                ) from None
        finalize(self, _release, self._file, self.path)

    def fileno(self) -> int:
        """File descriptor of the lock; a process that inherits it keeps the device claimed."""
        return self._file

    def _close(self) -> None:
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def _release(file: int, made: Path | None) -> None:
    """Give a lock back, and remove the file that was made for it."""
    os.close(file)
    if made is not None:  # our file, unless another process has inherited or locked it
        with contextlib.suppress(OSError), open(made, "r+b") as again:
            fcntl.flock(again, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is(again.fileno(), made):
                made.unlink()


_HELD: WeakValueDictionary[Path, Claim] = WeakValueDictionary()


def claim(address: str, kind: str, place: Any) -> Claim:
    """The claim of this process on a device.

    Parameters
    ----------
    address : str
        As the user gave it, for errors.
    kind : str
        ``tcp`` or ``serial``.
    place : tuple or str
        IP address and port, or path of the device file.

    Raises
    ------
    ParameterError
        Another process holds it, or another user is connected to it; one line.
    OSError
        The device file cannot be opened.
    """
    if kind == "serial":
        path = Path(os.path.realpath(place))
    else:
        path = _folder(address) / "_".join(map(str, (kind, *place))).replace("/", "_")
    known = _HELD.get(path)
    if known is None:
        known = _HELD[path] = Claim(address, path, made=kind != "serial")
        if kind == "tcp" and (others := _connected(place)):
            raise ParameterError(
                f"address = {address!r}: {_named(others)} of this machine is connected to it; "
                "end that first"
            )
    return known


def held() -> list[Claim]:
    """All claims of this process; they are held as long as the list exists."""
    return list(_HELD.values())


def _folder(address: str) -> Path:
    """Folder to which only this user can write, the same for all processes of the user.

    Raises
    ------
    ParameterError
        Another user has made it.
    """
    uid = os.getuid()
    run = Path(RUNTIME, str(uid))
    try:
        of_system = run.stat().st_uid == uid and os.access(run, os.W_OK)
    except OSError:
        of_system = False
    folder = (run if of_system else Path(TEMPORARY)) / f"pea-{uid}"
    try:
        with contextlib.suppress(FileExistsError):
            folder.mkdir(0o700)
        found = folder.lstat()
    except OSError as error:
        raise ParameterError(
            f"address = {address!r}: no place for its lock, {folder}: {error.strerror}"
        ) from None
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != uid or found.st_mode & 0o022:
        raise ParameterError(
            f"address = {address!r}: {folder}, where its lock belongs, must be a folder that only "
            f"this user can write to; {_named({found.st_uid})} has made it: remove it"
        )
    return folder


def _is(descriptor: int, path: Path) -> bool:
    """Whether an open file is still the one at this path."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except OSError:
        return False


def _named(users: set[int]) -> str:
    names = []
    for uid in sorted(users):
        try:
            names.append(pwd.getpwuid(uid).pw_name)
        except KeyError:
            names.append(str(uid))
    return "user " + ", ".join(names)


def _holder(descriptor: int) -> str:
    """Who locks a file, as ``(process 4711, user nobody)``; empty if that is unknown."""
    file = os.fstat(descriptor)
    inode = f"{os.major(file.st_dev):02x}:{os.minor(file.st_dev):02x}:{file.st_ino}"
    with contextlib.suppress(OSError):
        for line in Path("/proc/locks").read_text().splitlines():
            words = line.split()
            if len(words) > 5 and words[1] == "FLOCK" and words[5] == inode:
                pid = int(words[4])
                return f" (process {pid}, {_named({os.stat(f'/proc/{pid}').st_uid})})"
    return ""


def _connected(place: tuple[str, int]) -> set[int]:
    """Other users of this machine that are connected to an IP address and port."""
    host, port = place
    users = set()
    with contextlib.suppress(OSError, ValueError):
        if ":" in host:
            packed, table = socket.inet_pton(socket.AF_INET6, host.partition("%")[0]), "tcp6"
        else:
            packed, table = socket.inet_aton(host), "tcp"
        words = struct.unpack(f"={len(packed) // 4}I", packed)
        remote = f"{''.join(f'{word:08X}' for word in words)}:{port:04X}"
        for line in Path("/proc/net", table).read_text().splitlines()[1:]:
            fields = line.split()
            if fields[2] == remote and fields[3] == ESTABLISHED:
                users.add(int(fields[7]))
    return users - {os.getuid()}
