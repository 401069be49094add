"""A node that serves between samples: its inboxes and outboxes, its neighbours, its process."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.duration import Duration
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.time import Time

from pea_core.entry import FAILED, line_of
from pea_core.interrupt import INTERRUPT
from pea_core.loop import LoopFault
from pea_core.params import ParameterError
from pea_core.printable import printable
from pea_engine import pace
from pea_ros.context import context, serve_once
from pea_ros.neighbours import Remote
from pea_ros.path_choice import path_for
from pea_ros.paths import NAIVE, PROGRESS
from pea_ros.publishers import PATIENCE, Publishers
from pea_ros.transport import (
    Inbox,
    NaiveInbox,
    Outbox,
    SampledOutbox,
    full_name,
    publishers_of,
    qos,
    subscriptions_of,
)
from pea_wire import diagnostics
from pea_wire.convert import ConversionError
from pea_wire.topics import (
    DIAGNOSTICS,
    FOLLOWED,
    NAMESPACE,
    RECORDED,
    RECORDED_TOPICS,
    REFERENCE,
    SAMPLED,
    SAYS,
    VOLTAGE,
    Topic,
    blocks_of,
)

Read = TypeVar("Read")

SERVE_EVERY = 0.02
"""Seconds between two looks at parameters and services."""

LOOK_EVERY = 0.2
"""Seconds between two looks by the executor, where nothing has come."""

DIAGNOSE_EVERY = 1.0
"""Seconds between two diagnostics."""

SILENCE = 2.0
"""Seconds without a message after which a node says so."""

SETTLE = 0.5
"""Seconds that all must have been there before the loop starts, where nobody has counted them."""

PLANT = "plant"

UNSEEN = 2.0
"""Seconds with a sample after which a plant is taken as there: the graph may never tell of it."""

SERVED = 3.0
"""Seconds until the parameters of a node that is there are served."""

ANSWER = 20.0
"""Seconds that it has to answer: it may be compiling."""

AGAIN = 2.0
"""Seconds after which it is asked again: an answer to who is not known there yet is lost."""

DELIVERY = 5.0
"""Seconds that subscribers have to take what was sent last, on all topics together."""


PARTICIPANT = 12
"""Bytes of an endpoint's DDS identifier (GUID) that are its participant's."""


def _processes(ends: Sequence[Any]) -> set[bytes]:
    """Participants that some endpoints belong to."""
    return {bytes(end.endpoint_gid[:PARTICIPANT]) for end in ends}


class Given(Node):
    """A node whose parameter events are stamped with loop time from the first on.

    It takes an empty list from a parameter file: to rclpy it is no value at all.
    """

    def declare_parameters(self, namespace: str, parameters: Any, *args: Any, **more: Any) -> Any:
        """Declare those that have a value; the block declares the others."""
        self.get_clock()._set_ros_time_is_active(True)  # rclpy has set the node to system time
        for name in [n for n, each in self._parameter_overrides.items() if each.value is None]:
            del self._parameter_overrides[name]
        kept = [each for each in parameters if len(each) < 2 or each[1] is not None]
        return super().declare_parameters(namespace, kept, *args, **more)


class Shell:
    """A node with inboxes and outboxes, its start, its waiting, its end.

    Parameters
    ----------
    name : str
        Node name, under `NAMESPACE` where nobody gives another.
    allow_undeclared : bool
        Parameters may be set that are not declared: the block then says what it knows.
    """

    def __init__(self, name: str, allow_undeclared: bool = False) -> None:
        self.name = name
        self.node = Given(
            name,
            namespace=NAMESPACE,
            allow_undeclared_parameters=allow_undeclared,
            automatically_declare_parameters_from_overrides=True,
        )
        self.namespace = self.node.get_namespace().rstrip("/")
        if self.node.get_name() != name:
            raise ParameterError(
                f"__node:={self.node.get_name()}: its neighbours know the node as {name}; to run "
                "two, give each a namespace: -r __ns:=/stage1"
            )
        self.space = self.namespace.strip("/") or "/"
        self.log = self.node.get_logger()
        self.clock = self.node.get_clock()
        self.clock._set_ros_time_is_active(True)
        self.k = self.lost_samples = 0
        self.path = NAIVE
        self.inboxes: list[Inbox | NaiveInbox] = []
        self.outboxes: list[Outbox] = []
        self.following: Inbox | NaiveInbox | None = None
        self.awaited: list[Topic] = []
        self.publishers = Publishers(self.node)
        self.met = False
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._diagnostics = self.node.create_publisher(
            DiagnosticArray, DIAGNOSTICS.relative, qos(DIAGNOSTICS)
        )
        self._serve_at = 0.0
        self._look_at = 0.0
        self._serving = False
        self.begun = False
        self._diagnose_at = 0.0
        self._diagnosed = (time.monotonic(), 0)

    def say(self, text: str) -> None:
        """Log a line, while there is somebody to log to."""
        if rclpy.ok():
            self.log.info(text)

    def choose_path(self, samples: int) -> None:
        """Choose how samples travel, before the first inbox is made; say which way and why."""
        self.path, why = path_for(self.node, samples)
        self.log.info(f"transport: {self.path} ({why})")

    def inbox(self, topic: Topic) -> Any:
        """Subscribe to a topic."""
        judge = self.judge if topic.publisher else None
        if self.path == NAIVE:
            inbox: Inbox | NaiveInbox = NaiveInbox(self.node, topic, self._spin, judge)
        else:
            inbox = Inbox(self.node, topic, topic in SAMPLED, judge)
        self.inboxes.append(inbox)
        return inbox

    def outbox(self, topic: Topic, size: int = 0) -> Any:
        """Publish a topic; one that is sampled has messages of equal `size` (bytes)."""
        if topic in SAMPLED:
            outbox: Outbox = SampledOutbox(self.node, topic, self.path, size)
        else:
            outbox = Outbox(self.node, topic, self.path)
        self.outboxes.append(outbox)
        return outbox

    def read(self, topic: Topic, decode: Callable[[bytes], Read], data: bytes) -> Read:
        """Decode a message of a topic.

        Raises
        ------
        ConversionError
            It does not hold what the topic promises; topic, field and rule are named.
        """
        try:
            return decode(data)
        except ConversionError as error:
            raise ConversionError(error.field, error.rule, self.full_name(topic)) from None

    def judge(self, inbox: Inbox | NaiveInbox, number: int) -> bool:
        """Whether a message out of sequence may be used; if not, serve at once: it says why."""
        fine = self.publishers.judge(inbox, number)
        if not fine:
            self._serve_at = 0.0
        return fine

    @property
    def watched(self) -> list[Inbox | NaiveInbox]:
        """Every inbox, those of blocks too."""
        blocks = [inbox.blocks for inbox in self.inboxes if isinstance(inbox, Inbox)]
        return [*self.inboxes, *(inbox for inbox in blocks if inbox is not None)]

    def intruder(self, every: bool = False) -> str:
        """Name all publishers of a topic that has more than one; else empty.

        `every`: look at all topics that the node oversees, instead of at one in turn.
        """
        return self.publishers.intruder(self.watched, every)

    def intruded(self, text: str) -> None:
        """Take note of a topic with more than one publisher while the loop runs.

        Raises
        ------
        LoopFault
            The loop cannot go on.
        """
        raise LoopFault(text)

    @INTERRUPT.held()
    def _spin(self, seconds: float) -> None:
        serve_once(self._executor, seconds, self.log.warning)

    @INTERRUPT.held()
    def serve(self, wait: float = 0.0) -> None:
        """Serve parameters and services, for so many seconds; do what else is due."""
        for _ in self.chores(wait):
            pass

    def chores(self, wait: float = 0.0) -> Iterator[None]:
        """Do what is due piece by piece: requests, blocks, diagnostics, a look at publishers."""
        self.answer(wait)
        for outbox in self.outboxes:
            if isinstance(outbox, SampledOutbox):
                yield
                outbox.flush()
        yield
        for inbox in self.inboxes:
            if isinstance(inbox, Inbox):
                inbox.keep()
        now = time.monotonic()
        if now >= self._diagnose_at:
            yield
            self._diagnose_at = now + DIAGNOSE_EVERY
            self._diagnose(now)
        yield from self.lookout()

    def lookout(self) -> Iterator[None]:
        """Look whether each topic has one publisher, piece by piece."""
        yield
        if self.met and (text := self.intruder()):
            self.intruded(text)

    def answer(self, wait: float) -> None:
        """Let the executor answer requests, if there are any; what it sends has loop time."""
        now = time.monotonic()
        if not self._serving:  # else a request is being answered, and the loop goes on
            asked = wait > 0.0 or self._asked()
            if asked or now >= self._look_at:
                self.tell_time()
                self._serving = True
                try:
                    serve_once(self._executor, wait, self.log.warning)
                finally:
                    self._serving = False
                now = time.monotonic()
                self._look_at = now + (0.0 if asked else LOOK_EVERY)
        self._serve_at = now + SERVE_EVERY

    def _asked(self) -> bool:
        """Whether a request or an answer has come: an executor's look is ten times as dear."""
        if self.path == NAIVE:
            return True
        node = self.node
        heard = [s for s in node.subscriptions if s.callback_group.can_execute(s)]
        services, clients = list(node.services), list(node.clients)
        waits = rclpy_implementation.WaitSet(
            len(heard), 0, 0, len(clients), len(services), 0, node.context.handle
        )
        waits.clear_entities()
        for add, entities in (
            (waits.add_subscription, heard),
            (waits.add_client, clients),
            (waits.add_service, services),
        ):
            for entity in entities:
                add(entity.handle)
        waits.wait(0)
        kinds = ("subscription", "client", "service")
        return any(waits.get_ready_entities(kind) for kind in kinds)

    def tell_time(self) -> None:
        """Set the node's clock to loop time."""
        self.clock.set_ros_time_override(Time(nanoseconds=self.stamp))

    def _diagnose(self, now: float) -> None:
        then, k = self._diagnosed
        self._diagnosed = (now, self.k)
        if self.k and self.name == PLANT and (told := os.environ.get(PROGRESS)):
            with contextlib.suppress(OSError), open(told, "w") as file:
                file.write(str(self.k))
        rate = (self.k - k) / max(now - then, 1e-9)
        values = {
            "samples": self.k,
            "rate_hz": round(rate, 1),
            "lost_samples": self.lost_samples,
        }
        text = "running" if self.k else "waiting"
        self._diagnostics.publish(
            diagnostics.encode(self.stamp, self.name, diagnostics.OK, text, values, self.space)
        )

    @property
    def stamp(self) -> int:
        """Loop time (ns) of the current sample."""
        return 0

    def wait(self, inbox: Inbox | NaiveInbox, seconds: float) -> None:
        """Sleep until a message comes to `inbox`, at most so long; serve what is due."""
        inbox.wait(seconds)
        if time.monotonic() >= self._serve_at:
            self.serve()

    def missing(self, with_recorder: bool) -> list[str]:
        """What this node waits for: one line a missing neighbour.

        Raises
        ------
        ParameterError
            Another node publishes what this one is to publish, and stays.
        """
        lacking = []
        if text := self.publishers.beside(outbox.topic for outbox in self.outboxes):
            if self.publishers.stay:
                raise ParameterError(text)
            lacking.append(text)
        elif text := self.intruder():
            lacking.append(text)
        self._choose_reference()
        recorders = self._who(RECORDED)
        recorder = with_recorder or bool(recorders)
        for outbox in self.outboxes:
            topic, name = outbox.topic, self.full_name(outbox.topic)
            deaf = [role for role in topic.subscribers if not self._hearing(topic, role)]
            if self.begun:
                deaf = [role for role in deaf if role != PLANT]
            if deaf:
                lacking.append(f"{' and '.join(deaf)} (subscriber of {name})")
            elif (
                recorder
                and (heard := self._recorded_on(topic))
                and not recorders & self._hears(heard)
            ):
                lacking.append(f"recorder (subscriber of {name})")
            elif outbox.subscribers < self.node.count_subscribers(name):
                lacking.append(f"{name} to connect")
        lacking += [
            f"{topic.publisher} (publisher of {self.full_name(topic)})"
            for topic in self.awaited
            if self._hears(topic) - recorders and not self._who(topic)
        ]
        for inbox in self.inboxes:
            topic = inbox.topic
            if topic == RECORDED and not recorder:
                continue
            if inbox.publishers < 1:
                lacking.append(f"{topic.publisher} (publisher of {self.full_name(topic)})")
        return lacking

    def _recorded_on(self, topic: Topic) -> Topic | None:
        """The topic that the recorder subscribes to for a topic of this node; None for none."""
        if topic in SAMPLED:
            return blocks_of(topic)
        if topic == REFERENCE:
            return topic if self._unrelayed() else None
        return topic if topic in (FOLLOWED, *RECORDED_TOPICS) else None

    def _unrelayed(self) -> bool:
        """Whether there is a controller that does not publish which reference it follows."""
        return bool(self._who(VOLTAGE)) and not self._who(FOLLOWED)

    def _choose_reference(self) -> None:
        """Subscribe to the reference itself where a foreign controller does not pass it on."""
        topic = REFERENCE if self._unrelayed() else FOLLOWED
        if self.following is not None and self.following.topic != topic:
            self.inboxes.remove(self.following)
            self.following.close(self.node)
            self.following = self.inbox(topic)

    def full_name(self, topic: Topic) -> str:
        """Name that a topic has for this node, by its namespace and remaps."""
        return full_name(self.node, topic)

    def _who(self, topic: Topic) -> set[bytes]:
        """Processes that publish a topic.

        By their DDS participant, not by name: names travel apart, and may be late or left behind.
        """
        return _processes(publishers_of(self.node, topic))

    def _hears(self, topic: Topic) -> set[bytes]:
        """Processes that subscribe to a topic."""
        return _processes(subscriptions_of(self.node, topic))

    def _hearing(self, topic: Topic, role: str) -> list[Any]:
        """Subscriptions of a neighbour to a topic, by what it publishes, or by its name.

        What it publishes may be remapped, and is not found then under the name it has here.
        """
        there = self._who(SAYS[role])
        return [
            end
            for end in subscriptions_of(self.node, topic)
            if end.node_name == role or not there.isdisjoint(_processes([end]))
        ]

    def neighbour(self, role: str) -> str:
        """Full name of a neighbour's node: of the one that this node is connected to."""
        ends = [
            *(end for each in self.outboxes for end in self._hearing_block(each.topic, role)),
            *(
                end
                for each in self.inboxes
                if each.topic.publisher == role
                for end in publishers_of(self.node, each.topic)
            ),
        ]
        names = {
            f"{end.node_namespace.rstrip('/')}/{role}" for end in ends if end.node_name == role
        }
        return names.pop() if len(names) == 1 else f"{self.namespace}/{role}"

    def _hearing_block(self, topic: Topic, role: str) -> list[Any]:
        return self._hearing(topic, role) if role in topic.subscribers else []

    def wait_for_peers(self, with_recorder: bool = False, settle: float = 0.0) -> None:
        """Serve parameters until every neighbour is there; say who is missing.

        All must be there for `settle` seconds: who has come with the last of them, a recorder
        for example, is then known, too.
        """
        said: list[str] = []
        since = begun = time.monotonic()
        while (lacking := self.missing(with_recorder)) or time.monotonic() - since < settle:
            if lacking:
                since = time.monotonic()
                if lacking != said:
                    self.log.info("waiting for " + ", ".join(lacking))
                    said = lacking
            if not lacking and self._rely():
                since = time.monotonic()
            if not self._called():
                begun = time.monotonic()
            self.begun = time.monotonic() - begun > UNSEEN
            self.serve(0.02)
        self.meet()
        self.met = True
        self.log.info("all neighbours are there")

    def _called(self) -> bool:
        """Whether a sample has come: then there is a plant, and it has found its neighbours."""
        return any(inbox.come() for inbox in self.inboxes if inbox.topic in SAMPLED)

    def meet(self) -> None:
        """Learn of the neighbours what must be known before the first sample."""

    def ask(self, role: str, names: Sequence[str] = ()) -> dict[str, Any]:
        """Values of another node's parameters, of all where none is named.

        Empty where it serves none, or does not answer in time.

        Raises
        ------
        ParameterError
            Two nodes have its name: either could answer.
        """
        name = self.neighbour(role)
        self._alone(name)
        client = Remote(self.node, name)

        def come(ready: Callable[[], bool], patience: float) -> bool:
            end = time.monotonic() + patience
            while not ready() and time.monotonic() < end:
                self.serve(0.02)
            return ready()

        def answer(call: Callable[[], Any]) -> Any:
            end = time.monotonic() + ANSWER
            asked = [call()]
            while not come(lambda: any(each.done() for each in asked), AGAIN):
                if time.monotonic() > end:
                    return None
                asked.append(call())
            return next(each.result() for each in asked if each.done())

        if not come(client.ready, SERVED):
            self.log.warning(f"{name} serves no parameters")
            return {}
        if not names:
            listed = answer(client.list_names)
            names = listed.result.names if listed else ()
        given = answer(lambda: client.get(names)) if names else None
        if given is not None and len(given.values) < len(names):
            # a node of rclpy tells nothing at all where it lacks one
            listed = answer(client.list_names)
            names = [name for name in names if listed and name in listed.result.names]
            given = answer(lambda: client.get(names)) if names else None
        if given is None:
            self.log.warning(f"{name} does not report its parameters")
            return {}
        told = {
            name: parameter_value_to_python(value)
            for name, value in zip(names, given.values)
            if value.type
        }
        return {n: list(v) if hasattr(v, "tolist") else v for n, v in told.items()}

    def _alone(self, name: str) -> None:
        """See that one node has a name; a second one of ours ends by itself."""
        end = time.monotonic() + PATIENCE
        while len(same := [p for p in self.publishers.of(DIAGNOSTICS) if p.name == name]) > 1:
            if time.monotonic() > end:
                raise ParameterError(
                    f"{' and '.join(map(str, same))}: either may answer for its parameters; give "
                    "each stage a namespace: -r __ns:=/stage1"
                )
            self.serve(0.02)

    def ours(self, topic: Topic) -> bool:
        """Whether a sampled topic comes from a node of this project: it sends blocks as well."""
        return bool(self.node.count_publishers(self.full_name(blocks_of(topic))))

    def _rely(self) -> bool:
        """Ask reliability of a neighbour that would not send a sample again; whether one is new."""
        new = False
        for inbox in self.inboxes:
            if isinstance(inbox, Inbox) and inbox.best_effort and not self.ours(inbox.topic):
                self.log.info(f"{self.full_name(inbox.topic)} comes from a foreign node: reliable")
                inbox.rely(self.node)
                new = True
        return new

    def deliver(self) -> None:
        """See that every reliable subscriber has what was sent, before this process ends."""
        publishers = []
        for outbox in self.outboxes:
            publishers.append(outbox.publisher)
            if isinstance(outbox, SampledOutbox):
                outbox.flush()
                publishers.append(outbox.blocks.publisher)
        end = time.monotonic() + DELIVERY
        for publisher in publishers:
            left = max(end - time.monotonic(), 0.0)
            publisher.wait_for_all_acked(Duration(seconds=left))

    def close(self) -> None:
        """Give back what the middleware holds."""
        with pace.ordinary():
            self._executor.shutdown()
            self.node.destroy_node()


