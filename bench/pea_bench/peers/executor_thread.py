"""A paced Python loop with an rclpy executor in another thread: the design to avoid.

``python -m pea_bench.peers.executor_thread SECONDS`` prints the share of missed deadlines
at 20 kHz. The loop computes nothing at all; beside it a node shows four topics 50 times a second.
"""

from __future__ import annotations

import os
import sys
import threading

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState

from pea_core.units import SECOND
from pea_engine import pace
from pea_run.deadlines import Deadlines

T_NS = 50_000
SHOW_EVERY = 0.02


def main() -> None:
    """Keep time for so long."""
    samples = round(float(sys.argv[1]) * SECOND / T_NS)
    rclpy.init()
    node = Node("beside")
    outs = [node.create_publisher(JointState, f"beside{i}", 10) for i in range(4)]

    def show() -> None:
        for out in outs:
            out.publish(JointState(name=["x"], position=[0.0], velocity=[0.0], effort=[0.0]))

    node.create_timer(SHOW_EVERY, show)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    beside = threading.Thread(target=executor.spin, daemon=True)
    beside.start()
    times = np.zeros((samples, 2), np.int64)
    with pace.memory_locked(), pace.awake(), pace.brisk():
        pace.settle()
        t_0 = pace.now() + T_NS
        for k in range(samples):
            due = t_0 + k * T_NS
            times[k, 0] = pace.wait_until(due, pace.SPIN_NS) - due
            times[k, 1] = pace.now() - due
    deadlines = Deadlines(T_NS)
    deadlines.add(times)
    print(deadlines.missed / deadlines.samples, flush=True)
    os._exit(0)  # the executor may be publishing: nothing waits for it


if __name__ == "__main__":
    main()
