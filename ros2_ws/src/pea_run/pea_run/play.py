"""Plays a bag to the ROS graph: raw messages, recorded QoS, ``/clock``; paced by the wall clock.

Message k is due at t_0 + (its log time - start) / rate, so a late message delays no other.

Playing must not move a stage by accident. Topics that act on other nodes (`ACTS`) are played only
if the user names them. A topic that another node publishes is not played. No topic of the loop is
played while a plant runs, that is, while a node publishes ``/pea/displacement``. Both are checked
at the start and during playing.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.validate_full_topic_name import validate_full_topic_name

from pea_core.loop import LoopFault
from pea_core.params import ParameterError
from pea_core.units import SECOND
from pea_engine.pace import now
from pea_record.definitions import DefinitionError, type_hash
from pea_record.messages import Channel, Messages
from pea_ros import graph
from pea_ros.context import context
from pea_ros.shell import DELIVERY
from pea_ros.transport import message_type
from pea_wire.topics import (
    DIAGNOSTICS,
    DISPLACEMENT,
    NAMESPACE,
    PARAMETER_EVENTS,
    RECORDED_TOPICS,
    VOLTAGE,
)

PLAYER = "player"

CLOCK = "/clock"
CLOCK_TYPE = "rosgraph_msgs/msg/Clock"

CLOCK_EVERY = SECOND // 100
"""Wall time (ns) between two messages on `CLOCK`, and between two checks for other publishers."""

ACTS = (VOLTAGE.name, PARAMETER_EVENTS.name)
"""Topics that command an actuator, or report changed parameters of another node."""

SHARED = (DIAGNOSTICS.name, PARAMETER_EVENTS.name, "/rosout", "/tf", "/tf_static")
"""Topics that several nodes may publish at the same time."""

LOOK = 3.0
"""Seconds for discovery in both directions: nodes without our DDS profile need this long."""

NAMED = 1.0
"""Seconds to wait for the name of another publisher; nothing is played during this time."""

UNKNOWN = "_UNKNOWN_"
"""Part of the name that rmw gives a node before its own name is known."""

DEPTH = 10
"""History to keep if the bag has no depth."""

FOREVER = (2**31 - 1) * SECOND
"""Durations (ns) from this one on mean infinite: ROS 2 versions write infinity differently."""


def offered(profiles: Sequence[object]) -> QoSProfile:
    """QoS to offer: the recorded one. Of several, the strongest, which matches all subscribers.

    Parameters
    ----------
    profiles : sequence of rosbags' Qos
    """

    def said(field: str) -> list[Any]:
        return [getattr(profile, field) for profile in profiles]

    def kinds(field: str) -> set[int]:  # rosbags' numbers are those of ROS
        return {kind.value for kind in said(field)}

    def shortest(field: str) -> Duration:
        times = [t.sec * SECOND + t.nsec for t in said(field)]
        finite = [t for t in times if 0 < t < FOREVER]
        return Duration(nanoseconds=min(finite, default=0))

    keep_all = HistoryPolicy.KEEP_ALL in kinds("history")
    best_effort = kinds("reliability") == {ReliabilityPolicy.BEST_EFFORT}
    latched = DurabilityPolicy.TRANSIENT_LOCAL in kinds("durability")
    manual = LivelinessPolicy.MANUAL_BY_TOPIC in kinds("liveliness")
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL if keep_all else HistoryPolicy.KEEP_LAST,
        depth=max(said("depth"), default=0) or DEPTH,
        reliability=ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        deadline=shortest("deadline"),
        lifespan=shortest("lifespan"),
        liveliness=LivelinessPolicy.MANUAL_BY_TOPIC if manual else LivelinessPolicy.AUTOMATIC,
        liveliness_lease_duration=shortest("liveliness_lease_duration"),
    )


def obstacle(name: str, channel: Channel) -> str:
    """Why a topic cannot be played here; empty if it can."""
    try:
        validate_full_topic_name(name)
    except InvalidTopicNameException:
        return "is not a valid topic name"
    try:
        message_type(channel.type)
    except (ImportError, AttributeError, ValueError):
        return f"{channel.type} is not installed"
    try:
        other = bool(channel.hash) and channel.hash != type_hash(channel.type)
    except DefinitionError:  # nothing to compare with
        return ""
    return f"{channel.type} has another definition here" if other else ""


class Played(NamedTuple):
    """Result of playing once.

    Attributes
    ----------
    messages : int
        Number of published messages.
    took : float
        Wall time (s).
    late : float
        Largest delay of a message (s).
    """

    messages: int
    took: float
    late: float


class Player:
    """A node with a publisher for each topic that is played.

    Parameters
    ----------
    bag : Messages
    topics : collection of str
        Topics of the bag to play.
    force : bool
        Play even if other nodes publish these topics.
    namespace : str
        Replaces the default namespace in the names of topics.
    """

    def __init__(
        self, bag: Messages, topics: Collection[str], force: bool, namespace: str = NAMESPACE
    ) -> None:
        self.bag = bag
        self.namespace = namespace
        self.node = Node(
            PLAYER,
            namespace=namespace,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
        )
        self.publishers = {
            name: self._publisher(name, channel.type, offered(channel.qos))
            for name, channel in bag.channels.items()
            if name in topics
        }
        self._clock = self._publisher(CLOCK, CLOCK_TYPE, QoSProfile(depth=1))
        self._tick = message_type(CLOCK_TYPE)()
        watched = {CLOCK, *topics}.difference(SHARED)
        if not watched.isdisjoint(topic.name for topic in RECORDED_TOPICS):
            watched.add(DISPLACEMENT.name)
        self._watched = (
            {} if force else {n: int(n == CLOCK or n in topics) for n in sorted(watched)}
        )

    def _publisher(self, name: str, kind: str, qos: QoSProfile) -> Any:
        return self.node.create_publisher(message_type(kind), self.full_name(name), qos)

    def full_name(self, topic: str) -> str:
        """Name on the graph of a recorded topic."""
        head, inside, rest = topic.partition(f"{NAMESPACE}/")
        return f"{self.namespace}/{rest}" if inside and not head else topic

    def others(self) -> str:
        """Other publishers of the watched topics; empty if there are none."""
        for name, ours in self._watched.items():
            there = self.full_name(name)
            if self.node.count_publishers(there) > ours:
                return f"{there} is published by {', '.join(self._publishers_of(there))}"
        return ""

    def _publishers_of(self, name: str) -> list[str]:
        """Other nodes that publish a topic; their names may be known later than the endpoints."""
        end = time.monotonic() + NAMED
        while True:
            told = self.node.get_publishers_info_by_topic(name)
            nodes = {f"{one.node_namespace.rstrip('/')}/{one.node_name}" for one in told}
            others = {node for node in nodes if UNKNOWN not in node}
            others.discard(self.node.get_fully_qualified_name())
            if others or time.monotonic() > end:
                return sorted(others) or ["another node"]
            time.sleep(0.02)

    def look(self, wait: bool) -> None:
        """Wait for discovery, and, if `wait`, for a first subscriber.

        Raises
        ------
        ParameterError
            Another node publishes a topic that would be played.
        """
        end = time.monotonic() + LOOK
        while time.monotonic() < end or (wait and not self._heard()):
            if others := self.others():
                raise ParameterError(
                    f"{others}: a recording over live signals may move a stage; end that, "
                    "take another ROS_DOMAIN_ID, or give --force"
                )
            time.sleep(0.02)

    def _heard(self) -> bool:
        return any(p.get_subscription_count() for p in self.publishers.values())

    def play(self, rate: float, start: int, end: int, tell: Callable[[int], None]) -> Played:
        """Play once the messages in [start, end) of log time (ns).

        Parameters
        ----------
        rate : float
            Seconds of the recording in a second of wall time.
        start, end : int
        tell : callable
            Called every `CLOCK_EVERY` with the log time (ns) that is reached.

        Raises
        ------
        LoopFault
            Another node has begun to publish.
        """
        publish = {name: publisher.publish for name, publisher in self.publishers.items()}
        count = late = 0
        begun = tick = now()

        def clock(limit: int) -> None:
            nonlocal tick
            if others := self.others():
                raise LoopFault(f"{others}: playing has ended")
            reached = min(start + int((now() - begun) * rate), limit)
            self._tick.clock.sec, self._tick.clock.nanosec = divmod(reached, SECOND)
            self._clock.publish(self._tick)
            tell(reached)
            tick = now() + CLOCK_EVERY

        clock(start)
        for stamp, name, data in self.bag.between(publish, start, end):
            due = begun + int((stamp - start) / rate)
            while True:
                t = now()
                if t >= tick:
                    clock(stamp)
                    continue
                if t >= due:
                    break
                time.sleep((min(due, tick) - t) / SECOND)
            late = max(late, t - due)
            publish[name](data)
            count += 1
        last = begun + int((end - start) / rate)
        while (t := now()) < last:
            if t >= tick:
                clock(end)
            time.sleep((min(last, max(tick, t)) - t) / SECOND)
        clock(end)
        return Played(count, (now() - begun) / SECOND, late / SECOND)

    def deliver(self) -> None:
        """Wait until every reliable subscriber has got all messages, at most `DELIVERY` seconds."""
        end = time.monotonic() + DELIVERY
        for publisher in self.publishers.values():
            while not publisher.wait_for_all_acked(Duration(seconds=0.1)):
                if time.monotonic() > end:
                    return


@contextmanager
def player(
    bag: Messages, topics: Collection[str], force: bool, namespace: str = NAMESPACE
) -> Iterator[Player]:
    """A player on the graph, removed from it afterwards."""
    graph.check_domain()
    with context():
        yield Player(bag, topics, force, namespace)
