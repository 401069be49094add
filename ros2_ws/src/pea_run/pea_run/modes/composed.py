"""One process, one loop; beside it the ROS nodes of its blocks.

The loop knows nothing of ROS. Unpaced, it runs as fast as it can; between two pieces of it, the
blocks' parameters are served and every topic shows its latest sample. In wall time it has a
thread of its own (`pea_engine.wall`), and this one does the same beside it. The recording has all
samples.
"""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from pea_controller.model.common import followed, limits, within
from pea_core.axes import per_axis
from pea_core.config import COMPOSED, NODES, Source, flat, own_of
from pea_core.loop import CHUNK, LoopFault
from pea_core.params import ParameterError, flatten
from pea_core.signals import KINDS
from pea_engine import pace
from pea_engine.compiled import WORTH, wanted
from pea_engine.wall import Change, WallLoop
from pea_experiment.checks import admit
from pea_experiment.experiment import SCHEMAS, AnyExperiment, Experiment
from pea_lab.guard import altered, guard
from pea_plant import drivers
from pea_plant.driven import Driven
from pea_plant.rig import SOFT_START, Rig
from pea_record.bag import WHOLE, BagWriter, Split
from pea_record.nowhere import Nowhere
from pea_record.origin import ORIGIN, origin
from pea_record.rows import NOTHING, Trip, ahead, record
from pea_record.trigger import Trigger as RecordTrigger
from pea_record.trigger import opened
from pea_ros.context import context, serve_once
from pea_ros.params import BlockParameters, ros_value
from pea_ros.publishers import Publishers
from pea_ros.transport import Outbox
from pea_run.deadlines import Deadlines
from pea_run.modes.detector import signal_of
from pea_run.modes.telemetry import Telemetry
from pea_wire import diagnostics, events
from pea_wire.topics import (
    DIAGNOSTICS,
    DISPLACEMENT,
    NAMESPACE,
    PARAMETER_EVENTS,
    REFERENCE,
    STATE,
    VOLTAGE,
)

PIECE = 100
"""Samples between two looks at ROS."""

SERVE_EVERY = 0.02
"""Seconds between two looks at the ring and at ROS."""


DIAGNOSE_EVERY = 1.0
"""Seconds between two diagnostics."""

Bag = BagWriter | Nowhere

Swap = Callable[[str, Any], None]
"""Takes the name of a block and its new parameters."""


