"""How a node's samples travel over DDS: by rclpy's public means, by hand, or compiled.

Three ways over the same topics, types and offered QoS, so that any ROS tool sees ordinary topics:

``naive``
    rclpy's public interface alone: an executor and its callbacks, reliable subscriptions.
``fast``
    Raw messages taken by hand from one reused wait set, no executor on the hot path. What is
    between taking and publishing is compiled in long runs (`pea_ros.fast`).
``turbo``
    All of it from compiled code (`pea_ros.turbo`).

What compiled code does not know, a foreign node's layout for example, it leaves to Python.

``fast`` and ``turbo`` ask for best effort between the loop's own nodes. One message is under way
on each topic; should it go missing all the same, it comes a second time, reliably, in the blocks
that the recorder gets (`SampledOutbox`). Both use more of rclpy than it promises, so a node tries
them with a probe before it takes them.
"""

from __future__ import annotations

import importlib
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from pea_core.units import SECOND
from pea_ros.paths import FAST, NAIVE
from pea_wire import convert
from pea_wire.topics import BLOCKS, Topic, blocks_of

PROBE = 2.0
"""Seconds that a probe may take."""

MOST, LARGE = 64, 1 << 20
"""Messages, and bytes, that are taken between two samples: a flood may not stop the clock."""

UNSURE = -1
"""A number that no message has."""


def qos(topic: Topic, best_effort: bool = False) -> QoSProfile:
    """QoS that `topic` is offered with, or asked for with less."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=topic.depth,
        reliability=ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE,
    )


def asked(node: Node, topic: Topic) -> str:
    """Name that a node asks for: the blocks of a topic go where that is remapped to."""
    if not topic.relative.endswith(BLOCKS):
        return topic.relative
    return node.resolve_topic_name(topic.relative.removesuffix(BLOCKS)) + BLOCKS


def full_name(node: Node, topic: Topic) -> str:
    """Name that a topic has for a node, by its namespace and remaps."""
    return node.resolve_topic_name(asked(node, topic))


def publishers_of(node: Node, topic: Topic) -> list[Any]:
    """Publishers of a topic, as a node names it."""
    return list(node.get_publishers_info_by_topic(asked(node, topic)))


def subscriptions_of(node: Node, topic: Topic) -> list[Any]:
    """Subscriptions to a topic, as a node names it."""
    return list(node.get_subscriptions_info_by_topic(asked(node, topic)))


def message_type(name: str) -> Any:
    """Message class of ``package/msg/Type``."""
    package, _, kind = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), kind)


class _HotGroup(CallbackGroup):
    """Keeps subscriptions out of the executor: the hot path takes them itself."""

    def can_execute(self, entity: object) -> bool:
        return False

    def beginning_execution(self, entity: object) -> bool:
        return False

    def ending_execution(self, entity: object) -> None:
        pass


class Sender:
    """Sees that the messages of a topic come from one publisher.

    A publisher numbers its messages. A number that does not follow the last one means that
    messages were lost, or that another publisher speaks: `judge` decides.

    Parameters
    ----------
    judge : callable, optional
        Gets this object and the number; whether the message may be used. Without one all may.

    Attributes
    ----------
    due : int or None
        Number of the next message; None before the first.
    holder : bytes
        Identifier of the publisher, where `judge` knows it.
    """

    def __init__(self, judge: Callable[[object, int], bool] | None = None) -> None:
        self.judge = judge
        self.due: int | None = None
        self.holder = b""

    def admit(self, number: int | None) -> bool:
        """Whether a message out of sequence may be used."""
        if number is None:  # this middleware does not number
            return True
        if self.judge is not None and not self.judge(self, number):
            self.due = UNSURE  # whichever comes next is judged, too
            return False
        self.due = number + 1
        return True

    def take(self) -> bytes | None:
        """The next message's bytes; None where there is none, or it may not be used."""
        raise NotImplementedError

    def messages(self) -> Iterator[bytes]:
        """What has come, at most `MOST` messages and `LARGE` bytes: the rest waits."""
        size = 0
        for _ in range(MOST):
            if size > LARGE or (data := self.take()) is None:
                return
            size += len(data)
            yield data


