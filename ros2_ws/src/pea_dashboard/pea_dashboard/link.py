"""The dashboard's ROS side: it listens, it asks, and the loop never waits for it.

Samples come in blocks, reliably: a busy machine would lose some else. A publisher keeps the last
ones for us and never waits, so a dashboard that hangs holds nothing up. A topic without blocks is
a foreign node's and is taken message by message.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from pea_core.axes import AXES_MAX, POINT
from pea_core.config import AXIS, NODES, own_of
from pea_core.params import ParameterError, Value
from pea_core.signals import columns_of
from pea_core.units import NS
from pea_dashboard.foreign import plain
from pea_dashboard.trace import ALONG, SHOWN, Trace, path
from pea_dashboard.truth import Effect
from pea_ros.context import context
from pea_ros.param_client import AUTHOR, Client
from pea_ros.shell import PARTICIPANT
from pea_ros.transport import message_type, qos
from pea_wire import convert, events
from pea_wire.convert import ConversionError
from pea_wire.topics import (
    DIAGNOSTICS,
    FOLLOWED,
    LOOP,
    NAMESPACE,
    PARAMETER_EVENTS,
    RECORDED,
    REFERENCE,
    SAMPLED,
    STATE,
    VOLTAGE,
    Topic,
    blocks_of,
)

NAME = "dashboard"
"""Name of the node that asks: it goes with every change."""

LISTENER = "dashboard_listener"
STOPPER = "dashboard_stop"
"""Names of the nodes that listen, and that ask for the emergency stop."""

LOOK_EVERY = 0.5
"""Seconds between two looks at the graph."""

SUBJECTS = 64
"""Diagnostics remembered, the newest of each name."""

EFFECTS = 10_000
"""Changes of parameters remembered for a run."""

LOOP_TIME = 10**17
"""Stamps (ns) below it are of loop time; beyond it a node has told the time of day."""

PATIENCE = 3.0
"""Seconds that a node has to answer."""

READ = {
    topic.relative: (
        topic,
        {c.name: c.field for c in columns_of(topic.relative) if c.name in SHOWN},
    )
    for topic in SAMPLED
}
"""Topic and fields of the signals shown of each source with a message a sample."""


class Told(NamedTuple):
    """One diagnostic.

    Attributes
    ----------
    level : int
        0 fine, 1 warning, 2 error.
    text : str
    values : dict of str to str
    at : float
        When it came (s, monotonic).
    """

    level: int
    text: str
    values: dict[str, str]
    at: float


class End(NamedTuple):
    """Who is at a topic."""

    topic: str
    publishers: tuple[str, ...]
    subscribers: tuple[str, ...]


class ParameterChange(NamedTuple):
    """Parameters of a node that have changed.

    Attributes
    ----------
    role : str
    before, after : dict
        Values that differ; before another type, all of the old one.
    author : str
        Node that has asked for it; empty where it does not say.
    at : float
        Loop time (s).
    """

    role: str
    before: dict[str, Any]
    after: dict[str, Any]
    author: str
    at: float


class Link:
    """Listens to a loop in a thread of its own.

    Parameters
    ----------
    trace : Trace
        Gets the samples.
    changed : callable
        Told every `ParameterChange`.
    namespace : str
        Of the loop.

    Attributes
    ----------
    values : dict of str to dict
        Parameters of each node of the loop that has told them.
    began : dict of str to dict
        The same, as each node has told them first.
    effects : list of Effect
        What has become of them since, sample by sample.
    diagnostics : dict of str to Told
        By name.
    nodes : list of str
        Full names of all nodes in the graph but our own.
    ends : list of End
        Who is at the loop's topics.
    recorded : int
        Samples recorded, in distributed mode; -1 where no recorder says.
    recorded_at : float
        When that came (s, monotonic).
    trouble : str
        What the middleware has against being looked at; empty: nothing.
    axes : tuple of str
        Of the loop, as its messages name them; empty while nothing has come.
    path : Trace or None
        What all axes shall do and do, see `trace.path`; None: there is one.
    axis : str
        The one that shall be looked at, with its signals and parameters; see `looked_at`.
    refused : str
        The last message that could not be used, and why; empty: none in this run.
    """

    axes: tuple[str, ...] = ()
    path: Trace | None = None
    axis = ""

    def __init__(
        self, trace: Trace, changed: Callable[[ParameterChange], None], namespace: str = NAMESPACE
    ) -> None:
        self.namespace = namespace
        self.trace = trace
        self.changed = changed
        self.forget()
        self._graph = contextlib.ExitStack()
        self._graph.enter_context(context())
        options = {"namespace": namespace, "use_global_arguments": False}
        self.node = Node(LISTENER, start_parameter_services=False, **options)
        self.asker = Node(NAME, start_parameter_services=False, **options)
        self.client = Client(self.asker, PATIENCE)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self._singles: dict[Topic, Any] = {}
        self._asking = threading.Lock()
        self.stale: set[str] = set()
        for source, (topic, _) in READ.items():
            self._subscribe(blocks_of(topic), partial(self.block, source), reliable=True)
        self._subscribe(blocks_of(REFERENCE), self.points, reliable=True)
        self._subscribe(FOLLOWED, self.chunk, reliable=True)
        self._subscribe(RECORDED, self.progress, reliable=True)
        self._subscribe(PARAMETER_EVENTS, self.changed_by, reliable=True)
        self.node.create_subscription(
            message_type(DIAGNOSTICS.type),
            DIAGNOSTICS.name,
            partial(self.take, DIAGNOSTICS.name, self.diagnosed),
            qos(DIAGNOSTICS),
        )
        self._take_singles()
        self._ended = threading.Event()
        self._threads = [
            threading.Thread(target=self._listen, name="listener", daemon=True),
            threading.Thread(target=self._watch, name="watcher", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def forget(self) -> None:
        """Forget what was told of a run."""
        self.values: dict[str, dict[str, Value]] = {}
        self.began: dict[str, dict[str, Value]] = {}
        self.effects: list[Effect] = []
        self.diagnostics: dict[str, Told] = {}
        self.nodes: list[str] = []
        self.ends: list[End] = []
        self.recorded, self.recorded_at = -1, 0.0
        self.trouble = self.refused = ""

    @property
    def there(self) -> list[str]:
        """Blocks of the loop whose nodes are there: they publish.

        The middleware keeps the name of a node now and then that has ended, for good.
        """
        publishers = {end.topic: end.publishers for end in self.ends}
        says = {topic.publisher: topic.at(self.namespace) for topic in LOOP}
        return [role for role in NODES if role in publishers.get(says[role], ())]

    def close(self) -> None:
        """Leave the graph."""
        self._ended.set()
        for thread in self._threads:
            thread.join(PATIENCE)
        self.executor.shutdown()
        self._graph.close()

    def set(self, role: str, values: Mapping[str, object]) -> None:
        """Set parameters of a node, all together between two samples.

        Raises
        ------
        ParameterError
            It refuses, or is not there.
        """
        if self.several:
            values = {f"{self.looked_at}.{name}": value for name, value in values.items()}
        with self._asking:
            self.client.set(role, values)

    @property
    def several(self) -> bool:
        """Whether the loop has several axes."""
        return len(self.axes) > 1

    @property
    def looked_at(self) -> str:
        """The axis that is looked at: the one asked for, else x, else the first."""
        if self.axis in self.axes:
            return self.axis
        return AXIS if AXIS in self.axes or not self.axes else self.axes[0]

    def look_at(self, axis: str) -> None:
        """Look at another axis: what was shown of the one before is forgotten."""
        self.axis = axis
        self.trace.clear()
        self.values, self.began, self.effects = {}, {}, []

    def clear(self) -> None:
        """Forget the samples of all axes."""
        self.trace.clear()
        if self.path is not None:
            self.path.clear()

    def name_axes(self, axes: tuple[str, ...]) -> None:
        """Set the names of the axes, as a message or a node reports them."""
        if axes != self.axes:
            self.path = path(axes) if 1 < len(axes) <= AXES_MAX else None
            self.axes = axes

    def _put(self, source: str, stamps: np.ndarray, values: Mapping[str, np.ndarray]) -> None:
        """Take samples of all axes, an axis a column, or of the only one."""
        own = values
        if self.several:
            i = self.axes.index(self.looked_at)
            own = {name: each[:, i] for name, each in values.items()}
        self.trace.put(source, stamps, own)
        if self.path is not None and source in ALONG:
            columns = values[ALONG[source]].T
            self.path.put(source, stamps, dict(zip(self.path.sources[source], columns)))

    def _forms(self, message: bytes, trajectory: bool = False) -> convert.Forms:
        """Codecs of the axes that a message names."""
        self.name_axes(convert.axes_of(message, trajectory))
        return convert.forms(self.axes)

    # Listening

    def _subscribe(
        self, topic: Topic, take: Callable[[bytes], None], reliable: bool = False
    ) -> Any:
        name = topic.at(self.namespace)
        return self.node.create_subscription(
            message_type(topic.type),
            name,
            partial(self.take, name, take),
            qos(topic, not reliable),
            raw=True,
        )

    def take(self, topic: str, take: Callable[[Any], None], message: Any) -> None:
        """Use a message, or say why it cannot be used: it may be anybody's."""
        try:
            take(message)
        except Exception as error:
            self.refused = plain(f"a message of {topic} is not used: {error}")

    def _listen(self) -> None:
        while not self._ended.is_set():
            try:
                self.executor.spin_once(timeout_sec=0.1)
            except Exception as error:  # what cannot even be decoded
                self.refused = plain(f"a message is not used: {error}")

    def block(self, source: str, data: bytes) -> None:
        """Many messages of a topic."""
        size, payload = convert.decode_block(data)
        topic, fields = READ[source]
        codecs = self._forms(payload[:size]).codecs[topic]
        codec = codecs[size == codecs[1].size]
        if size != codec.size:
            raise ConversionError("layout", f"messages of {size} bytes: must have {codec.size}")
        rows = np.frombuffer(payload, codec.dtype)
        values = {name: rows[field] for name, field in fields.items()}
        self._put(source, convert.stamps(payload, size), values)

    def one(self, source: str, data: bytes) -> None:
        """One message of a topic."""
        topic, fields = READ[source]
        found = self._forms(data).codecs[topic][0].decode(data)
        values = {name: np.array([getattr(found, field)]) for name, field in fields.items()}
        self._put(source, np.array([found.stamp]), values)

    def points(self, data: bytes) -> None:
        """Many messages of the reference, of one point each."""
        size, payload = convert.decode_block(data)
        w = self._forms(payload[:size], trajectory=True).reference.decode_each(payload)
        self._put("reference", convert.stamps(payload, size), {"w": w})

    def chunk(self, data: bytes) -> None:
        """Points of the reference; a single one is what a loop in one process shows."""
        stamp, times, points = self._forms(data, trajectory=True).reference.decode(data)
        if len(points) > 1:
            w = points[:, ::POINT] if self.several else points[:, 0]
            self._put("reference", stamp + times, {"w": w})

    def progress(self, data: bytes) -> None:
        """Take the time up to which the recorder has recorded."""
        if self.trace.T_ns:
            self.recorded = convert.decode_time(data) // self.trace.T_ns
            self.recorded_at = time.monotonic()

    def diagnosed(self, message: Any) -> None:
        """Take the diagnostics of one node."""
        for status in message.status[:SUBJECTS]:
            values = {plain(pair.key): plain(pair.value) for pair in status.values[:SUBJECTS]}
            level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
            name = plain(status.name.removeprefix("pea: "))
            told = Told(level, plain(status.message), values, time.monotonic())
            others = [(n, each) for n, each in self.diagnostics.items() if n != name]
            self.diagnostics = {**dict(others[1 - SUBJECTS :]), name: told}

    def changed_by(self, data: bytes) -> None:
        """A node tells that parameters of it have changed."""
        event = events.decode(data)
        role = event.node.removeprefix(f"{self.namespace.rstrip('/')}/")
        known = self.values.get(role)
        if known is None:
            return
        told = {n: v for n, v in (event.new | event.changed).items() if v is not None}
        told = own_of(self.axes or (AXIS,), self.looked_at, told)
        author = plain(told.pop(AUTHOR, ""))
        T_ns = self.trace.T_ns
        asked = own_of(self.axes or (AXIS,), self.looked_at, event.asked)
        if asked and 0 <= event.stamp < LOOP_TIME and T_ns:
            effect = Effect(-(-event.stamp // T_ns), role, asked)
            self.effects = [*self.effects, effect][-EFFECTS:]
        after = {name: value for name, value in told.items() if known.get(name) != value}
        another = "type" in after
        if not another:
            _like(event.node, known, after, bool(event.changed))
        if not after:
            return
        before = known if another else {n: known[n] for n in after if n in known}
        self.values[role] = {**known, **after}
        if not event.changed:  # what another type has besides
            return
        self.changed(ParameterChange(role, before, after, author, self.trace.end * T_ns * NS))
        if another:  # another type has other parameters
            self.stale.add(role)

    # Watching

    def _watch(self) -> None:
        """Look at the graph now and then."""
        while not self._ended.wait(LOOK_EVERY):
            try:
                self._look()
                self.trouble = ""
            except Exception as error:  # of the middleware: it may be better next time
                self.trouble = f"{type(error).__name__}: {error}"

    def _look(self) -> None:
        """See who is there, and ask nodes that have come for their parameters."""
        before = self.there
        names = self.node.get_node_names_and_namespaces()
        ours = (NAME, LISTENER, STOPPER)
        found = [plain(f"{space.rstrip('/')}/{name}") for name, space in names if name not in ours]
        self.nodes = sorted(set(found))
        self.ends = [self._end(topic) for topic in LOOP]
        if "plant" in self.there and "plant" not in before:
            self.values, self.began, self.effects = {}, {}, []
            self.diagnostics = {}
            self.recorded, self.recorded_at, self.refused = -1, 0.0, ""
        self._take_singles()
        for role in self.there:
            if role not in self.values or role in self.stale:
                self.stale.discard(role)
                self._ask(role)
        for role in [role for role in self.values if role not in self.there]:
            self.values.pop(role, None)

    def _ask(self, role: str) -> None:
        try:
            with self._asking:
                values = self.client.get(role)
        except ParameterError:
            return
        axes: Any = values.get("axes") or (AXIS,)
        self.name_axes(tuple(axes))
        if self.axis not in ("", *self.axes):
            self.refused = f"no axis {plain(self.axis)}: {self.looked_at} is shown"
        values = own_of(self.axes, self.looked_at, values)
        self.values[role] = values
        self.began.setdefault(role, values)

    def _end(self, topic: Topic) -> End:
        node, name = self.node, topic.at(self.namespace)
        sides = (
            node.get_publishers_info_by_topic(name),
            node.get_subscriptions_info_by_topic(name),
        )
        told = [sorted({plain(end.node_name) for end in side} - {LISTENER}) for side in sides]
        return End(name, tuple(told[0]), tuple(told[1]))

    def _take_singles(self) -> None:
        """Subscribe to topics themselves where no blocks of them come.

        Those of foreign nodes, and the reference where no controller passes it on.
        """
        takes = {topic: partial(self.one, name) for name, (topic, _) in READ.items()}
        for topic, take in (takes | {REFERENCE: self.chunk}).items():
            ahead = topic == REFERENCE
            there = self._unrelayed() if ahead else self.node.count_publishers(self._name(topic))
            wanted = there and not self.node.count_publishers(self._name(blocks_of(topic)))
            if wanted and topic not in self._singles:
                self._singles[topic] = self._subscribe(topic, take, reliable=ahead)
            elif not wanted and topic in self._singles:
                self.node.destroy_subscription(self._singles.pop(topic))

    def _name(self, topic: Topic) -> str:
        return topic.at(self.namespace)

    def _unrelayed(self) -> bool:
        """Whether the reference comes from a recording, or goes to a foreign controller."""
        if self.node.count_publishers(self._name(FOLLOWED)):
            return False
        of_reference, of_state = (
            {bytes(end.endpoint_gid[:PARTICIPANT]) for end in ends}
            for ends in map(
                self.node.get_publishers_info_by_topic, map(self._name, (REFERENCE, STATE))
            )
        )
        played = not of_reference.isdisjoint(of_state)
        return played or bool(self.node.count_publishers(self._name(VOLTAGE)))


def _like(
    node: str, known: Mapping[str, object], after: Mapping[str, object], of_known: bool
) -> None:
    """See that what a node says has changed is what it had before.

    Raises
    ------
    ConversionError
        A parameter has another kind of value now, or is new.
    """
    for name, value in after.items():
        if name not in known and (of_known or len(known) > SUBJECTS * 4):
            raise ConversionError(name, f"{node} has no such parameter")
        if name in known and type(known[name]) is not type(value):
            raise ConversionError(
                name, f"{value!r} of {node}: must be of the type that it was before"
            )
