"""The shell round a block: one process, one node, messages in, messages out.

The hot path waits on one reused wait set and takes raw bytes; parameters, services and
diagnostics are served between samples, so a change is effective between two of them.
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
"""Seconds between two looks at whether slow work beside the loop is done."""

RESENT = 0.1
"""Seconds within which a sample that was lost comes again, in a block."""


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
        ros_params.leave_out(self.node, self.say)
        own = {name: given.pop(name) for name in specs(LoopParams) if name in given}
        for name in own:  # of this process, not of the block: a dump of its parameters is for any
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
        """Values of the plant's parameters; keep up with one that paces the loop in wall time."""
        told = self.ask("plant", ("clock", *names))
        self.wall = told.pop("clock", None) == "wall"
        if self.wall and self.T_s >= pace.CALM:
            pace.hurry()
        return told

    def compile(self, make: Callable[[], object]) -> None:
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

    def make_hop(self, *arguments: object) -> Any:
        """Make the hop of the way that samples take; arguments as of `pea_ros.hop.Hop`."""
        kind = "TurboHop" if self.path == TURBO else "FastHop"
        module = importlib.import_module(f"pea_ros.{self.path}")  # numba is there only if wanted
        return getattr(module, kind)(self.T_ns, *arguments)

    def _prepare(self) -> threading.Thread:
        """Make the hop in a thread of its own, on any core."""

        def ready() -> None:
            os.sched_setaffinity(0, self.cpus)
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
        if stamp in self.found:
            self.found.remove(stamp)
            return False
        if self.joins(topic, stamp):
            joined, again = stamp // self.T_ns, stamp < self.k * self.T_ns
            if self.k and not again:  # else it was not there before
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
        """Handle the samples before `stamp` that were lost, as their blocks come; whether all did.

        In lock-step nothing comes after a sample that was lost, so this is for wall time.
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
        """Sample up to which another node is, by a message that says so.

        Raises
        ------
        ConversionError
            It cannot be there: `most` is where this node is.
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
        """Whether this is the first sample here, or from a new neighbour, of a loop in wall time.

        There the plant goes on while a node is started again, and begins anew when it is itself;
        in lock-step nothing is missed.
        """
        new = [self.newcomer(each) for each in (DISPLACEMENT, topic)]
        return self.wall and not stamp % self.T_ns and (self.k == 0 or any(new))

    def newcomer(self, topic: Topic) -> bool:
        """Whether somebody publishes a topic who has not when this was asked before."""
        ends = publishers_of(self.node, topic)
        known = self._known.get(topic.name, set())
        now = self._known[topic.name] = {bytes(end.endpoint_gid) for end in ends}
        return not now <= known

    def intruded(self, text: str) -> None:
        """Take note of a topic with more than one publisher; in wall time the plant trips.

        Raises
        ------
        LoopFault
            The loop is in lock-step.
        """
        if not self.wall:
            super().intruded(text)
        self.held = text

    def hold(self) -> None:
        """Answer nothing until each topic has one publisher, then join the loop anew."""
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
        """Start the block anew, at rest; `again`: the loop has begun again, too."""

    def beside(self, work: Callable[[], None]) -> None:
        """Do what may take longer than a sample; the loop goes on meanwhile where it can.

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
        self.serving = inbox, handle
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
            if not self.leap(end, handle):
                self._walk(end, inbox, handle)
            now = time.monotonic()
            if now >= self._serve_at:  # after a sample: nothing is due so soon
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
        """Say that nothing comes on a topic, and in wall time what to do."""
        wise = " if not, start it again; a plant in fault waits for ~/reset and ~/enable"
        self.log.warning(
            f"no {self.full_name(topic)} for {seconds:g} s at sample {self.k}: "
            f"is the {topic.publisher} alive?" + (wise if self.wall else "")
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

    def leap(self, end: int, handle: Callable[[bytes], None]) -> bool:
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
        k, data = hop.run(self.k, min(reach, end), int(self._serve_at * SECOND), extra)
        samples, self.k = k - self.k, k
        self.reached(samples)
        if data is not None:
            handle(data)
        return True