class _Beside:
    """The ROS side: one node a block, with its parameters and its topic."""

    def __init__(
        self,
        experiment: AnyExperiment,
        blocks: Mapping[str, Any],
        bag: Bag,
        swap: Swap,
        namespace: str = NAMESPACE,
    ) -> None:
        self.namespace = namespace
        self.T_ns = experiment.T_ns
        self.bag = bag
        self.experiment = experiment
        self.blocks = blocks
        self.executor = SingleThreadedExecutor()
        self.nodes: dict[str, Node] = {}
        self.parameters: dict[str, BlockParameters] = {}
        sections = experiment.sections()
        for name in blocks:
            values = sections[name]
            node = Node(
                name,
                namespace=namespace,
                use_global_arguments=False,
                allow_undeclared_parameters=True,  # another type may have others
                automatically_declare_parameters_from_overrides=True,
                parameter_overrides=[
                    Parameter(key, value=ros_value(value)) for key, value in values.items()
                ],
            )
            parameters = BlockParameters(node, name, SCHEMAS[name], [Source(values)])
            take = partial(self._follow, swap) if name == "plant" else partial(swap, name)
            parameters.connect(partial(self._check, name), take)
            self.parameters[name] = parameters
            self.executor.add_node(node)
            self.nodes[name] = node
        self.publishers = Publishers(self.nodes["plant"])
        self.publishers.oversee((DISPLACEMENT, STATE, VOLTAGE, REFERENCE))
        self.warned = False
        self.telemetry = Telemetry(self.nodes, self.T_ns, experiment.axes, experiment.scan_events)
        self.diagnostics = Outbox(self.nodes["plant"], DIAGNOSTICS)
        self.events = Outbox(self.nodes["plant"], PARAMETER_EVENTS)

    def _check(self, name: str, params: Any) -> None:
        """Refuse parameters that cannot be used, or that are not to be.

        Raises
        ------
        ParameterError
            Which, and why.
        """
        self.blocks[name].try_design(params)
        for i, (own, new) in enumerate(zip(self.experiment.each, per_axis(params), strict=True)):
            running = {each: per_axis(block.planned)[i] for each, block in self.blocks.items()}
            if new != running[name]:
                self._check_axis(own, running, name, new)

    def _check_axis(
        self, experiment: Experiment, running: Mapping[str, Any], name: str, params: Any
    ) -> None:
        """Refuse parameters of one axis."""
        several = len(self.experiment.axes) > 1
        try:
            if name == "controller":
                plant = self.parameters["plant"]
                within(params, limits(own_of(plant.axes, experiment.axis, plant.values)))
            admit(altered(experiment, {**running, name: params}))
            guard(experiment, running, name, params, self.nodes[name].get_logger().warning)
        except ParameterError as error:
            raise ParameterError(f"{experiment.axis}: {error}" if several else str(error)) from None

    def _follow(self, swap: Swap, params: object) -> None:
        """Have the plant take new parameters, and the controller the limits among them."""
        swap("plant", params)
        controller, found = self.parameters["controller"], []
        for own, plant in zip(self.experiment.each, per_axis(params), strict=True):
            values = own_of(controller.axes, own.axis, controller.values)
            live = own_of(controller.axes, own.axis, dict.fromkeys(controller.live))
            given = own.nodes["controller"].given | live.keys()
            found.append(followed(values, flatten(SCHEMAS["plant"], plant), given))
        controller.adopt(flat(controller.axes, found))

    def note(self, change: Change) -> None:
        """Record new parameters, and tell from which sample on they count."""
        old, new = (
            flat(
                self.experiment.axes,
                [flatten(SCHEMAS[change.name], own) for own in per_axis(params)],
            )
            for params in (change.old, change.new)
        )
        changed = {key: value for key, value in new.items() if old.get(key) != value}
        if changed and (author := self.parameters[change.name].changed_by):
            changed["changed_by"] = author
        if changed:
            stamp = change.k * self.T_ns
            self.events.send(events.encode(stamp, f"{self.namespace}/{change.name}", changed))
            kept = events.encode(stamp, f"{NAMESPACE}/{change.name}", changed)
            self.bag.write(PARAMETER_EVENTS, stamp, kept)

    def serve(self, wait: float = 0.0) -> None:
        """Serve the parameters of every node; wait for a request so long (s)."""
        warn = self.nodes["plant"].get_logger().warning
        serve_once(self.executor, wait, warn)
        if not self.warned and (text := self.publishers.intruder([])):
            self.warned = True
            warn(f"{text}; the loop takes nothing from the graph, who watches it is misled")

    def diagnose(self, k: int, deadlines: Deadlines, missed: int, backlog: int) -> None:
        """Publish and record how the deadlines are kept, and what is not recorded yet.

        Parameters
        ----------
        k : int
            Samples done.
        deadlines : Deadlines
        missed : int
            Deadlines missed since the last time.
        backlog : int
            Samples that wait to be recorded.
        """
        text = f"{missed} deadlines missed" if missed else "every deadline kept"
        values = {key: f"{value:.6g}" for key, value in deadlines.figures().items()}
        level = diagnostics.WARN if missed else diagnostics.OK
        stamp = k * self.T_ns
        counts = {"samples": k, "backlog_samples": backlog}
        self._tell(diagnostics.encode, stamp, "loop", level, text, {**counts, **values})

    def safety(self, k: int, rig: Rig) -> None:
        """Publish and record every transition of the gate, and what it says now."""
        gate = rig.gate
        transitions, gate.transitions = gate.transitions, []
        for transition in transitions:
            self._tell(diagnostics.transition, *transition)
        level = diagnostics.of_gate(gate.state)
        stamp = k * self.T_ns
        values = {"reason": gate.reason, SOFT_START: f"{rig.soft_start:.6g}"}
        self._tell(diagnostics.encode, stamp, "plant: gate", level, gate.state, values)

    def _tell(self, encode: Callable[..., bytes], stamp: int, *words: object) -> None:
        """Publish one diagnostic, and record it as of the default namespace."""
        self.diagnostics.send(encode(stamp, *words, space=self.namespace.strip("/")))
        self.bag.write(DIAGNOSTICS, stamp, encode(stamp, *words))

    def stoppable(self, plant: Driven) -> None:
        """Serve ``/pea/plant/stop``: the emergency stop of a device, answered with what it did."""

        def stop(request: object, response: Any) -> Any:
            response.success, response.message = plant.stop("asked by ~/stop")
            return response

        self.nodes["plant"].create_service(Trigger, "~/stop", stop)

    def close(self) -> None:
        """Give back what the middleware holds."""
        with pace.ordinary():
            self.executor.shutdown()
            for node in self.nodes.values():
                node.destroy_node()


