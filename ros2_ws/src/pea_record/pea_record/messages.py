"""Messages of any rosbag2 bag, ours or not, as they were recorded: raw, by log time."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

from pea_record import bounds
from pea_record.bag import METADATA
from pea_record.mcap import MAGIC
from pea_record.recording import BagError
from pea_wire.topics import DIAGNOSTICS

FILES = (".mcap", ".db3")
"""How the files end that a bag consists of."""


class Channel(NamedTuple):
    """One topic of a bag.

    Attributes
    ----------
    type : str
        Message type, ``package/msg/Type``.
    hash : str
        Its RIHS01 hash; empty where the bag does not say.
    messages : int
        How many there are.
    qos : tuple
        What its publishers offered, as rosbags tells it.
    """

    type: str
    hash: str
    messages: int
    qos: tuple[Any, ...]


class Messages:
    """A bag that is open for reading; a context manager.

    Parameters
    ----------
    path : Path
        A bag's directory, or an MCAP or SQLite file.

    Attributes
    ----------
    channels : dict of str to Channel
        By topic.
    start, end : int
        First log time, and one after the last (ns).

    Raises
    ------
    BagError
        It cannot be read, or holds no message.
    """

    def __init__(self, path: Path) -> None:
        from rosbags.rosbag2 import Reader  # slow to import

        self.path = path
        self._open = contextlib.ExitStack()
        with self._told(), contextlib.ExitStack() as stack:
            for file in [path] if path.is_file() else path.glob("*.mcap"):
                if file.suffix == ".mcap":
                    bounds.check(file, MAGIC)
            self._readers = [stack.enter_context(Reader(file)) for file in _parts(path)]
            self._open = stack.pop_all()
        full = [reader for reader in self._readers if reader.message_count]
        if not full:
            self._open.close()
            raise BagError(f"{path} holds no message")
        self.start = min(reader.start_time for reader in full)
        self.end = max(reader.end_time for reader in full)
        self.channels: dict[str, Channel] = {}
        for connection in (c for reader in self._readers for c in reader.connections):
            known = self.channels.get(connection.topic, Channel("", "", 0, ()))
            more: Any = connection.ext  # that of rosbag2
            self.channels[connection.topic] = Channel(
                connection.msgtype,
                connection.digest or known.hash,
                connection.msgcount + known.messages,
                (*known.qos, *more.offered_qos_profiles),
            )

    def between(
        self, topics: Collection[str], start: int, end: int
    ) -> Iterator[tuple[int, str, bytes]]:
        """Log time (ns), topic and CDR of each message of `topics` in [start, end).

        Raises
        ------
        BagError
            The bag is damaged there.
        """
        with self._told():
            for reader in self._readers:
                wanted = [c for c in reader.connections if c.topic in topics]
                for connection, time, data in reader.messages(wanted, start, end) if wanted else ():
                    yield time, connection.topic, bytes(data)

    @contextlib.contextmanager
    def _told(self) -> Iterator[None]:
        """Turn whatever the reader raises into one line; what the caller raises passes."""
        try:
            yield
        except (BagError, KeyboardInterrupt, GeneratorExit):
            raise
        except Exception as error:  # of file, database, compression, or of a wrong byte
            why = " ".join(str(error).split()).rstrip(".") or type(error).__name__
            raise BagError(f"{self.path} cannot be read: {why}; try pea bag recover") from None

    def __enter__(self) -> Messages:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._open.close()


def _parts(path: Path) -> list[Path]:
    """What rosbags opens: the bag's directory, or its files where that lacks its metadata."""
    if path.is_file():
        if path.suffix not in FILES:
            raise BagError(f"{path} is no recording: must end in {' or '.join(FILES)}")
        return [path]
    if not path.is_dir():
        raise BagError(f"{path} does not exist")
    if (path / METADATA).exists():
        return [path]
    files = sorted(file for file in path.iterdir() if file.suffix in FILES)
    if not files:
        raise BagError(f"{path} is no recording: no {', '.join((METADATA, *FILES))} in it")
    return files


def diagnostics(path: Path) -> Iterator[tuple[int, Any]]:
    """Each ``DiagnosticStatus`` of a recording with its log time (ns).

    Raises
    ------
    BagError
        The bag is damaged; what came before has been given.
    """
    from rosbags.typesys import Stores, get_typestore

    decode: Callable[..., Any] = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr
    with Messages(path) as bag:
        for time, _, data in bag.between((DIAGNOSTICS.name,), bag.start, bag.end):
            for status in decode(data, DIAGNOSTICS.type).status:
                yield time, status