class Inbox(Sender):
    """A subscription whose raw messages are taken by hand.

    Parameters
    ----------
    node : rclpy.node.Node
    topic : Topic
    best_effort : bool
        Ask for no more than best effort.
    judge : callable, optional
        See `Sender`.

    Attributes
    ----------
    armed : bool
        Whether the wait set holds the subscription: not after others have used it.
    blocks : Inbox or None
        The same messages in blocks, reliably, where this inbox asks for best effort.
    """

    def __init__(
        self,
        node: Node,
        topic: Topic,
        best_effort: bool = False,
        judge: Callable[[Any, int], bool] | None = None,
    ) -> None:
        super().__init__(judge)
        self.topic = topic
        self.type = message_type(topic.type)
        self.waits = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, node.context.handle)
        self._subscribe(node, best_effort)

    def _subscribe(self, node: Node, best_effort: bool) -> None:
        self.best_effort = best_effort
        self.due = None
        self.blocks = Inbox(node, blocks_of(self.topic), judge=self.judge) if best_effort else None
        self._block = b""
        self.subscription = node.create_subscription(
            self.type,
            asked(node, self.topic),
            lambda message: None,
            qos(self.topic, best_effort),
            callback_group=_HotGroup(),
            raw=True,
        )
        self.handle: Any = self.subscription.handle
        self.armed = False

    def rely(self, node: Node) -> None:
        """Subscribe anew and ask for reliability, before anything has come."""
        self.close(node)
        self._subscribe(node, best_effort=False)

    def close(self, node: Node) -> None:
        """Unsubscribe, from the blocks too."""
        node.destroy_subscription(self.subscription)
        self.handle = None
        if self.blocks is not None:
            self.blocks.close(node)

    def keep(self) -> None:
        """Keep the last block of what was sent, and no older one."""
        while self.blocks is not None and (data := self.blocks.take()) is not None:
            self._block = data

    def missed(self, stamp: int) -> bytes | None:
        """A message that was sent, by the blocks, at `stamp` (ns), or None.

        Raises
        ------
        ConversionError
            The last block is none.
        """
        try:
            return convert.find(self._block, stamp) if self._block else None
        except convert.ConversionError as error:
            name = blocks_of(self.topic).name
            raise convert.ConversionError(error.field, error.rule, name) from None

    def take(self) -> bytes | None:
        """The next message's bytes; None where there is none, or it may not be used."""
        taken = self.handle.take_message(self.type, True)
        if taken is None:
            return None
        number = taken[1]["publication_sequence_number"]
        if number == self.due:
            self.due = number + 1
        elif not self.admit(number):
            return None
        return taken[0]

    def come(self) -> bool:
        """Whether a message is there; it stays."""
        self.wait(0.0)
        return self.armed

    def wait(self, seconds: float) -> None:
        """Sleep until there is a message, at most so long.

        Only this topic wakes: what waits untaken elsewhere must not keep the loop spinning. A
        wait in vain takes the subscription out of the wait set; to put it in costs as much again.
        """
        armed, self.armed = self.armed, False  # also should the wait be broken off
        if not armed:
            self.waits.clear_entities()
            self.waits.add_subscription(self.handle)
        self.waits.wait(int(seconds * SECOND))
        self.armed = self.waits.is_ready("subscription", 0)

    @property
    def publishers(self) -> int:
        """How many publishers are matched; none once it is closed, which who looks may not know."""
        return int(self.handle.get_publisher_count()) if self.handle else 0


class NaiveInbox(Sender):
    """A subscription that an executor serves.

    Parameters
    ----------
    node : rclpy.node.Node
    topic : Topic
    spin : callable
        Lets the executor wait for anything, at most so many seconds.
    judge : callable, optional
        See `Sender`.
    """

    def __init__(
        self,
        node: Node,
        topic: Topic,
        spin: Callable[[float], None],
        judge: Callable[[Any, int], bool] | None = None,
    ) -> None:
        super().__init__(judge)
        self.topic = topic
        self._come: deque[bytes] = deque()
        self._spin = spin
        self.subscription = node.create_subscription(
            message_type(topic.type), asked(node, topic), self._receive, qos(topic), raw=True
        )

    def close(self, node: Node) -> None:
        """Unsubscribe."""
        node.destroy_subscription(self.subscription)

    def _receive(self, data: bytes, info: dict[str, Any]) -> None:
        number = info["publication_sequence_number"]
        if number == self.due:
            self.due = number + 1
        elif not self.admit(number):
            return
        self._come.append(data)

    def take(self) -> bytes | None:
        """The next message's bytes, or None."""
        if not self._come:
            self._spin(0.0)
        return self._come.popleft() if self._come else None

    def come(self) -> bool:
        """Whether a message is there; it stays."""
        return bool(self._come)

    def wait(self, seconds: float) -> None:
        """Sleep until there is something to serve, at most so long."""
        if not self._come:
            self._spin(seconds)

    @property
    def publishers(self) -> int:
        """How many publishers are matched."""
        return int(self.subscription.handle.get_publisher_count())


class Outbox:
    """A publisher of raw messages.

    Parameters
    ----------
    node : rclpy.node.Node
    topic : Topic
    path : str
        One of `pea_ros.paths.PATHS`.
    """

    def __init__(self, node: Node, topic: Topic, path: str = FAST) -> None:
        self.topic = topic
        self.publisher = node.create_publisher(
            message_type(topic.type), asked(node, topic), qos(topic)
        )
        self.send: Callable[[bytes], None] = (
            self.publisher.publish if path == NAIVE else self.publisher.handle.publish_raw
        )

    @property
    def subscribers(self) -> int:
        """How many subscribers are matched."""
        return int(self.publisher.handle.get_subscription_count())


class SampledOutbox(Outbox):
    """A publisher of one message a sample, which the recorder gets again in blocks.

    A second reliable reader of every single message would cost more than the hop itself; a
    block costs it once for hundreds (docs/decisions/0009). Who has missed a message finds it
    there, too.

    Parameters
    ----------
    node : rclpy.node.Node
    topic : Topic
        One of `SAMPLED`.
    path : str
        One of `pea_ros.paths.PATHS`.
    size : int
        Bytes of a message.

    Attributes
    ----------
    show : callable
        Sends a message that is no sample: it does not come again in a block.
    """

    def __init__(self, node: Node, topic: Topic, path: str, size: int) -> None:
        self._size = size
        self.blocks = Outbox(node, blocks_of(topic))  # first: who sees the topic sees it, too
        super().__init__(node, topic, path)
        self._pending: list[bytes] = []
        self.show = self.send
        once, pending = self.send, self._pending.append

        def send(data: bytes) -> None:
            once(data)
            pending(data)

        self.send = send

    def sent(self, rows: bytes) -> None:
        """Note messages that compiled code has sent, one behind the other."""
        self._pending.append(rows)

    def flush(self) -> None:
        """Send in a block what was sent since the last time."""
        if self._pending:
            if self.blocks.subscribers:
                self.blocks.send(convert.encode_block(self._size, b"".join(self._pending)))
            self._pending.clear()
