"""Checks that one live node publishes each topic of the loop; names all publishers if not.

The graph lists an endpoint of a killed process until the middleware's lease ends, 20 s later. The
identifier of an endpoint (GUID) holds host and process, so the process table shows whether the
process of an endpoint on this machine is dead. A process of another machine counts as live.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator, Sequence
from itertools import cycle, islice
from pathlib import Path
from typing import Any, NamedTuple

from rclpy.node import Node

from pea_ros.transport import UNSURE, full_name, publishers_of
from pea_wire.topics import DIAGNOSTICS, Topic

UNKNOWN = "_UNKNOWN_"
"""Part of the name that rmw gives an endpoint before its node's name is known."""

NAMED = 0.1
"""Seconds to wait for the name of a second publisher; its messages are not used before."""

REFUSED = 2.0
"""Seconds after which a second pea node that has not published yet ends."""

PATIENCE = 2 * REFUSED
"""Seconds that the first pea node waits for the second one to end."""

LOOK_AGAIN = 0.2
"""Seconds between two checks of publishers whose number has not changed."""

_VENDOR = b"\x01\x0f"
"""First bytes of a GUID of Fast DDS; host, process and participant follow."""


class Publisher(NamedTuple):
    """One publisher of a topic.

    Attributes
    ----------
    gid : bytes
        Its identifier.
    name : str
        Full name of its node; empty if the graph has none.
    """

    gid: bytes
    name: str

    @property
    def process(self) -> int:
        """The lower 16 bits of its process's number."""
        return int.from_bytes(self.gid[4:6], "little")

    def __str__(self) -> str:
        who = self.name or f"GUID {self.gid.hex()}"
        return f"{who} (process {self.process})" if self.gid[:2] == _VENDOR else who


def _live(low: int) -> Iterator[int]:
    """Running processes whose number has these lower 16 bits."""
    for entry in os.listdir("/proc"):
        if entry.isdecimal() and int(entry) & 0xFFFF == low:
            try:
                stat = Path(f"/proc/{entry}/stat").read_text(errors="replace")
            except OSError:  # ended meanwhile
                continue
            if stat.rpartition(")")[2].split()[0] not in "ZX":
                yield int(entry)


