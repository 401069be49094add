"""Transport of samples over DDS: by rclpy's public interface, by raw messages, or compiled.

All three use the same topics, types and offered QoS, so that any ROS tool sees ordinary topics:

``naive``
    Only rclpy's public interface: an executor and its callbacks, reliable subscriptions.
``fast``
    Raw messages from one reused wait set, without an executor on the hot path. In long runs the
    work between taking and publishing a message is compiled (`pea_ros.fast`).
``turbo``
    Compiled code does all of it (`pea_ros.turbo`).

Compiled code leaves messages that it cannot handle to Python, for example those of a foreign
node with another layout.

``fast`` and ``turbo`` request best effort between the loop's own nodes. Only one message at a time
is under way on each topic. If it is lost, it is sent again, reliably, in the blocks for the
recorder (`SampledOutbox`). Both use internals of rclpy, so a node tests them with a probe first.
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
"""Longest time (s) of a probe."""

MOST, LARGE = 64, 1 << 20
"""Most messages, and bytes, taken between two samples: a flood must not stop the loop."""

UNSURE = -1
"""A sequence number that no message has."""


def qos(topic: Topic, best_effort: bool = False) -> QoSProfile:
    """QoS of a publisher of `topic`; with `best_effort` that of a subscription."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=topic.depth,
        reliability=ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE,
    )


def asked(node: Node, topic: Topic) -> str:
    """Name of a topic before remapping; the blocks of a topic follow its remapped name."""
    if not topic.relative.endswith(BLOCKS):
        return topic.relative
    return node.resolve_topic_name(topic.relative.removesuffix(BLOCKS)) + BLOCKS


def full_name(node: Node, topic: Topic) -> str:
    """Name of a topic for a node, after its namespace and remaps."""
    return node.resolve_topic_name(asked(node, topic))


def publishers_of(node: Node, topic: Topic) -> list[Any]:
    """Publishers of a topic, by its name for a node."""
    return list(node.get_publishers_info_by_topic(asked(node, topic)))


def subscriptions_of(node: Node, topic: Topic) -> list[Any]:
    """Subscriptions to a topic, by its name for a node."""
    return list(node.get_subscriptions_info_by_topic(asked(node, topic)))


def message_type(name: str) -> Any:
    """Message class of ``package/msg/Type``."""
    package, _, kind = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), kind)


class _HotGroup(CallbackGroup):
    """Keeps subscriptions out of the executor: the hot path takes their messages itself."""

    def can_execute(self, entity: object) -> bool:
        return False

    def beginning_execution(self, entity: object) -> bool:
        return False

    def ending_execution(self, entity: object) -> None:
        pass


class Sender:
    """Checks that the messages of a topic come from one publisher.

    A publisher numbers its messages. A number that does not follow the last one means that
    messages were lost, or that there is another publisher: `judge` decides.

    Parameters
    ----------
    judge : callable, optional
        Called with this object and the number; returns whether the message may be used. Without
        it, every message may.

    Attributes
    ----------
    due : int or None
        Number of the next message; None before the first.
    holder : bytes
        Identifier of the publisher, if `judge` knows it.
    """

    def __init__(self, judge: Callable[[object, int], bool] | None = None) -> None:
        self.judge = judge
        self.due: int | None = None
        self.holder = b""

    def admit(self, number: int | None) -> bool:
        """Whether a message out of sequence may be used."""
        if number is None:  # this middleware has no sequence numbers
            return True
        if self.judge is not None and not self.judge(self, number):
            self.due = UNSURE  # the next message is judged, whatever its number
            return False
        self.due = number + 1
        return True

    def take(self) -> bytes | None:
        """The next message's bytes; None if there is none, or it must not be used."""
        raise NotImplementedError

    def messages(self) -> Iterator[bytes]:
        """Messages that have arrived, at most `MOST` and `LARGE` bytes: the others wait."""
        size = 0
        for _ in range(MOST):
            if size > LARGE or (data := self.take()) is None:
                return
            size += len(data)
            yield data


