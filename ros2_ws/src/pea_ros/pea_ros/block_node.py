"""The shell round a block: one process, one node, messages in, messages out.

The hot path waits on one reused wait set and takes raw bytes; parameters, services and
diagnostics are served between samples, so a change is effective between two of them.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.duration import Duration
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.time import Time

from pea_core import pace
from pea_core.interrupt import INTERRUPT
from pea_core.loop import LoopFault
from pea_core.params import ParameterError, Schema, build, param, specs
from pea_ros import params as ros_params
from pea_ros.context import context
from pea_ros.convert import ConversionError
from pea_ros.paths import FAST, NAIVE, TURBO, chosen
from pea_ros.topics import (
    DIAGNOSTICS,
    DISPLACEMENT,
    NAMESPACE,
    RECORDED_TOPICS,
    RECORDER,
    SAMPLED,
    SAYS,
    Topic,
    blocks_of,
)
from pea_ros.transport import (
    Inbox,
    NaiveInbox,
    Outbox,
    SampledOutbox,
    compiles,
    path_for,
    qos,
)

SERVE_EVERY = 0.02
"""Seconds between two looks at parameters and services."""

LOOK_EVERY = 0.2
"""Seconds between two looks by the executor, where nothing has come."""

PAUSE = 0.002
"""Seconds between two looks at whether slow work beside the loop is done."""

DIAGNOSE_EVERY = 1.0
"""Seconds between two diagnostics."""

SILENCE = 2.0
"""Seconds without a message after which a node says so."""

SETTLE = 0.5
"""Seconds that all must have been there before the loop starts, where nobody has counted them."""

SERVED = 3.0
"""Seconds until the parameters of a node that is there are served."""

ANSWER = 20.0
"""Seconds that it has to answer: it may be compiling."""

DELIVERY = 5.0
"""Seconds that subscribers have to take what was sent last, on all topics together."""


def environment() -> None:
    """Keep discovery on this machine unless the user asks for more."""
    if not os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE"):
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"


class Shell:
    """A node with inboxes and outboxes, its start, its waiting, its end.

    Parameters
    ----------
    name : str
        Node name under `NAMESPACE`.
    allow_undeclared : bool
        Parameters may be set that are not declared: the block then says what it knows.
    """

    def __init__(self, name: str, allow_undeclared: bool = False) -> None:
        self.name = name
        self.node = Node(
            name,
            namespace=NAMESPACE,
            allow_undeclared_parameters=allow_undeclared,
            automatically_declare_parameters_from_overrides=True,
        )
        self.log = self.node.get_logger()
        self.clock = self.node.get_clock()
        self.clock._set_ros_time_is_active(True)  # parameter events are stamped with loop time
        self.k = self.lost_samples = 0
        self.path = NAIVE
        self.inboxes: list[Inbox | NaiveInbox] = []
        self.outboxes: list[Outbox] = []
        self.awaited: list[Topic] = []
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._diagnostics = self.node.create_publisher(
            DiagnosticArray, DIAGNOSTICS.name, qos(DIAGNOSTICS)
        )
        self._serve_at = 0.0
        self._look_at = 0.0
        self._serving = False
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
        if self.path == NAIVE:
            inbox: Inbox | NaiveInbox = NaiveInbox(self.node, topic, self._spin)
        else:
            inbox = Inbox(self.node, topic, best_effort=topic in SAMPLED)
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

    def _spin(self, seconds: float) -> None:
        self._executor.spin_once(timeout_sec=seconds)

    def serve(self, wait: float = 0.0) -> None:
        """Serve parameters and services, and diagnostics when they are due."""
        self.tell_time()
        now = time.monotonic()
        if not self._serving:  # else a request is being answered, and the loop goes on
            asked = wait > 0.0 or self._asked()
            if asked or now >= self._look_at:
                self._serving = True
                try:
                    self._executor.spin_once(timeout_sec=wait)
                finally:
                    self._serving = False
                now = time.monotonic()
                self._look_at = now + (0.0 if asked else LOOK_EVERY)
        self._serve_at = now + SERVE_EVERY
        for outbox in self.outboxes:
            if isinstance(outbox, SampledOutbox):
                outbox.flush()
        for inbox in self.inboxes:
            if isinstance(inbox, Inbox):
                inbox.keep()
        if now >= self._diagnose_at:
            self._diagnose_at = now + DIAGNOSE_EVERY
            self._diagnose(now)

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
        rate = (self.k - k) / max(now - then, 1e-9)
        status = DiagnosticStatus(
            level=DiagnosticStatus.OK,
            name=f"pea: {self.name}",
            message="running" if self.k else "waiting",
            hardware_id="pea",
            values=[
                KeyValue(key=key, value=str(value))
                for key, value in (
                    ("samples", self.k),
                    ("rate_hz", round(rate, 1)),
                    ("lost_samples", self.lost_samples),
                )
            ],
        )
        message = DiagnosticArray(status=[status])
        sec, nanosec = divmod(self.stamp, 10**9)
        message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec
        self._diagnostics.publish(message)

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
        """What this node waits for: one line a missing neighbour."""
        lacking = []
        recorder = (
            with_recorder or (RECORDER, NAMESPACE) in self.node.get_node_names_and_namespaces()
        )
        for outbox in self.outboxes:
            topic = outbox.topic
            names = self._hears(topic)
            deaf = [role for role in topic.subscribers if not names & self._who(SAYS[role])]
            if deaf:
                lacking.append(f"{' and '.join(deaf)} (subscriber of {topic.name})")
            elif (
                recorder
                and topic in RECORDED_TOPICS
                and RECORDER not in self._hears(blocks_of(topic) if topic in SAMPLED else topic)
            ):
                lacking.append(f"recorder (subscriber of {topic.name})")
            elif outbox.subscribers < self.node.count_subscribers(topic.name):
                lacking.append(f"{topic.name} to connect")
        lacking += [
            f"{topic.publisher} (publisher of {topic.name})"
            for topic in self.awaited
            if self._hears(topic) - {RECORDER} and not self._who(topic)
        ]
        for inbox in self.inboxes:
            topic = inbox.topic
            if topic.publisher == RECORDER and not recorder:
                continue
            if inbox.publishers < 1:
                lacking.append(f"{topic.publisher} (publisher of {topic.name})")
        return lacking

    def _who(self, topic: Topic) -> set[str]:
        """Names of the nodes that publish a topic."""
        return {end.node_name for end in self.node.get_publishers_info_by_topic(topic.name)}

    def _hears(self, topic: Topic) -> set[str]:
        """Names of the nodes that subscribe to a topic."""
        return {end.node_name for end in self.node.get_subscriptions_info_by_topic(topic.name)}

    def wait_for_peers(self, with_recorder: bool = False, settle: float = 0.0) -> None:
        """Serve parameters until every neighbour is there; say who is missing.

        All must be there for `settle` seconds: who has come with the last of them, a recorder
        for example, is then known, too.
        """
        said: list[str] = []
        since = time.monotonic()
        while (lacking := self.missing(with_recorder)) or time.monotonic() - since < settle:
            if lacking:
                since = time.monotonic()
                if lacking != said:
                    self.log.info("waiting for " + ", ".join(lacking))
                    said = lacking
            if not lacking and self._rely():
                since = time.monotonic()
            self.serve(0.02)
        self.meet()
        self.log.info("all neighbours are there")

    def meet(self) -> None:
        """Learn of the neighbours what must be known before the first sample."""

    def ask(self, role: str, names: Sequence[str] = ()) -> dict[str, Any]:
        """Values of another node's parameters, of all where none is named.

        Empty where it serves none, or does not answer in time.
        """
        client = AsyncParameterClient(self.node, f"{NAMESPACE}/{role}")

        def come(ready: Callable[[], bool], patience: float) -> bool:
            end = time.monotonic() + patience
            while not ready() and time.monotonic() < end:
                self.serve(0.02)
            return ready()

        if not come(client.services_are_ready, SERVED):
            self.log.warning(f"{NAMESPACE}/{role} serves no parameters")
            return {}
        if not names:
            listed = client.list_parameters()
            names = listed.result().result.names if come(listed.done, ANSWER) else ()
        answer = client.get_parameters(list(names))
        if not names or not come(answer.done, ANSWER):
            self.log.warning(f"{NAMESPACE}/{role} does not tell its parameters")
            return {}
        told = {
            name: parameter_value_to_python(value)
            for name, value in zip(names, answer.result().values)
            if value.type
        }
        return {n: list(v) if hasattr(v, "tolist") else v for n, v in told.items()}

    def ours(self, topic: Topic) -> bool:
        """Whether a sampled topic comes from a node of this project: it sends blocks as well."""
        return bool(self.node.count_publishers(blocks_of(topic).name))

    def _rely(self) -> bool:
        """Ask reliability of a neighbour that would not send a sample again; whether one is new."""
        new = False
        for inbox in self.inboxes:
            if isinstance(inbox, Inbox) and inbox.best_effort and not self.ours(inbox.topic):
                self.log.info(f"{inbox.topic.name} comes from a foreign node: reliable")
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
        self._executor.shutdown()
        self.node.destroy_node()


@dataclass(frozen=True)
class LoopParams:
    """What whoever starts the nodes says of the loop."""

    wait_for_recorder: bool = param(False, help="do not start without the recorder", fixed=True)
    cpu: int = param(-1, "", -1, 4095, help="core of the loop's processes; -1: any", fixed=True)
    samples: int = param(0, "", 0, 2**40, help="end after so many; 0: when ended", fixed=True)


class BlockNode(Shell):
    """Shell of one block: its parameters, its sequence check.

    Parameters
    ----------
    role : str
        One of `pea_core.config.NODES`; also the node's name.
    schema : type or Choice
        Parameters of the block.

    Raises
    ------
    ParameterError
        A given value is unknown or breaks a rule.
    """

    def __init__(self, role: str, schema: Schema) -> None:
        super().__init__(role, allow_undeclared=True)  # another type may have others
        given = ros_params.overrides(self.node)
        own = {name: given.pop(name) for name in specs(LoopParams) if name in given}
        loop: LoopParams = build(LoopParams, own, f"{role}.")
        self.with_recorder, self.samples, self.cpu = (
            loop.wait_for_recorder,
            loop.samples,
            loop.cpu,
        )
        self.hop: Any = None
        self.wall = False
        self._make: Callable[[], Any] = lambda: None
        self._cpus = os.sched_getaffinity(0)
        self._between: Callable[[], None] | None = None
        self._found: list[int] = []
        self._known: dict[str, set[bytes]] = {}
        self.given = given
        self.parameters = ros_params.BlockParameters(self.node, role, schema, given)
        self.params = self.parameters.params
        self.T_s = self.parameters.resolved.T_s
        self.T_ns = self.parameters.resolved.node.T_ns
        self.choose_path(self.samples or sys.maxsize)

    @property
    def stamp(self) -> int:
        """Loop time (ns) of the current sample."""
        return self.k * self.T_ns

    def ask_plant(self, *names: str) -> dict[str, Any]:
        """Values of the plant's parameters; keep up with one that paces the loop in wall time."""
        told = self.ask("plant", ("clock", *names))
        self.wall = told.pop("clock", None) == "wall"
        if self.wall and self.T_s >= pace.CALM:
            pace.hurry()
        return told

    def compile(self, make: Callable[[], Any]) -> None:
        """Get the compiled hot path ready beside everything else; until then the loop runs without.

        Parameters
        ----------
        make : callable
            Makes the `pea_ros.hop.Hop`, which may take seconds.
        """
        if self.path == NAIVE or not compiles(self.samples or sys.maxsize):
            return
        self._make = make
        thread = self._prepare()
        if chosen():
            while thread.is_alive():
                self.serve(0.02)

    def make_hop(self, *arguments: Any) -> Any:
        """Make the hop of the way that samples take; arguments as of `pea_ros.hop.Hop`."""
        kind = "TurboHop" if self.path == TURBO else "FastHop"
        module = importlib.import_module(f"pea_ros.{self.path}")  # numba is there only if wanted
        return getattr(module, kind)(self.T_ns, *arguments)

    def _prepare(self) -> threading.Thread:
        """Make the hop in a thread of its own, on any core."""

        def ready() -> None:
            os.sched_setaffinity(0, self._cpus)
            try:
                self.hop = self._make()
            except Exception as error:  # the loop runs all the same
                self.path = FAST
                self.log.warning(f"transport: fast (nothing can be compiled: {error})")

        thread = threading.Thread(target=ready, daemon=True)
        thread.start()
        return thread

    def pin(self) -> None:
        """Move to the loop's core: a wake-up across cores costs more than all the rest."""
        if self.cpu < 0 or self.path == NAIVE:
            return
        for thread in os.listdir("/proc/self/task"):
            with contextlib.suppress(OSError):
                os.sched_setaffinity(int(thread), {self.cpu})
                if not os.sched_getparam(int(thread)).sched_priority:
                    os.sched_setscheduler(int(thread), os.SCHED_BATCH, os.sched_param(0))

    def expect(self, topic: Topic, stamp: int) -> bool:
        """Check that a message belongs to the current sample.

        Returns
        -------
        bool
            False where it is one that was found in a block and comes late by itself.

        Raises
        ------
        LoopFault
            It does not: something was lost, sent twice, or runs at another T_s.
        """
        if stamp == self.k * self.T_ns:
            return True
        if stamp in self._found:
            self._found.remove(stamp)
            return False
        if self.joins(topic, stamp):
            joined, again = stamp // self.T_ns, stamp < self.k * self.T_ns
            if self.k and not again:  # else it was not there before
                self.lost_samples += joined - self.k
            self.k = joined
            self._found.clear()
            self.restart(again)
            self.log.info(f"{topic.name}: begins with sample {self.k} of a loop in wall time")
            return True
        raise LoopFault(
            f"{topic.name}: expected sample {self.k} (stamp {self.k * self.T_ns} ns), got "
            f"{stamp / self.T_ns:g} (stamp {stamp} ns): lost, sent twice, or another T_s"
        )

    def joins(self, topic: Topic, stamp: int) -> bool:
        """Whether this is the first sample here, or from a new neighbour, of a loop in wall time.

        There the plant goes on while a node is started again, and begins anew when it is itself;
        in lock-step nothing is missed.
        """
        new = [self.newcomer(each) for each in (DISPLACEMENT, topic)]
        return self.wall and not stamp % self.T_ns and (self.k == 0 or any(new))

    def newcomer(self, topic: Topic) -> bool:
        """Whether somebody publishes a topic who has not when this was asked before."""
        ends = self.node.get_publishers_info_by_topic(topic.name)
        known = self._known.get(topic.name, set())
        now = self._known[topic.name] = {bytes(end.endpoint_gid) for end in ends}
        return not now <= known

    def restart(self, again: bool) -> None:
        """Start the block anew, at rest; `again`: the loop has begun again, too."""

    def beside(self, work: Callable[[], None]) -> None:
        """Do what may take longer than a sample; the loop goes on meanwhile where it can.

        Raises
        ------
        Exception
            What `work` has raised.
        """
        go_on, self._between = self._between, None
        if go_on is None:
            work()
            return
        with ThreadPoolExecutor(1) as pool:
            done = pool.submit(work)
            while not done.done():
                go_on()
        self.tell_time()
        done.result()

    def reach(self) -> tuple[int, Any]:
        """Sample up to which compiled code may go on its own now, and what it needs for that."""
        return self.k, ()

    def reached(self, samples: int) -> None:
        """Take note that compiled code has served so many samples."""

    def spin(
        self,
        inbox: Inbox | NaiveInbox,
        handle: Callable[[bytes], None],
        silence: float = SILENCE,
    ) -> None:
        """Handle each message of `inbox` as it comes, until the loop has `samples` or is ended.

        After `silence` seconds without one it says so.
        """
        self.pin()
        gc.freeze()  # what is there stays: to look at it again takes tens of ms
        for topic in (DISPLACEMENT, *(each.topic for each in self.inboxes)):
            self.newcomer(topic)
        k, heard = self.k, time.monotonic()
        end = self.samples or sys.maxsize

        def go_on() -> None:
            inbox.wait(PAUSE)
            while self.k < end and (data := inbox.take()) is not None:
                handle(data)

        between = None if self.path == NAIVE else go_on
        while self.k < end and rclpy.ok():
            if not self._leap(end, handle):
                self._walk(end, inbox, handle)
            now = time.monotonic()
            if now >= self._serve_at:  # after a sample: nothing is due so soon
                self._between = between
                self.serve()
                self._between = None
            if self.k != k:
                k, heard = self.k, now
                continue
            if isinstance(inbox, Inbox) and (data := inbox.missed(k * self.T_ns)) is not None:
                self._found.append(k * self.T_ns)
                handle(data)
            if now - heard > silence:
                heard = now + 4 * silence
                self.miss(inbox.topic, silence)
        if rclpy.ok():
            self.deliver()

    def miss(self, topic: Topic, seconds: float) -> None:
        """Say that nothing comes on a topic, and in wall time what to do."""
        wise = " if not, start it again; a plant in fault waits for ~/reset and ~/enable"
        self.log.warning(
            f"no {topic.name} for {seconds:g} s at sample {self.k}: is the {topic.publisher} alive?"
            + (wise if self.wall else "")
        )

    def _walk(self, end: int, inbox: Inbox | NaiveInbox, handle: Callable[[bytes], None]) -> None:
        """Handle messages one by one until something is due here, or nothing comes.

        The nodes take turns on one core with cold caches: every call counts manifold.
        """
        take, wait, clock = inbox.take, inbox.wait, time.monotonic
        while self.k < end:
            wait(SERVE_EVERY)
            data = take()
            if data is None:
                return
            handle(data)
            if clock() >= self._serve_at:
                return

    def _leap(self, end: int, handle: Callable[[bytes], None]) -> bool:
        """Let compiled code serve until something is due here; whether it could."""
        hop = self.hop
        if hop is None:
            return False
        if not hop.serves():
            if hop.block.coming is None:  # it has become another type
                self.hop = None
                self._prepare()
            return False
        reach, extra = self.reach()
        if reach <= self.k:
            return False
        if not hop.used:
            hop.used = True
            self.log.info(f"compiled from sample {self.k} on")
        k, data = hop.run(self.k, min(reach, end), int(self._serve_at * 1e9), extra)
        samples, self.k = k - self.k, k
        self.reached(samples)
        if data is not None:
            handle(data)
        return True


def run(make: Callable[[], Any], name: str, args: list[str] | None = None) -> None:
    """Run a node's process to its end: the ``main`` of every node.

    Exits with status 0 when done or interrupted, 2 for bad input, 3 when the loop failed.
    """
    status = 0
    environment()
    signal.signal(signal.SIGINT, INTERRUPT)  # before rclpy's own, which passes signals on
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
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # else one that comes now ends it with another
    sys.exit(status)


def _live(make: Callable[[], Any]) -> None:
    shell = make()
    try:
        shell.run()
    finally:
        with contextlib.suppress(Exception):
            shell.close()
