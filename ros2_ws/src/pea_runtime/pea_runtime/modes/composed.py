"""One process, one loop; beside it the ROS nodes of its blocks.

The loop knows nothing of ROS. Between two pieces of it, the blocks' parameters are served and
every topic shows its latest sample; the recording has them all.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from pea_core.block import Block, Signal
from pea_core.compiled import wanted
from pea_core.config import NODES
from pea_core.loop import Loop
from pea_core.params import flatten
from pea_ros import convert, events
from pea_ros.block_node import Outbox, environment
from pea_ros.params import BlockParameters, ros_value
from pea_ros.topics import (
    DISPLACEMENT,
    NAMESPACE,
    PARAMETER_EVENTS,
    REFERENCE,
    STATE,
    VOLTAGE,
)
from pea_runtime.experiments import SCHEMAS, Experiment
from pea_runtime.record.bag import BagWriter
from pea_runtime.record.origin import ORIGIN, origin
from pea_runtime.record.rows import NOTHING, ahead, record

PIECE = 100
"""Samples between two looks at ROS."""

SHOW_EVERY = 0.02
"""Seconds between two samples shown on the topics."""


class _Beside:
    """The ROS side: one node a block, with its parameters and its topic."""

    def __init__(self, experiment: Experiment, loop: Loop, bag: BagWriter) -> None:
        self.T_ns = experiment.T_ns
        self.loop = loop
        self.bag = bag
        self.executor = SingleThreadedExecutor()
        self.nodes: dict[str, Node] = {}
        blocks = dict(
            zip(NODES, (loop.plant, loop.observer, loop.controller, loop.reference), strict=True)
        )
        for name, block in blocks.items():
            values = experiment.nodes[name].values
            node = Node(
                name,
                namespace=NAMESPACE,
                use_global_arguments=False,
                automatically_declare_parameters_from_overrides=True,
                parameter_overrides=[
                    Parameter(key, value=ros_value(value)) for key, value in values.items()
                ],
            )
            assert isinstance(block, Block | Signal)
            parameters = BlockParameters(node, name, SCHEMAS[name], dict(values))
            parameters.connect(block.try_design, self._swap(name, block))
            self.executor.add_node(node)
            self.nodes[name] = node
        ideal = experiment.nodes["plant"].params.sensor.ideal
        self.measured = convert.DISPLACEMENT_IDEAL if ideal else convert.DISPLACEMENT
        self.shown = {
            topic.name: Outbox(self.nodes[topic.publisher], topic)
            for topic in (DISPLACEMENT, STATE, VOLTAGE, REFERENCE)
        }

    def _swap(self, name: str, block: Block | Signal) -> Callable[[Any], None]:
        """What takes a block's new parameters: it records them, too."""
        schema = SCHEMAS[name]

        def swap(params: Any) -> None:
            old, new = flatten(schema, block.params), flatten(schema, params)
            changed = {key: value for key, value in new.items() if old.get(key) != value}
            block.retune(params)
            if changed:
                stamp = self.loop.k * self.T_ns
                event = events.encode(stamp, f"{NAMESPACE}/{name}", changed)
                self.bag.write(PARAMETER_EVENTS, stamp, event)

        return swap

    def serve(self) -> None:
        """Serve the parameters of every node."""
        self.executor.spin_once(timeout_sec=0.0)

    def show(self, k: int, row: np.void) -> None:
        """Publish one sample on every topic."""
        stamp = k * self.T_ns
        measured = (row["y"], row["y_dot"], row["u_applied"])
        self.shown[DISPLACEMENT.name].send(
            self.measured.encode(stamp, *(v for v in measured if not math.isnan(v)))
        )
        self.shown[STATE.name].send(
            convert.STATE.encode(stamp, row["x1_hat"], row["x2_hat"], row["eps_hat"])
        )
        self.shown[VOLTAGE.name].send(convert.VOLTAGE.encode(stamp, row["u"]))
        point = np.array([[row["w"], row["w_dot"], row["w_ddot"]]])
        self.shown[REFERENCE.name].send(convert.REFERENCE.encode(stamp, self.T_ns, point))

    def close(self) -> None:
        """Give back what the middleware holds."""
        self.executor.shutdown()
        for node in self.nodes.values():
            node.destroy_node()


@contextlib.contextmanager
def _beside(experiment: Experiment, loop: Loop, bag: BagWriter) -> Iterator[_Beside]:
    environment()
    rclpy.init(args=[], signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    try:
        beside = _Beside(experiment, loop, bag)
        try:
            yield beside
        finally:
            beside.close()
    finally:
        rclpy.try_shutdown()


def run(experiment: Experiment, out: Path, progress: Callable[[int], None]) -> None:
    """Run an experiment and record it in `out`.

    Raises
    ------
    LoopFault
        The loop cannot go on; what came before is recorded.
    """
    loop = experiment.loop(wanted(experiment.samples))
    show_at = 0.0
    T_ns = experiment.T_ns
    with BagWriter(out, T_ns) as bag, _beside(experiment, loop, bag) as beside:
        bag.metadata(ORIGIN, origin(experiment.name, experiment.sections(), "composed", T_ns))
        while loop.k < experiment.samples:
            k = loop.k
            rows = loop.run(min(PIECE, experiment.samples - k))
            ends = loop.fault or loop.k == experiment.samples
            record(bag, k, T_ns, rows, ahead(loop) if ends else NOTHING)
            progress(loop.k)
            if loop.fault:
                raise loop.fault
            now = time.monotonic()
            if now >= show_at:
                show_at = now + SHOW_EVERY
                beside.show(loop.k - 1, rows[-1])
                beside.serve()