class Inbox(Sender):
    """A subscription whose raw messages are taken without an executor.

    Parameters
    ----------
    node : rclpy.node.Node
    topic : Topic
    best_effort : bool
        Request best effort only.
    judge : callable, optional
        See `Sender`.

    Attributes
    ----------
    armed : bool
        Whether the wait set contains the subscription.
    blocks : Inbox or None
        The same messages in blocks, reliably, if this inbox requests best effort.
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
        """Subscribe again, now reliably, before any message has arrived."""
        self.close(node)
        self._subscribe(node, best_effort=False)

    def close(self, node: Node) -> None:
        """Unsubscribe, also from the blocks."""
        node.destroy_subscription(self.subscription)
        self.handle = None
        if self.blocks is not None:
            self.blocks.close(node)

    def keep(self) -> None:
        """Keep the last block that was sent, and no older one."""
        while self.blocks is not None and (data := self.blocks.take()) is not None:
            self._block = data

    def missed(self, stamp: int) -> bytes | None:
        """The message of `stamp` (ns) in the last block, or None.

        Raises
        ------
        ConversionError
            The last block is not valid.
        """
        try:
            return convert.find(self._block, stamp) if self._block else None
        except convert.ConversionError as error:
            name = blocks_of(self.topic).name
            raise convert.ConversionError(error.field, error.rule, name) from None

    def take(self) -> bytes | None:
        """The next message's bytes; None if there is none, or it must not be used."""
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
        """Whether a message has arrived; it is not taken."""
        self.wait(0.0)
        return self.armed

    def wait(self, seconds: float) -> None:
        """Sleep until there is a message, at most `seconds`.

        Only this topic wakes it: waiting messages of other topics must not keep the loop spinning.
        A wait without a message removes the subscription from the wait set, and adding it again
        costs as much as the wait.
        """
        armed, self.armed = self.armed, False  # also if the wait is interrupted
        if not armed:
            self.waits.clear_entities()
            self.waits.add_subscription(self.handle)
        self.waits.wait(int(seconds * SECOND))
        self.armed = self.waits.is_ready("subscription", 0)

    @property
    def publishers(self) -> int:
        """Number of matched publishers; 0 after `close`, which the caller may not know of."""
        return int(self.handle.get_publisher_count()) if self.handle else 0


class NaiveInbox(Sender):
    """A subscription that an executor serves.

    Parameters
    ----------
    node : rclpy.node.Node
    topic : Topic
    spin : callable
        Lets the executor wait for any event, at most this many seconds.
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
        """Whether a message has arrived; it is not taken."""
        return bool(self._come)

    def wait(self, seconds: float) -> None:
        """Sleep until there is an event to serve, at most `seconds`."""
        if not self._come:
            self._spin(seconds)

    @property
    def publishers(self) -> int:
        """Number of matched publishers."""
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
        """Number of matched subscribers."""
        return int(self.publisher.handle.get_subscription_count())


class SampledOutbox(Outbox):
    """A publisher of one message a sample, which sends them again in blocks for the recorder.

    A second, reliable reader of every single message would cost more than the rest of the node's
    work; a block causes this cost once for hundreds of messages (docs/decisions/0009). A node that
    has missed a message finds it in a block, too.

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
        Sends a message that is no sample, and is not sent again in a block.
    """

    def __init__(self, node: Node, topic: Topic, path: str, size: int) -> None:
        self._size = size
        self.blocks = Outbox(node, blocks_of(topic))  # first, so that it exists before the topic
        super().__init__(node, topic, path)
        self._pending: list[bytes] = []
        self.show = self.send
        once, pending = self.send, self._pending.append

        def send(data: bytes) -> None:
            once(data)
            pending(data)

        self.send = send

    def sent(self, rows: bytes) -> None:
        """Add messages that compiled code has sent, concatenated, to the next block."""
        self._pending.append(rows)

    def flush(self) -> None:
        """Send the messages since the last call as a block."""
        if self._pending:
            if self.blocks.subscribers:
                self.blocks.send(convert.encode_block(self._size, b"".join(self._pending)))
            self._pending.clear()