def run(make: Callable[[], object], name: str, args: list[str] | None = None) -> None:
    """Run a node's process to its end: the ``main`` of every node.

    Exits with status 0 when done or interrupted, 2 for bad input, 3 when the loop failed.
    """
    status = 0
    signal.signal(signal.SIGINT, INTERRUPT)  # before rclpy's own, which passes signals on
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # rclpy's own takes it: nothing is passed on
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT,))
    try:
        with context(args, signals=True):
            try:
                _live(make)
            except rclpy_implementation.RCLError:
                if rclpy.ok():  # else an interrupt has taken the middleware away
                    raise
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (ParameterError, InvalidParameterTypeException) as error:
        print(f"{name}: {error}", file=sys.stderr)
        status = 2
    except (LoopFault, ConversionError) as error:
        print(f"{name}: {error}", file=sys.stderr)
        status = 3
    except rclpy_implementation.RCLError as error:
        print(f"{name}: {' '.join(str(error).split())}", file=sys.stderr)
        status = 3
    except Exception as error:
        line = line_of(error)
        if line is None:
            raise
        print(f"{name}: {printable(line)}", file=sys.stderr)
        status = FAILED
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # else one that comes now ends it with another
    sys.exit(status)


def _live(make: Callable[[], Any]) -> None:
    with INTERRUPT.held():
        shell = make()
    try:
        shell.run()
    finally:
        with INTERRUPT.held(), contextlib.suppress(Exception):
            shell.close()