class Publishers:
    """Checks that each topic of the loop has one live publisher.

    Parameters
    ----------
    node : rclpy.node.Node
        The node that checks.
    """

    def __init__(self, node: Node) -> None:
        self.node = node
        self._spoken: tuple[Topic, list[Publisher]] | None = None
        self._overseen: tuple[Topic, ...] = ()
        self._turn: Iterator[Topic] = iter(())
        self._host = b""
        self._dead: set[bytes] = set()
        self._since: dict[bytes, float] = {}
        self._looked: dict[Topic, tuple[int, float, str]] = {}
        self._shared = 0.0

    def oversee(self, topics: Iterable[Topic]) -> None:
        """Also check these topics, to which the node does not subscribe."""
        self._overseen = tuple(topics)
        self._turn = cycle(self._overseen)

    def of(self, topic: Topic) -> list[Publisher]:
        """Live publishers of a topic, the one known for the longest time first."""
        found = []
        for end in publishers_of(self.node, topic):
            gid = bytes(end.endpoint_gid)
            name = f"{end.node_namespace.rstrip('/')}/{end.node_name}"
            if not self._is_dead(gid):
                self._since.setdefault(gid, time.monotonic())
                found.append(Publisher(gid, "" if UNKNOWN in name else name))
        return sorted(found, key=lambda one: self._since[one.gid])

    def judge(self, inbox: Any, number: int) -> bool:
        """Whether a message whose number does not follow the last one may be used: see `Sender`.

        A gap in the numbers is a loss if the second publisher is a pea node that still checks
        whether it is alone: such a node has published nothing. If it did publish, its numbers would
        soon be lower than those of the first publisher.
        """
        if self._spoken is not None:  # no message is used before the conflict is reported
            return False
        topic, found = inbox.topic, self.of(inbox.topic)
        again = inbox.due is not None and number < inbox.due
        counted = inbox.due not in (None, UNSURE) and not again
        silent = counted and not self._late(topic, found)
        if (len(found) > 1 and not silent) or (found and again and found[0].gid == inbox.holder):
            self._spoken = topic, found
            return False
        if found:
            inbox.holder = found[0].gid
        return True

    def intruder(self, inboxes: Iterable[Any], every: bool = False) -> str:
        """Names of all publishers of a topic with more than one; else empty: see `each`."""
        return next(filter(None, self.each(inboxes, every)), "")

    def each(self, inboxes: Iterable[Any], every: bool = False) -> Iterator[str]:
        """Check one topic after the other.

        Parameters
        ----------
        inboxes : iterable of Inbox or NaiveInbox
            Their topics are checked.
        every : bool
            Check all topics of `oversee`, instead of one in turn.

        Yields
        ------
        str
            Names of all publishers of the topic if there are more than one; else empty.
        """
        if self._spoken is not None:
            spoken, found = self._spoken
            found = max(self.of(spoken), found, key=len)
            if not all(one.name or self._age(one) > NAMED for one in found):
                return
            self._spoken = None
            yield _conflict(full_name(self.node, spoken), found)
        seen = set()
        for inbox in inboxes:
            seen.add(inbox.topic)
            if inbox.judge is not None:
                yield self._silent(inbox.topic, inbox.publishers)
        for topic in self._overseen if every else islice(self._turn, 1):
            if topic not in seen:
                count = self.node.count_publishers(full_name(self.node, topic))
                yield self._silent(topic, count)

    def beside(self, topics: Iterable[Topic]) -> str:
        """Names of other publishers of this node's topics, before it publishes; else empty."""
        for topic in topics:
            if topic.publisher and self.node.count_publishers(full_name(self.node, topic)) > 1:
                found = self.of(topic)
                if len(found) > 1:
                    self._shared = self._shared or time.monotonic()
                    names = " and ".join(map(str, found))
                    head = f"{len(found)} {topic.publisher}s publish {full_name(self.node, topic)}"
                    return f"{head}: {names}; end the other one first"
        self._shared = 0.0
        return ""

    @property
    def stay(self) -> bool:
        """Whether the other publishers of `beside` have existed for longer than `REFUSED`."""
        return bool(self._shared) and time.monotonic() - self._shared > REFUSED

    def _silent(self, topic: Topic, count: int) -> str:
        """Names of all publishers of a topic with more than one, before a second one has published.

        The second publisher gets some time: its name may come late, and a second pea node ends.
        """
        now = time.monotonic()
        before, then, text = self._looked.get(topic, (0, 0.0, ""))
        if count != before or (count > 1 and now - then >= LOOK_AGAIN):
            found = self.of(topic)
            late = self._late(topic, found)
            text = _conflict(full_name(self.node, topic), found) if late else ""
            self._looked[topic] = count, now, text
        return text

    def _late(self, topic: Topic, found: Sequence[Publisher]) -> bool:
        """Whether a publisher other than the first has existed for longer than its patience."""
        return any(self._age(one) >= self._patience(topic, one) for one in found[1:])

    def _age(self, one: Publisher) -> float:
        """Seconds since a publisher was first seen."""
        return time.monotonic() - self._since[one.gid]

    def _patience(self, topic: Topic, one: Publisher) -> float:
        """Seconds that a silent second publisher may exist."""
        if not one.name:
            return NAMED
        ours = f"{self.node.get_namespace().rstrip('/')}/{topic.publisher}"
        return PATIENCE if one.name == ours else 0.0

    def _is_dead(self, gid: bytes) -> bool:
        """Whether an endpoint belongs to a process of this machine that has ended."""
        here = gid not in self._dead and gid[:4] == self._here()
        if here and not any(_live(int.from_bytes(gid[4:6], "little"))):
            self._dead.add(gid)
        return gid in self._dead

    def _here(self) -> bytes:
        """Vendor and host in the identifiers of this process; empty if they contain none."""
        if not self._host:
            own = (os.getpid() & 0xFFFF).to_bytes(2, "little")
            for end in publishers_of(self.node, DIAGNOSTICS):
                gid = bytes(end.endpoint_gid)
                if gid[:2] == _VENDOR and gid[4:6] == own:
                    self._host = gid[:4]
        return self._host


def _conflict(topic: str, found: Sequence[Publisher]) -> str:
    names = " and ".join(map(str, found))
    if len(found) == 1:
        return f"somebody publishes {topic} besides {names}; end all but one"
    return f"{len(found)} publishers of {topic}: {names}; end all but one"
