"""Three nodes in a ring, as rclpy's tutorials write them: one of the three processes.

``python -m pea_bench.peers.ring ROLE SECONDS``: role 0 drives, prints the loops a second
and ends; the others forward until they are ended. SingleThreadedExecutor, JointState objects,
reliable, depth 10.
"""

from __future__ import annotations

import sys
import time

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState

SIZE = 3
WARM_UP = 0.5
"""Seconds that are not counted."""


class Hop(Node):
    """Forwards what comes; role 0 begins and counts."""

    def __init__(self, role: int, seconds: float) -> None:
        super().__init__(f"hop{role}")
        self.role, self.seconds = role, seconds
        self.k = self.counted_from = 0
        self.started = self.begun = 0.0
        self.rate = 0.0
        self.out = self.create_publisher(JointState, f"hop{role}", 10)
        self.create_subscription(JointState, f"hop{(role - 1) % SIZE}", self.forward, 10)
        if role == 0:
            self.starter = self.create_timer(0.05, self.begin)

    def message(self, k: int, x: float) -> JointState:
        """A new message for sample k."""
        message = JointState(name=["x"], position=[x], velocity=[0.0], effort=[x])
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(k * 50_000, 10**9)
        return message

    def begin(self) -> None:
        """Send the first message until it comes round: one sent before all are matched is lost."""
        self.out.publish(self.message(0, 0.0))

    def forward(self, message: JointState) -> None:
        """Send what came on; role 0 sends the next one."""
        x = message.position[0]
        stamp = message.header.stamp
        k = (stamp.sec * 10**9 + stamp.nanosec) // 50_000
        if self.role:
            self.out.publish(self.message(k, x + 1.0))
            return
        if k != self.k:
            return  # the first one, sent again
        now = time.monotonic()
        if not self.k:
            self.starter.cancel()
            self.started = now
        self.k += 1
        if not self.begun and now - self.started > WARM_UP:
            self.begun, self.counted_from = now, self.k
        if self.begun and now - self.begun > self.seconds:
            self.rate = (self.k - self.counted_from) / (now - self.begun)
        else:
            self.out.publish(self.message(self.k, x))


def main() -> None:
    """Run one node."""
    rclpy.init()
    hop = Hop(int(sys.argv[1]), float(sys.argv[2]))
    executor = SingleThreadedExecutor()
    executor.add_node(hop)
    try:
        while not hop.rate:
            executor.spin_once()
        print(hop.rate, flush=True)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    hop.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
