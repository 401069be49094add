"""The ROS node of a block: it receives messages, calls the block, and publishes the results.

The hot path waits on one reused wait set and takes raw bytes. Parameters, services and
diagnostics are served between samples, so a change takes effect between two samples.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import rclpy

from pea_core.loop import LoopFault
from pea_core.params import Schema, build, param, specs
from pea_core.units import SECOND
from pea_engine import pace
from pea_ros import params as ros_params
from pea_ros.path_choice import compiles
from pea_ros.paths import FAST, NAIVE, TURBO, chosen
from pea_ros.shell import SERVE_EVERY, SILENCE, Shell
from pea_ros.transport import MOST, Inbox, NaiveInbox, publishers_of
from pea_wire import convert
from pea_wire.convert import ConversionError
from pea_wire.topics import DISPLACEMENT, Topic

PAUSE = 0.002
"""Seconds between two checks whether slow work in another thread is done."""

RESENT = 0.1
"""Seconds within which a lost sample is sent again, together with others."""


@dataclass(frozen=True)
class LoopParams:
    """Loop parameters set by the launcher."""

    wait_for_recorder: bool = param(False, help="do not start without the recorder", fixed=True)
    cpu: int = param(-1, "", -1, 4095, help="core of the loop's processes; -1: any", fixed=True)
    samples: int = param(0, "", 0, 2**40, help="end after so many; 0: when ended", fixed=True)


class BlockNode(Shell):
    """Node of one block: its parameters, the check of the sample sequence, the hot path.

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
        super().__init__(role, allow_undeclared=True)  # another type may have other parameters
        given = ros_params.overrides(self.node)
        ros_params.leave_out(self.node, self.say)
        own = {name: given.pop(name) for name in specs(LoopParams) if name in given}
        for name in own:  # they belong to this process: a dump of the block must not contain them
            self.node.undeclare_parameter(name)
        loop: LoopParams = build(LoopParams, own, f"{role}.")
        self.with_recorder, self.samples, self.cpu = (
            loop.wait_for_recorder,
            loop.samples,
            loop.cpu,
        )
        self.hop: Any = None
        self.wall = False
        self.held = ""
        self.serving: tuple[Any, Callable[[bytes], None]] = (None, lambda data: None)
        self._make: Callable[[], Any] = lambda: None
        self.cpus = os.sched_getaffinity(0)
        self.between: Callable[[], None] | None = None
        self.found: list[int] = []
        self._known: dict[str, set[bytes]] = {}
        sources = ros_params.sources(self.node.get_fully_qualified_name(), given)
        self.parameters = ros_params.BlockParameters(self.node, role, schema, sources)
        self.params = self.parameters.params
        self.axes = self.parameters.axes
        self.forms = convert.forms(self.axes)
        self.T_s = self.parameters.resolved.T_s
        self.T_ns = self.parameters.resolved.node.T_ns
        self.choose_path(self.samples or sys.maxsize)

    @property
    def stamp(self) -> int:
        """Loop time (ns) of the current sample."""
        return self.k * self.T_ns

    def ask_plant(self, *names: str) -> dict[str, Any]:
        """Values of the plant's parameters; in wall time, this node also raises its priority."""
        told = self.ask("plant", ("clock", *names))
        self.wall = told.pop("clock", None) == "wall"
        if self.wall and self.T_s >= pace.CALM:
            pace.hurry()
        return told

    def compile(self, make: Callable[[], object]) -> None:
        """Compile the hot path in another thread; until then the loop runs in plain Python.

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

    def make_hop(self, *arguments: object) -> Any:
        """Make the hop for the chosen transport; arguments as of `pea_ros.hop.Hop`."""
        kind = "TurboHop" if self.path == TURBO else "FastHop"
        module = importlib.import_module(f"pea_ros.{self.path}")  # imports numba only if needed
        return getattr(module, kind)(self.T_ns, *arguments)

    def _prepare(self) -> threading.Thread:
        """Make the hop in another thread, on any core."""

        def ready() -> None:
            os.sched_setaffinity(0, self.cpus)
            try:
                self.hop = self._make()
            except Exception as error:  # the loop runs without it
                self.path = FAST
                self.log.warning(f"transport: fast (nothing can be compiled: {error})")

        thread = threading.Thread(target=ready, daemon=True)
        thread.start()
        return thread

    def pin(self) -> None:
        """Move to the loop's core: a wake-up across cores costs more than the rest of a sample."""
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
            False for a late message whose sample was already handled from a resent block.

        Raises
        ------
        LoopFault
            It belongs to another sample: a message was lost, sent twice, or has another T_s.
        """
        if stamp == self.k * self.T_ns:
            return True
        if stamp in self.found:
            self.found.remove(stamp)
            return False
        if self.joins(topic, stamp):
            joined, again = stamp // self.T_ns, stamp < self.k * self.T_ns
            if self.k and not again:  # otherwise this node has just started
                self.lost_samples += joined - self.k
            self.k = joined
            self.found.clear()
            self.restart(again)
            self.log.info(
                f"{self.full_name(topic)}: begins with sample {self.k} of a loop in wall time"
            )
            return True
        if stamp > self.k * self.T_ns and self.catch_up(stamp):
            return True
        raise LoopFault(
            f"{self.full_name(topic)}: expected sample {self.k} (stamp {self.k * self.T_ns} ns), "
            f"got {stamp / self.T_ns:g} (stamp {stamp} ns): lost, sent twice, or another T_s"
        )

    def catch_up(self, stamp: int) -> bool:
        """Handle the lost samples before `stamp` when they are sent again; whether all were.

        It is for wall time: in lock-step no message follows a lost sample.
        """
        inbox, handle = self.serving
        end = time.monotonic() + RESENT
        while isinstance(inbox, Inbox) and self.k * self.T_ns < stamp and time.monotonic() < end:
            inbox.keep()
            data = inbox.missed(self.k * self.T_ns)
            if data is None:
                time.sleep(PAUSE)
                continue
            self.lost_samples += 1
            handle(data)
        return self.k * self.T_ns == stamp

    def progress(self, topic: Topic, data: bytes, most: int) -> int:
        """Sample that another node has reached, from its message.

        Raises
        ------
        ConversionError
            The message is wrong: the sample is later than `most`, which this node has reached.
        """
        k, rest = divmod(self.read(topic, convert.decode_time, data), self.T_ns)
        if rest or not 0 <= k <= most:
            raise ConversionError(
                "time",
                f"{k * self.T_ns + rest} ns: must be that of a sample, {self.T_ns} ns apart, "
                f"from 0 to {most * self.T_ns} ns",
                self.full_name(topic),
            )
        return k

    def joins(self, topic: Topic, stamp: int) -> bool:
        """Whether this is the first sample here, or the first of a new neighbour, in wall time.

        In wall time the plant goes on while another node is restarted, and begins again if the
        plant is restarted. In lock-step no sample is missed.
        """
        new = [self.newcomer(each) for each in (DISPLACEMENT, topic)]
        return self.wall and not stamp % self.T_ns and (self.k == 0 or any(new))

    def newcomer(self, topic: Topic) -> bool:
        """Whether a topic has a publisher that it did not have at the last call."""
        ends = publishers_of(self.node, topic)
        known = self._known.get(topic.name, set())
        now = self._known[topic.name] = {bytes(end.endpoint_gid) for end in ends}
        return not now <= known

    def intruded(self, text: str) -> None:
        """Stop answering because a topic has more than one publisher; in wall time the plant trips.

        Raises
        ------
        LoopFault
            The loop is in lock-step.
        """
        if not self.wall:
            super().intruded(text)
        self.held = text

    def hold(self) -> None:
        """Answer no sample until each topic has one publisher, then join the loop again."""
        self.log.error(f"{self.held}; no sample is answered until then")
        while self.held and rclpy.ok():
            self.held = ""
            for inbox in self.inboxes:
                for _ in range(MOST):
                    inbox.take()
            self.serve(SERVE_EVERY)
        self.log.info("one publisher each again")
        self._known.clear()

    def restart(self, again: bool) -> None:
        """Start the block again, at rest; `again`: the loop has begun again, too."""

    def beside(self, work: Callable[[], None]) -> None:
        """Do work that may take longer than a sample; meanwhile the loop goes on, if possible.

        Raises
        ------
        Exception
            What `work` has raised.
        """
        go_on, self.between = self.between, None
        if go_on is None:
            work()
            return
        with ThreadPoolExecutor(1, initializer=pace.like_this_thread()) as pool:
            done = pool.submit(work)
            while not done.done():
                go_on()
        self.tell_time()
        done.result()

    def reach(self) -> tuple[int, Any]:
        """Sample up to which compiled code may run alone now, and the data that it needs."""
        return self.k, ()

    def reached(self, samples: int) -> None:
        """Called after compiled code has served this many samples."""

    def spin(
        self,
        inbox: Inbox | NaiveInbox,
        handle: Callable[[bytes], None],
        silence: float = SILENCE,
    ) -> None:
        """Handle each message of `inbox` when it arrives, until `samples` or the end of the loop.

        After `silence` seconds without a message it warns.
        """
        self.serving = inbox, handle
        self.pin()
        gc.freeze()  # existing objects stay: collecting them would take tens of ms
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
            if not self.leap(end, handle):
                self._walk(end, inbox, handle)
            now = time.monotonic()
            if now >= self._serve_at:  # directly after a sample, when the next one is not due yet
                self.between = between
                self.serve()
                self.between = None
                if self.held:
                    self.hold()
            if self.k != k:
                k, heard = self.k, now
                continue
            if isinstance(inbox, Inbox) and (data := inbox.missed(k * self.T_ns)) is not None:
                self.found.append(k * self.T_ns)
                handle(data)
            if now - heard > silence:
                heard = now + 4 * silence
                self.miss(inbox.topic, silence)
        if rclpy.ok():
            self.deliver()

    def miss(self, topic: Topic, seconds: float) -> None:
        """Warn that a topic is silent; in wall time, say what to do."""
        wise = " if not, start it again; a plant in fault waits for ~/reset and ~/enable"
        self.log.warning(
            f"no {self.full_name(topic)} for {seconds:g} s at sample {self.k}: "
            f"is the {topic.publisher} alive?" + (wise if self.wall else "")
        )

    def _walk(self, end: int, inbox: Inbox | NaiveInbox, handle: Callable[[bytes], None]) -> None:
        """Handle messages one by one until a service is due, or no message arrives.

        The nodes take turns on one core with cold caches, so every call costs much more here.
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

    def leap(self, end: int, handle: Callable[[bytes], None]) -> bool:
        """Let compiled code handle messages until a service is due; whether it could."""
        hop = self.hop
        if hop is None:
            return False
        if not hop.serves():
            if hop.block.coming is None:  # the block has another type now
                self.hop = None
                self._prepare()
            return False
        reach, extra = self.reach()
        if reach <= self.k:
            return False
        if not hop.used:
            hop.used = True
            self.log.info(f"compiled from sample {self.k} on")
        k, data = hop.run(self.k, min(reach, end), int(self._serve_at * SECOND), extra)
        samples, self.k = k - self.k, k
        self.reached(samples)
        if data is not None:
            handle(data)
        return True
