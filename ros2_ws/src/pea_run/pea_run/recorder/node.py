"""The recorder's node: every message of the loop into a bag, with proof that none is missing.

The loop's nodes send it their samples in blocks; it checks the stamp of every one and says on
`/pea/recorded` how far every topic is complete; the plant never runs further ahead than the
publishers' history reaches back, so nothing can be lost.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.serialization import deserialize_message, serialize_message

from pea_core import config
from pea_core.config import DISTRIBUTED, NODES, NodeParams, specs_of_axes
from pea_core.loop import LoopFault
from pea_core.params import ParameterError, build, flatten, param, specs
from pea_core.units import NS
from pea_record.bag import Split
from pea_record.definitions import DefinitionError
from pea_record.origin import ORIGIN, origin
from pea_record.rows import Events, note
from pea_record.trigger import (
    EDGES,
    LONGEST,
    NO_SCAN,
    SCANNED,
    SIGNALS,
    Trigger,
    TriggeredBag,
    no_events,
    opened,
    trigger_of,
)
from pea_ros import params as ros_params
from pea_ros.shell import Shell, run
from pea_ros.transport import Inbox
from pea_wire import convert, events
from pea_wire.convert import ConversionError
from pea_wire.topics import (
    BESIDE,
    DIAGNOSTICS,
    FOLLOWED,
    NAMESPACE,
    PARAMETER_EVENTS,
    RECORDED,
    RECORDER,
    REFERENCE,
    SAMPLED,
    WINDOW,
    Topic,
    blocks_of,
)

SERVED_EVERY = 0.5
"""Seconds between two looks at parameters and services."""

PARAMS = "params.yaml"
"""File in the bag's directory that says what was started, where somebody wrote one."""

DRAIN_EVERY = 0.005
"""Seconds between two looks at the inboxes: cheaper than waking for each message."""


@dataclass(frozen=True)
class Params(NodeParams):
    """Parameters of the recorder."""

    out: str = param("", help="directory of the bag, made if missing", fixed=True)
    experiment: str = param("", help="name of the experiment, kept in the bag", fixed=True)
    samples: int = param(
        0, "", 0, 2**40, help="end after so many samples; 0: when interrupted", fixed=True
    )
    split_size: int = param(
        0,
        "",
        0,
        2**50,
        help="bytes after which the bag goes on in a new file; 0: never",
        fixed=True,
    )
    split_duration: float = param(
        0.0, "s", 0.0, 1e9, help="loop time after which it does; 0: never", fixed=True
    )
    trigger_source: str = param(
        "", help="what the recording is triggered by; empty: everything is kept", fixed=True
    )
    trigger_level: float = param(
        0.0, "", -1e12, 1e12, help="level of a signal, in its unit", fixed=True
    )
    trigger_edge: str = param("rising", choices=EDGES, help="passage of the level", fixed=True)
    trigger_pre: float = param(
        0.1, "s", 0.0, LONGEST, help="loop time kept before a trigger", fixed=True
    )
    trigger_post: float = param(0.1, "s", 0.0, LONGEST, help="and after it", fixed=True)

    @property
    def trigger(self) -> Trigger | None:
        """What the recording is triggered by."""
        if not self.trigger_source:
            return None
        signal = self.trigger_source.rpartition(".")[2] in SIGNALS
        return trigger_of(
            self.trigger_source,
            self.trigger_level if signal else None,
            self.trigger_edge if signal else None,
            self.trigger_pre,
            self.trigger_post,
        )


def _stage(name: str) -> str:
    """Namespace of the stage that a diagnostic is of, without its slash; empty if of none."""
    space, _, rest = name.partition(": ")
    return space if rest.partition(": ")[0] in (*NODES, RECORDER) else ""


