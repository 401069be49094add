"""The naive ring (`ring`) by the nodes' own fast way: one of the three processes.

``python -m pea_bench.peers.fast_ring ROLE SECONDS CPU``: what the way alone takes, without
any block's arithmetic and without a recording.
"""

from __future__ import annotations

import os
import sys
import time

import rclpy
from rclpy.node import Node

from pea_bench.peers.ring import SIZE, WARM_UP
from pea_ros.transport import Inbox, Outbox
from pea_wire import convert
from pea_wire.convert import JointState
from pea_wire.topics import JOINT_STATE, Topic

PATIENCE = 0.05
"""Seconds after which a message that has not come round is sent again."""


class Hop:
    """One of the three.

    Parameters
    ----------
    role : int
        0 to 2; hears of the role before.
    """

    def __init__(self, role: int) -> None:
        node = Node(f"fast_hop{role}")
        topics = [Topic(f"/fast_hop{i}", JOINT_STATE, 10, "", ()) for i in range(SIZE)]
        self.k = 0
        self.out = Outbox(node, topics[role])
        self.inbox = Inbox(node, topics[role - 1], best_effort=True)

    def take(self) -> JointState | None:
        """Wait for a message, some time."""
        self.inbox.wait(PATIENCE)
        data = self.inbox.take()
        return None if data is None else convert.forms().state.decode(data)

    def forward(self) -> None:
        """Send on what comes."""
        come = self.take()
        if come is not None:
            self.out.send(convert.forms().state.encode(come.stamp, come.position + 1.0, 0.0, 0.0))

    def round(self) -> None:
        """Send a message until it comes round: one that is sent before all are matched is lost."""
        come = None
        while come is None or come.stamp != self.k:
            if come is None:
                self.out.send(convert.forms().state.encode(self.k, 0.0, 0.0, 0.0))
            come = self.take()
        self.k += 1

    def rate(self, seconds: float) -> float:
        """Rounds a second."""
        began, first = time.monotonic(), self.k
        while time.monotonic() - began < seconds:
            self.round()
        return (self.k - first) / (time.monotonic() - began)


def main() -> None:
    """Run one process."""
    role, seconds, cpu = int(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])
    rclpy.init()
    hop = Hop(role)
    if cpu >= 0:
        for thread in os.listdir("/proc/self/task"):
            os.sched_setaffinity(int(thread), {cpu})
            os.sched_setscheduler(int(thread), os.SCHED_BATCH, os.sched_param(0))
    if role == 0:
        hop.round()
        hop.rate(WARM_UP)
        print(hop.rate(seconds), flush=True)
    else:
        while rclpy.ok():
            hop.forward()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