@contextlib.contextmanager
def nodes_beside(
    experiment: AnyExperiment,
    blocks: Mapping[str, Any],
    bag: Bag,
    swap: Swap,
    namespace: str,
) -> Iterator[_Beside]:
    """Nodes of the blocks beside a loop in this process, until the block ends."""
    with context():
        beside = _Beside(experiment, blocks, bag, swap, namespace)
        try:
            yield beside
        finally:
            beside.close()


def run(
    experiment: AnyExperiment,
    out: Path,
    progress: Callable[[int], None],
    wall: bool = False,
    cpu: int | None = None,
    split: Split = WHOLE,
    recorded: bool = True,
    namespace: str = NAMESPACE,
    trigger: RecordTrigger | None = None,
) -> Deadlines | None:
    """Run an experiment and record it in `out`.

    Parameters
    ----------
    experiment : Experiment
    out : Path
        Directory of the run.
    progress : callable
        Told how many samples are done.
    wall : bool
        One sample each T_s of wall time, instead of as fast as it goes.
    cpu : int, optional
        Core for the loop in wall time.
    split : Split
        When the recording goes on in a new file.
    recorded : bool
        False: nothing is recorded.
    namespace : str
        Where its nodes are.
    trigger : pea_record.trigger.Trigger, optional
        Only its windows are recorded.

    Returns
    -------
    Deadlines or None
        How they were kept in wall time.

    Raises
    ------
    LoopFault
        The loop cannot go on; what came before is recorded.
    """
    T_ns, events = experiment.T_ns, experiment.scan_events
    with opened(out, T_ns, split, trigger, events) if recorded else Nowhere() as bag:
        bag.metadata(
            ORIGIN,
            origin(experiment.name, experiment.sections(), COMPOSED, experiment.T_ns),
        )
        if wall:
            return _in_wall_time(experiment, bag, progress, cpu, namespace)
        _unpaced(experiment, bag, progress, namespace)
        return None


def _unpaced(
    experiment: AnyExperiment, bag: Bag, progress: Callable[[int], None], namespace: str
) -> None:
    """Run as fast as it goes."""
    loop = experiment.loop(wanted(experiment.samples))
    blocks: dict[str, Any] = dict(
        zip(NODES, (loop.plant, loop.observer, loop.controller, loop.reference), strict=True)
    )

    def swap(name: str, params: object) -> None:
        old = blocks[name].planned
        blocks[name].retune(params)
        beside.note(Change(loop.k, name, old, params))

    T_ns = experiment.T_ns
    trip, detect = Trip(bag, loop.plant), signal_of(experiment)
    serve_at = 0.0
    with nodes_beside(experiment, blocks, bag, swap, namespace) as beside:
        while loop.k < experiment.samples:
            k = loop.k
            rows = loop.run(min(PIECE, experiment.samples - k))
            ends = loop.fault or loop.k == experiment.samples
            after = ahead(loop) if ends else NOTHING
            detected = detect(rows)
            found = (experiment.axes, experiment.scan_events, detected)
            record(bag, k, T_ns, rows, after, *found)
            trip.look()
            beside.telemetry.add(k, rows, bool(ends), detected)
            progress(loop.k)
            if loop.fault:
                raise loop.fault
            now = time.monotonic()
            if now >= serve_at:
                serve_at = now + SERVE_EVERY
                beside.serve()


@contextlib.contextmanager
def _interrupts() -> Iterator[list[int]]:
    """Collect SIGINT and SIGTERM, which then end nothing by themselves."""
    came: list[int] = []
    held: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            held[int(number)] = signal.signal(number, lambda number, frame: came.append(number))
    try:
        yield came
    finally:
        for signum, handler in held.items():
            signal.signal(signum, handler)


def _device(experiment: AnyExperiment, reference: Any) -> Driven | None:
    """The plant's device, not connected; None where the plant is simulated.

    Raises
    ------
    ParameterError
        A rig's limit is missing, or the driver cannot be designed.
    """
    each = tuple(one.nodes["plant"].params for one in experiment.each)
    if isinstance(each[0].driver, drivers.Simulated):
        return None
    made: Driven
    if len(each) == 1:
        made = drivers.driven(each[0], experiment.T_s, lambda k: reference.at(k).w)
    else:  # a tuple of all axes each
        made = drivers.driven(
            each,
            experiment.T_s,
            lambda k: tuple(point.w for point in reference.at(k)),
            experiment.axes,
        )
    kind = getattr(each[0].driver, "trigger", "none")
    if kind != "none":
        made.marked = _marked(experiment, kind)
    return made