class RecorderNode(Shell):
    """Drains the loop's topics into a bag."""

    def __init__(self) -> None:
        super().__init__(RECORDER)
        given = ros_params.overrides(self.node, specs(Params))
        ros_params.leave_out(self.node, lambda text: None, specs(Params))
        self.params: Params = build(Params, given, "recorder.")
        for name, spec in specs(Params).items():
            ros_params.declare(self.node, name, spec, flatten(Params, self.params)[name])
        if not self.params.out:
            raise ParameterError("out = '': give the bag's directory, -p out:=DIR")
        self.T_ns = self.params.T_ns
        try:
            split = Split(self.params.split_size, self.params.split_duration)
            trigger, there = self.params.trigger, Path(self.params.out)
            self.bag = opened(there, self.T_ns, split, trigger, no_events)
        except (OSError, DefinitionError) as error:
            raise ParameterError(f"out = {self.params.out!r}: {error}") from None
        self.choose_path(samples=0)
        everybodys = (DIAGNOSTICS, PARAMETER_EVENTS)
        self.beside = [self.inbox(topic) for topic in everybodys]
        others = (topic for topic in BESIDE if topic not in everybodys)
        self.beside += [self.drained(topic) for topic in others]  # it waits for none of them
        self.following = self.inbox(FOLLOWED)
        self.sampled = {topic: self.drained(blocks_of(topic)) for topic in SAMPLED}
        self.came: deque[tuple[Topic, Inbox, bytes]] = deque()
        self.stranger = False
        self.next = {topic.name: 0 for topic in SAMPLED}
        self.joined = {topic.name: False for topic in SAMPLED}
        self.recorded = self.outbox(RECORDED)
        self.serve_at = 0.0
        self.scanned: Events | None = None

    def drained(self, topic: Topic) -> Inbox:
        """Subscribe to a topic that is drained by hand whatever the way."""
        return Inbox(self.node, topic, judge=self.judge)

    @property
    def watched(self) -> list[Any]:
        """Every inbox."""
        return [*super().watched, *self.sampled.values()]

    def judge(self, inbox: Any, number: int) -> bool:
        """Whether a message out of sequence may be used; if not, serve at once: it says why."""
        fine = super().judge(inbox, number)
        if not fine:
            self.serve_at = 0.0
        return fine

    @property
    def stamp(self) -> int:
        """Loop time (ns) up to which every topic is recorded."""
        return self.k * self.T_ns

    def missing(self, with_recorder: bool) -> list[str]:
        """What is not there yet; a node that sends no blocks is recorded message by message."""
        lacking = super().missing(with_recorder)
        if not self._who(REFERENCE):
            lacking.append(f"reference (publisher of {self.full_name(REFERENCE)})")
        for topic, inbox in self.sampled.items():
            if inbox.topic != topic and not self.ours(topic) and self._who(topic):
                self.node.destroy_subscription(inbox.subscription)
                inbox = self.sampled[topic] = self.drained(topic)
                self.log.info(
                    f"{self.full_name(topic)} comes from a foreign node: recorded one by one"
                )
            if not inbox.publishers:
                lacking.append(f"{topic.publisher} (publisher of {self.full_name(topic)})")
        return lacking

    def proved(self, topic: Topic, stamps: np.ndarray) -> None:
        """See that no sample is missing before or among some.

        Raises
        ------
        LoopFault
            One is; it is named.
        """
        name = topic.name
        if not self.joined[name]:
            self.joined[name] = True
            self.next[name] = max(0, int(stamps[0]) // self.T_ns)
            if stamps[0]:
                self.log.warning(f"{name} joined at sample {self.next[name]}: the bag begins there")
        expected = (self.next[name] + np.arange(len(stamps))) * self.T_ns
        wrong = np.flatnonzero(stamps != expected)
        if len(wrong):
            stamp = int(stamps[wrong[0]])
            raise LoopFault(
                f"{name}: expected sample {self.next[name] + wrong[0]}, got "
                f"{stamp / self.T_ns:g} (stamp {stamp} ns): lost, sent twice, or another T_s"
            )
        self.next[name] += len(stamps)

    def write(self, topic: Topic, inbox: Inbox, data: bytes) -> None:
        """Record a message of a topic that has one for each sample, or a block of them."""
        if inbox.topic == topic:
            stamps = np.array([self.read(topic, convert.stamp, data)])
            self.proved(topic, stamps)
            self.bag.write(topic, int(stamps[0]), data)
            return
        size, payload = self.read(inbox.topic, convert.decode_block, data)
        rows = np.frombuffer(payload, f"V{size}")
        stamps = convert.stamps(payload, size)
        self.proved(topic, stamps)
        self.bag.write_many(topic, stamps, rows)

    def write_beside(self, inbox: Any, data: bytes) -> None:
        """Record a message that belongs to no sample, at the stamp that it begins with.

        The reference and diagnostics tell no loop time: theirs is how far the recording has come.
        Anybody may publish events of parameters: what is none is left out, and said once.
        """
        stamp = self.stamp
        if inbox.topic == PARAMETER_EVENTS:
            try:
                event = self.read(PARAMETER_EVENTS, events.decode, data)
            except ConversionError as error:
                if not self.stranger:
                    self.log.warning(f"not recorded: {error}")
                self.stranger = True
                return
            ahead = self.stamp + 2 * WINDOW * self.T_ns
            if event.node.startswith(f"{self.namespace}/") and 0 <= event.stamp <= ahead:
                stamp = event.stamp
                if self.namespace != NAMESPACE:
                    asked = {name: v for name, v in event.asked.items() if v is not None}
                    node = event.node.replace(self.namespace, NAMESPACE, 1)
                    data = events.encode(stamp, node, asked)
        elif inbox.topic == DIAGNOSTICS:
            data = self.own(data)
            if not data:
                return
        elif inbox is not self.following:
            stamp = self.read(inbox.topic, convert.stamp, data)
        self.bag.write(REFERENCE if inbox is self.following else inbox.topic, stamp, data)

    def own(self, data: bytes) -> bytes:
        """Diagnostics without those of other stages; ours named as in the default namespace."""
        try:
            message = deserialize_message(data, DiagnosticArray)
        except Exception:  # what no decoder reads is recorded as it came
            return data
        stages = [_stage(status.name) for status in message.status]
        kept = [
            status
            for status, stage in zip(message.status, stages, strict=True)
            if stage in ("", self.space)
        ]
        if len(kept) == len(message.status) and self.namespace == NAMESPACE:
            return data
        for status in kept:
            if _stage(status.name):
                status.name = status.name.replace(self.space, NAMESPACE.strip("/"), 1)
        message.status = kept
        return bytes(serialize_message(message)) if kept else b""

    def drain(self) -> None:
        """Record all that has come, first what was sent before the samples.

        The window of a trigger may end with the samples: what comes later is not in it.
        """
        for topic, inbox in self.sampled.items():
            while (data := inbox.take()) is not None:
                self.came.append((topic, inbox, data))
        for other in (self.following, *self.beside):
            while other is not None and (data := other.take()) is not None:
                self.write_beside(other, data)
        while self.came:
            self.write(*self.came.popleft())

    def run(self) -> None:
        """Record until the loop ends."""
        try:
            try:
                self.wait_for_peers()
                name = self.params.experiment
                there = self.bag.directory
                sections = self.sections()
                told = origin(name, sections, DISTRIBUTED, self.T_ns, there)
                self.scan(sections)
                self.bag.metadata(ORIGIN, told)
                self.record()
            finally:
                self.finish()
        except OSError as error:
            raise LoopFault(f"{self.bag.path}: {error.strerror}") from None
        self.tell(self.k)
        kept = f"; {self.bag.said()}" if isinstance(self.bag, TriggeredBag) else ""
        self.say(f"{self.k} samples in {self.bag.path}{kept}")

    def sections(self) -> dict[str, dict[str, Any]]:
        """What the loop was started with: as written beside the bag, or as the nodes tell."""
        path = self.bag.directory / PARAMS
        if path.is_file():
            return config.read(path, ("experiment", *NODES))
        from pea_experiment.experiment import SCHEMAS

        found = {}
        for node in NODES:
            told = self.ask(node)
            if "T_s" not in told:  # of a node that is not ours, whatever else it tells
                continue
            with contextlib.suppress(ParameterError):  # of a type that is not ours
                known = specs_of_axes(SCHEMAS[node], told)
                found[node] = {name: value for name, value in told.items() if name in known}
        return {node: values for node, values in found.items() if values}

    def scan(self, sections: dict[str, dict[str, Any]]) -> None:
        """Find the events of the scan that the loop follows, where it follows one.

        Raises
        ------
        LoopFault
            They trigger the recording, and the reference is no scan, or is unknown here.
        """
        from pea_reference.model import CHOICE, events_of

        values = config.absolute(sections.get("reference", {}), self.bag.directory)
        found: list[Any] = []
        needed = self.params.trigger_source in SCANNED
        try:
            each = config.resolve_axes("reference", CHOICE, [values])
            found = [events_of(one.params, self.T_ns * NS) for one in each]
        except ParameterError as error:  # of a node that is not ours
            if needed:
                raise LoopFault(str(error)) from None
        self.scanned = next((events for events in found if events is not None), None)
        if needed and self.scanned is None:
            raise LoopFault(f"trigger_source = {self.params.trigger_source!r}: {NO_SCAN}")
        if isinstance(self.bag, TriggeredBag):
            self.bag.events = self.scanned

    def finish(self) -> None:
        """Record what has come and close the bag, however often Ctrl-C comes meanwhile.

        Raises
        ------
        OSError
            Something could not be written.
        """
        for number in (signal.SIGINT, signal.SIGTERM):
            while signal.getsignal(number) is not signal.SIG_IGN:
                with contextlib.suppress(KeyboardInterrupt):
                    signal.signal(number, signal.SIG_IGN)
        try:
            with contextlib.suppress(LoopFault, rclpy_implementation.RCLError):
                self.drain()
        finally:
            self.bag.close()

    def tell(self, word: object) -> None:
        """Say how far it is, where a number of samples is given, as long as somebody reads it."""
        if not self.params.samples:
            return
        try:
            print(word, flush=True)
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())

    def record(self) -> None:
        """Drain the inboxes until the loop has `samples` or is ended."""
        said, begun = -1, False
        self.tell("ready")
        while rclpy.ok() and not (self.params.samples and self.k >= self.params.samples):
            self.drain()
            before, self.k = self.k, min(self.next.values())
            note(self.bag, before, self.k, self.T_ns, self.scanned)
            if not begun and any(self.next.values()):
                begun = True
                self.tell(0)
            self.bag.keep()
            now = time.monotonic()
            if self.k - said >= WINDOW // 8 or now >= self.serve_at:
                if now >= self.serve_at:
                    self.serve_at = now + SERVED_EVERY
                    self.serve()
                if self.k != said:
                    said = self.k
                    self.recorded.send(convert.encode_time(self.stamp))
                    if self.k:
                        self.tell(self.k)
            time.sleep(DRAIN_EVERY)


def main(args: list[str] | None = None) -> None:
    """Run ``ros2 run pea_run recorder``."""
    run(RecorderNode, RECORDER, args)
