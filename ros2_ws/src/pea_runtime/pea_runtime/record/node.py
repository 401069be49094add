"""The recorder's node: every message of the loop into a bag, with proof that none is missing.

It says on `/pea/recorded` how far every topic is complete; the plant never runs further ahead
than the publishers' history reaches back, so nothing can be lost.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import rclpy

from pea_core.config import NodeParams
from pea_core.loop import LoopFault
from pea_core.params import ParameterError, build, flatten, param, specs
from pea_ros import convert
from pea_ros import params as ros_params
from pea_ros.block_node import RECORDER, Inbox, Shell, run
from pea_ros.topics import RECORDED, RECORDED_TOPICS, SAMPLED, WINDOW
from pea_runtime.record.bag import BagWriter
from pea_runtime.record.definitions import DefinitionError

FLUSH_EVERY = 0.5
"""Seconds after which what was recorded is in the file."""

DRAIN_EVERY = 0.005
"""Seconds between two looks at the inboxes: cheaper than waking for each message."""


def tell(word: object) -> None:
    """Say how far it is, as long as somebody reads it."""
    try:
        print(word, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@dataclass(frozen=True)
class Params(NodeParams):
    """Parameters of the recorder."""

    out: str = param("", help="directory of the bag, made if missing", fixed=True)
    samples: int = param(
        0, "", 0, 2**40, help="end after so many samples; 0: when interrupted", fixed=True
    )


class RecorderNode(Shell):
    """Drains the loop's topics into a bag."""

    def __init__(self) -> None:
        super().__init__(RECORDER)
        self.params: Params = build(Params, ros_params.overrides(self.node), "recorder.")
        for name, spec in specs(Params).items():
            ros_params.declare(self.node, name, spec, flatten(Params, self.params)[name])
        if not self.params.out:
            raise ParameterError("out = '': give the bag's directory, -p out:=DIR")
        self.T_ns = self.params.T_ns
        try:
            self.bag = BagWriter(Path(self.params.out))
        except (OSError, DefinitionError) as error:
            raise ParameterError(f"out = {self.params.out!r}: {error}") from None
        self.taken = [self.inbox(topic) for topic in RECORDED_TOPICS]
        self.next = {topic.name: 0 for topic in SAMPLED}
        self.joined = {topic.name: False for topic in SAMPLED}
        self.recorded = self.outbox(RECORDED)
        self.flush_at = 0.0

    @property
    def stamp(self) -> int:
        """Loop time (ns) up to which every topic is recorded."""
        return self.k * self.T_ns

    def sampled(self, inbox: Inbox, data: bytes) -> None:
        """Record a message of a topic that has one for each sample."""
        name = inbox.topic.name
        stamp = convert.stamp(data)
        if not self.joined[name]:
            self.joined[name] = True
            self.next[name] = stamp // self.T_ns
            if stamp:
                self.log.warning(f"{name} joined at sample {self.next[name]}: the bag begins there")
        if stamp != self.next[name] * self.T_ns:
            raise LoopFault(
                f"{name}: expected sample {self.next[name]}, got {stamp / self.T_ns:g} "
                f"(stamp {stamp} ns): lost, sent twice, or another T_s"
            )
        self.next[name] += 1
        self.bag.write(inbox.topic, stamp, data)

    def drain(self) -> int:
        """Record all that has come; say how many messages."""
        count = 0
        for inbox in self.taken:
            sampled = inbox.topic in SAMPLED
            while (data := inbox.take()) is not None:
                count += 1
                if sampled:
                    self.sampled(inbox, data)
                else:
                    self.bag.write(inbox.topic, self.stamp, data)
        return count

    def run(self) -> None:
        """Record until the loop ends."""
        self.wait_for_peers()
        try:
            try:
                self.record()
            finally:
                self.finish()
        except OSError as error:
            raise LoopFault(
                f"{self.bag.path}: {error.strerror}: recorded up to sample {self.k}"
            ) from None
        tell(self.k)
        self.say(f"{self.k} samples in {self.bag.path}")

    def finish(self) -> None:
        """Close the bag, however often Ctrl-C comes meanwhile.

        Raises
        ------
        OSError
            Something could not be written.
        """
        for number in (signal.SIGINT, signal.SIGTERM):
            while signal.getsignal(number) is not signal.SIG_IGN:
                with contextlib.suppress(KeyboardInterrupt):
                    signal.signal(number, signal.SIG_IGN)
        self.bag.close()

    def record(self) -> None:
        """Drain the inboxes until the loop has `samples` or is ended."""
        said = -1
        tell("ready")
        while rclpy.ok() and not (self.params.samples and self.k >= self.params.samples):
            self.drain()
            self.k = min(self.next.values())
            now = time.monotonic()
            if self.k - said >= WINDOW // 8 or now >= self.flush_at:
                if now >= self.flush_at:
                    self.flush_at = now + FLUSH_EVERY
                    self.bag.flush()
                    self.serve()
                if self.k != said:
                    said = self.k
                    self.recorded.send(convert.encode_time(self.stamp))
                    tell(self.k)
            time.sleep(DRAIN_EVERY)


def main(args: list[str] | None = None) -> None:
    """Run ``ros2 run pea_runtime recorder``."""
    run(RecorderNode, RECORDER, args)