def _marked(experiment: AnyExperiment, kind: str) -> Callable[[int], bool]:
    """Whether an event of a kind begins at a sample.

    Raises
    ------
    ParameterError
        Nothing is scanned.
    """
    scanned = experiment.scan_events
    if scanned is None:
        raise ParameterError(
            f"driver.trigger = {kind!r}: {experiment.name} is no scan and has no events; "
            "leave it out"
        )
    known: set[int] = set()
    end, number = 0, KINDS.index(kind)

    def marked(k: int) -> bool:
        nonlocal known, end
        if k >= end:
            found = scanned(k, k + CHUNK)
            known, end = set(found["k"][found["kind"] == number].tolist()), k + CHUNK
        return k in known

    return marked


@contextlib.contextmanager
def _connected(device: Driven | None) -> Iterator[None]:
    """Connect a device; at the end ramp it to its safe voltage and release it."""
    if device is None:
        yield
        return
    device.connect()
    try:
        yield
    finally:
        device.close()


def _in_wall_time(
    experiment: AnyExperiment,
    bag: Bag,
    progress: Callable[[int], None],
    cpu: int | None,
    namespace: str,
) -> Deadlines:
    """Run one sample each T_s of wall time."""
    T_ns = experiment.T_ns
    made = experiment.loop()
    device = _device(experiment, made.reference)
    with (
        pace.memory_locked() as locked,
        pace.awake(),
        pace.brisk(),
        pace.apart(cpu),
    ):
        loop = WallLoop(
            device or made.plant,
            made.observer,
            made.controller,
            made.reference,
            T_ns,
            experiment.samples,
            cpu,
            wanted(WORTH) and (device is None or device.compiled),
        )
        hangs: Callable[[], bool] = bool if device is None else device.hangs
        scanned, detect = experiment.scan_events, signal_of(experiment, device)
        deadlines, exchanges = Deadlines(T_ns), Deadlines(T_ns)
        diagnose_at, told = time.monotonic() + DIAGNOSE_EVERY, 0
        done = 0
        with (
            nodes_beside(experiment, loop.blocks, bag, loop.change, namespace) as beside,
            _interrupts() as interrupts,
            _connected(device),
            pace.prompt(),
        ):
            if device is not None:
                beside.stoppable(device)
            progress(0)
            started, used = time.monotonic(), time.process_time()
            loop.start()
            try:
                while True:
                    ended = not loop.alive or hangs()
                    piece = loop.take(leave=0 if ended else 1)
                    after = loop.ahead() if ended else NOTHING
                    detected = detect(piece.rows)
                    found = (experiment.axes, scanned, detected)
                    record(bag, piece.k, T_ns, piece.rows, after, *found)
                    deadlines.add(piece.times)
                    if device is not None:
                        device.look()
                        took = device.took(piece.k, len(piece.rows))
                        exchanges.add(np.column_stack((took, took)))
                    loop.feed()
                    for change in loop.changes():
                        beside.note(change)
                    done = piece.k + len(piece.rows)
                    beside.telemetry.add(piece.k, piece.rows, ended, detected)
                    if len(piece.rows):
                        progress(done)
                    if ended or time.monotonic() >= diagnose_at:
                        beside.diagnose(done, deadlines, deadlines.missed - told, loop.waiting)
                        if device is not None:
                            beside.safety(done, device.rig)
                        diagnose_at, told = time.monotonic() + DIAGNOSE_EVERY, deadlines.missed
                    if ended:
                        break
                    if interrupts:
                        loop.stop(hangs)
                    else:
                        beside.serve(SERVE_EVERY)
            finally:
                ended = loop.stop(hangs)
                lost = 0 if device is None else device.lost
                if device is None:
                    Trip(bag, made.plant).look()
                else:
                    if ended:
                        device.close()
                    else:
                        device.rig.abandon()
                    beside.safety(done, device.rig)
            cores = (time.process_time() - used) / (time.monotonic() - started)
        if not ended:
            assert device is not None
            raise LoopFault(f"the safety gate has tripped: {device.rig.gate.cause}")
        if loop.fault:
            raise loop.fault
        if interrupts:
            raise KeyboardInterrupt
    assert loop.standing is not None
    deadlines.conditions = {
        **loop.standing._asdict(),
        "memory_locked": locked,
        "cpu": cpu,
        "cores": cores,
    }
    if exchanges.samples:
        deadlines.conditions |= {**exchanges.exchange(), "lost_by_device": lost}
    return deadlines
