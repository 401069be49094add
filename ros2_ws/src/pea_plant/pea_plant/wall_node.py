"""The plant's node in wall time: it paces, and drives a device or the simulated actuator.

Sample k is taken at its deadline: the newest command passes the gate, the driver exchanges it for
y_k, and y_k is published with the voltage applied until then. A command that comes late acts at
the next sample; one that does not come is held, and counted.

Loop time stands still where the gate is not active and the stage is at rest: nothing is
published, so no controller integrates in vain.
"""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import math
import os
import signal
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.lifecycle.node import LifecycleNodeMixin
from rclpy.node import Node
from std_srvs.srv import Trigger

from pea_core import pace
from pea_core.loop import LoopFault
from pea_core.params import ParameterError, param
from pea_plant import drivers, plant, safety
from pea_plant.drivers.driver import DriverError
from pea_plant.drivers.driver import within as within_device
from pea_plant.guard import Guard, guard
from pea_plant.safety import CLOCK, CONTROLLERS, DRIVER, EMERGENCY_STOP, Gate
from pea_ros import convert
from pea_ros import params as ros_params
from pea_ros.block_node import BlockNode
from pea_ros.convert import ConversionError
from pea_ros.shell import SERVE_EVERY, SETTLE
from pea_ros.topics import DISPLACEMENT, NAMESPACE, OWNED, RECORDED, REFERENCE, VOLTAGE

CHECK_EVERY = 0.05
"""Seconds between two questions whether the device found anything wrong."""

DIAL_EVERY = 0.2
"""Seconds between two attempts to reach a device that was lost."""

DIAL_FOR = 1.5
"""Seconds of such attempts at the end of a run."""

SPIN_NS = 50_000
"""How long before a deadline the sleep ends (ns): Python wakes some 40 us late."""

FIRST = 30.0
"""Seconds that loop time waits for the first command: the others may still get ready, and those
that are not the plant have no priority yet."""

JUMP = 1.0
"""Seconds beyond the period between two samples that are no delay any more."""

LIFECYCLE = "asked by a lifecycle service"

OK, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


@dataclass(frozen=True)
class Params(plant.Params):
    """The plant, and what paces it."""

    clock: str = param("wall", choices=("wall",), help="leave out for lock-step", fixed=True)


def wanted() -> bool:
    """Whether the parameters given to this process ask for wall time: by `clock`, or a device."""
    node = Node(
        "plant",
        namespace=NAMESPACE,
        automatically_declare_parameters_from_overrides=True,
        start_parameter_services=False,
        enable_rosout=False,
    )
    try:
        given = ros_params.overrides(node)
    finally:
        node.destroy_node()
    simulated = given.get("driver.type", drivers.CHOICE.default) == drivers.CHOICE.default
    return not simulated or "clock" in given


class Lifecycle(LifecycleNodeMixin):
    """Lifecycle services of a node that exists already.

    Parameters
    ----------
    owner : WallNode
        Told of each transition.
    """

    def __init__(self, owner: WallNode) -> None:
        node = owner.node
        self.handle, self.default_callback_group = node.handle, node.default_callback_group
        self._services = node._services
        self.owner = owner
        super().__init__()

    def close(self) -> None:
        """Give back the node's handle: else the middleware outlives it, and the interpreter."""
        self._state_machine.destroy_when_not_in_use()

    @property
    def active(self) -> bool:
        """Whether the node is active."""
        return bool(self._state_machine.current_state[1] == "active")

    def on_configure(self, state: Any) -> TransitionCallbackReturn:
        """Connect the driver; the gate goes inactive."""
        return self.owner.connect("configure")

    def on_activate(self, state: Any) -> TransitionCallbackReturn:
        """Let commands through, softly."""
        return OK if self.owner.gate.activate(self.owner.asker) else FAILURE

    def on_deactivate(self, state: Any) -> TransitionCallbackReturn:
        """Ramp to the safe voltage; after a trip the gate does so already."""
        self.owner.gate.deactivate(self.owner.asker)
        return OK

    def on_cleanup(self, state: Any) -> TransitionCallbackReturn:
        """Release the device, once the stage is at rest."""
        return self.owner.release("cleanup")

    def on_shutdown(self, state: Any) -> TransitionCallbackReturn:
        """End the node."""
        self.owner.ending = "shutdown"
        return OK


class WallNode(BlockNode):
    """Paces the loop in wall time, with a gate and a guard."""

    def __init__(self) -> None:
        super().__init__("plant", Params)
        self.simulated = isinstance(self.params.driver, drivers.Simulated)
        if not self.simulated:
            safety.refuse_unlimited(self.params)
        self.gate = Gate(self.params, self.T_s)
        self.driver: Any = drivers.make(self.driven(self.params), self.T_s)
        self.guard: Guard | None = None
        self.connected = False
        self.failure: Exception | None = None
        self.gate_failed = ""
        self.parameters.connect(self.check, self.adopt)
        self.voltage = self.inbox(VOLTAGE)
        self.reference = self.inbox(REFERENCE)
        self.inbox(RECORDED)  # it waits for nobody in wall time, but the recorder waits for it
        self.publishers.oversee(OWNED)
        self.chunks: deque[tuple[int, np.ndarray]] = deque()
        ideal = self.simulated and self.params.sensor.ideal
        self.codec = convert.DISPLACEMENT_IDEAL if ideal else convert.DISPLACEMENT
        self.displacement = self.outbox(DISPLACEMENT, self.codec.size)
        self.asker = "autostart"
        self.ending = ""
        self.y = math.nan
        self.answered = -1
        self.counts = SimpleNamespace(late=0, missing=0, overruns=0)
        self._told = dict(vars(self.counts))
        self.due = self.stepped = pace.now()
        self.check_at = self.dial_at = self.patient = 0.0
        self.lifecycle = Lifecycle(self)
        for name, handler in (("enable", self.enable), ("stop", self.stop), ("reset", self.reset)):
            self.node.create_service(Trigger, f"~/{name}", handler)

    def driven(self, params: Any) -> Any:
        """Parameters of the driver: the simulated actuator needs no second gate."""
        return dataclasses.replace(params, safety=safety.Params()) if self.simulated else params

    def check(self, params: Any) -> None:
        """Try new parameters: while active no limit is loosened, and none leaves the device's."""
        if self.gate.s.state == safety.ACTIVE:
            safety.refuse_looser(self.parameters.params, params)
        if self.simulated:
            self.driver.model.design(self.driven(params), self.T_s)
        else:
            safety.refuse_unlimited(params)
            if self.connected:
                self.within(params)

    def within(self, params: Any) -> None:
        """Refuse limits beyond those of the device."""
        low, high = params.voltage_min, params.voltage_max
        within_device(self.driver.limits, low, high, self.driver.identity)

    def adopt(self, params: Any) -> None:
        """Swap in new parameters between two samples."""
        self.gate.adopt(params)
        if self.simulated:
            self.driver.retune(self.driven(params))

    # States

    def connect(self, cause: str) -> TransitionCallbackReturn:
        """Connect the driver, start the guard, go inactive from the voltage there is."""
        try:
            self.driver.connect()
            if not self.simulated:
                self.within(self.params)
            measured = self.driver.read()
            self.connected = True
            self.watch()
        except (ParameterError, DriverError, OSError) as error:
            self.failure = error
            self.driver.close()
            self.connected = False
            return FAILURE
        self.y, u = measured.y, measured.u_applied
        self.log.info(f"{self.driver.identity}: {self.y * 1e6:.4f} um, {u:.3f} V")
        if not (self.gate.configure(u, cause) or self.gate.reset(u, cause)):
            return FAILURE
        return OK

    def watch(self) -> None:
        """Start the guard, before anything is commanded."""
        if self.guard is not None:
            self.guard.stand_down()
        make = lambda: drivers.make(self.params, self.T_s)  # noqa: E731
        c = self.gate.c
        self.guard, held = guard(make, self.driver, c, self.params.safety.slew_rate)
        if self.guard is not None:
            self.log.info(f"guard holds {held}")

    def lost(self, error: DriverError) -> None:
        """Leave the device to the guard, as the driver does not reach it; then try again."""
        self.connected = False
        if self.guard is not None:
            self.guard.fire()
        self.gate.trip(DRIVER, str(error))
        self.tell()
        if self.guard is None:
            self.log.error(f"{error}: no guard; the device holds its last voltage")
        elif not self.guard.done():
            self.log.error(f"{error}: the guard does not reach the device either")
        with contextlib.suppress(Exception):
            self.driver.close()
        self.dial_at = time.monotonic() + DIAL_EVERY

    def redial(self) -> None:
        """Try to reach the device again, only to bring it to its safe voltage."""
        try:
            self.driver.connect()
            self.gate.found(self.driver.read().u_applied)
            self.watch()
            self.connected = True
            self.say("the device is reached again")
        except (ParameterError, DriverError, OSError):
            self.driver.close()
            self.dial_at = time.monotonic() + DIAL_EVERY

    def release(self, cause: str) -> TransitionCallbackReturn:
        """Close the driver and end the guard, once the stage is at rest."""
        if self.connected and not self.gate.at_rest:
            return FAILURE
        if self.guard is not None:
            self.guard.stand_down()
            self.guard = None
        self.driver.close()
        self.connected = False
        self.gate.cleanup(cause)
        return OK

    # Services

    def enable(self, request: Any, response: Any) -> Any:
        """``~/enable``: from inactive to active."""
        if self.gate.state != "inactive":
            response.message = f"{self.gate.state}, {self.gate.reason}: must be inactive; " + (
                "call ~/reset first" if self.gate.state == "fault" else "nothing to do"
            )
        elif text := self.intruder(every=True):
            response.message = text
        else:
            self.asker = "asked by ~/enable"
            response.success = self.lifecycle.trigger_activate() == OK
            self.asker = LIFECYCLE
            response.message = self.gate.state
        return response

    def stop(self, request: Any, response: Any) -> Any:
        """``~/stop``: emergency stop, from whatever state."""
        response.success = self.gate.trip(EMERGENCY_STOP, "asked by ~/stop")
        response.message = f"{self.gate.state}: {self.gate.reason}"
        return response

    def reset(self, request: Any, response: Any) -> Any:
        """``~/reset``: from fault to inactive, with a new connection where the old one failed."""
        if self.gate.state != "fault":
            response.message = f"{self.gate.state}: there is no fault"
            return response
        if self.connected:
            self.gate.reset(self.gate.s.u, "asked by ~/reset")
        elif self.connect("asked by ~/reset") != OK:
            response.message = str(self.failure)
            return response
        response.success = True
        response.message = self.gate.state
        return response

    # One sample

    def newest(self) -> tuple[float, bool]:
        """The newest command (V), and whether one has come that is not stale."""
        u, fresh = math.nan, False
        for data in self.voltage.messages():
            try:
                stamp, _, _, u = self.read(VOLTAGE, convert.VOLTAGE.decode, data)
            except ConversionError as error:
                self.gate.trip(CONTROLLERS, str(error))
                continue
            k = stamp // self.T_ns
            if k <= self.answered:
                text = f"sample {k} is commanded twice: more than one controller"
                self.gate.trip(CONTROLLERS, text)
                continue
            self.answered = k
            age = self.k - 1 - k
            self.counts.late += age > 0
            stale = self.gate.c.stale
            fresh = not stale or age <= stale
        if not fresh and self.answered >= 0 and self.gate.state == "active":
            self.counts.missing += 1
        return u, fresh

    def desired(self) -> float:
        """Displacement desired at this sample (m), NaN where it is not known."""
        if not self.gate.c.following:
            return math.nan
        for data in self.reference.messages():
            try:
                stamp, _, points = self.read(REFERENCE, convert.REFERENCE.receive, data)
            except ConversionError as error:
                self.gate.trip(CONTROLLERS, str(error))
                continue
            self.chunks.append((stamp // self.T_ns, points[:, 0]))
        while self.chunks and self.chunks[0][0] + len(self.chunks[0][1]) <= self.k:
            self.chunks.popleft()
        if not self.chunks or self.k < self.chunks[0][0]:
            return math.nan
        first, w = self.chunks[0]
        return float(w[self.k - first])

    def pace(self) -> float:
        """Wait for the next deadline; periods since the last sample."""
        self.due += self.T_ns
        now = pace.wait_until(self.due, SPIN_NS)
        elapsed = (now - self.stepped) / self.T_ns
        if not 0.0 < elapsed <= 1.0 + JUMP / self.T_s:
            seconds = elapsed * self.T_s
            text = f"{seconds:.3g} s between two samples, {self.T_s + JUMP:g} s at most are a delay"
            self.gate.trip(CLOCK, text)
        if not 0.0 <= now - self.due <= self.T_ns:
            self.counts.overruns += 1
            self.due = now
        self.stepped = now
        return elapsed

    def tick(self) -> None:
        """One sample: gate, driver, displacement."""
        elapsed = self.pace()
        self.gate.stamp = self.stamp
        u, fresh = self.newest()
        v = self.gate.step(u, fresh, self.y, self.desired(), elapsed)
        if self.connected:
            if self.guard is not None:
                self.guard.tell(v)
            try:
                if self.gate.s.reason == DRIVER:  # it may refuse what it took before
                    os.write(self.driver.fileno(), self.driver.last_resort(v))
                measured = self.driver.exchange(v)
            except OSError as error:
                self.lost(DriverError(str(error)))
            except DriverError as error:
                self.lost(error)
            else:
                self.y = measured.y
                self.publish(measured)
        elif time.monotonic() >= self.dial_at:
            self.redial()
        if self.gate.s.state != safety.ACTIVE and self.lifecycle.active:
            self.lifecycle.trigger_deactivate()
        self.tell()

    def publish(self, measured: Any) -> None:
        """Send y_k, as long as loop time goes on; it does so from the first command on."""
        if not rclpy.ok() or (self.samples and self.k >= self.samples):
            return
        if self.gate.s.state == safety.ACTIVE or (self.k and not self.gate.at_rest):
            if self.k == 1:
                if self.answered < 0 and time.monotonic() < self.patient:
                    return
                self.log.info(f"loop starts, T_s = {self.T_s * 1e6:g} us, wall time")
            y, y_dot, u_applied = measured
            values = (y, u_applied) if math.isnan(y_dot) else (y, y_dot, u_applied)
            self.displacement.send(self.codec.encode(self.stamp, *values))
            self.k += 1

    def look(self) -> None:
        """What is due between two samples: services, the device's errors, other controllers."""
        now = time.monotonic()
        if now >= self._serve_at and rclpy.ok():
            self.serve()
            text = self.intruder(every=True)
            if text and self.gate.s.state == safety.ACTIVE:
                self.gate.trip(CONTROLLERS, text)
        if now >= self.check_at and self.connected:
            self.check_at = now + CHECK_EVERY
            try:
                self.driver.check()
            except DriverError as error:
                self.gate.trip(DRIVER, str(error))

    # Words

    def tell(self) -> None:
        """Tell every transition, in the log and on the diagnostics."""
        transitions, self.gate.transitions = self.gate.transitions, []
        for transition in transitions:
            bad = transition.after == "fault"
            text = f"{transition.before} -> {transition.after}: {transition.cause}"
            if rclpy.ok():
                if bad:
                    self.log.error(text)
                else:
                    self.log.info(text)
                level = DiagnosticStatus.ERROR if bad else DiagnosticStatus.OK
                self.status("safety", level, text, transition._asdict(), transition.stamp)

    def status(self, name: str, level: Any, text: str, values: dict[str, Any], stamp: int) -> None:
        """Publish one diagnostic."""
        message = DiagnosticArray()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
        pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        message.status = [
            DiagnosticStatus(
                level=level,
                name=f"pea: {self.name}: {name}",
                message=text,
                hardware_id=self.driver.identity or "pea",
                values=pairs,
            )
        ]
        self._diagnostics.publish(message)

    def _diagnose(self, now: float) -> None:
        super()._diagnose(now)
        self.count()

    def count(self) -> None:
        """Tell the gate's state, and what was late; warn where something was since last time."""
        counts = dict(vars(self.counts))
        level = DiagnosticStatus.OK if counts == self._told else DiagnosticStatus.WARN
        if self.gate.state == "fault":
            level = DiagnosticStatus.ERROR
        self._told = counts
        values = {"samples": self.k, "reason": self.gate.reason, **counts}
        self.status("gate", level, self.gate.state, values, self.stamp)

    # Life

    @contextlib.contextmanager
    def interrupts(self) -> Iterator[None]:
        """Take SIGINT and SIGTERM as a wish to end: the voltage is ramped down first."""

        def note(number: int, frame: object) -> None:
            self.ending = signal.Signals(number).name

        held = {n: signal.signal(n, note) for n in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in held.items():
                signal.signal(number, handler)

    def run(self) -> None:
        """Run the loop to its end."""
        if self.T_s >= pace.CALM:
            pace.hurry()
            pace.settle()  # the guard, too: it inherits the priority
        with self.interrupts():
            if self.lifecycle.trigger_configure() != OK:
                assert self.failure is not None
                raise self.failure
            try:
                self.rest()
                self.gather()
                if not self.ending:
                    self.lifecycle.trigger_activate()
                    self.asker = LIFECYCLE
                gc.freeze()
                self.due = self.stepped = pace.now()
                self.patient = time.monotonic() + FIRST
                while not self.ending:
                    self.tick()
                    fault = self.gate.s.state == safety.FAULT
                    if self.samples and (fault or self.k >= self.samples):
                        break  # before the recorder has all; after a fault, as nobody resets it
                    self.look()
            finally:
                self.end()
        if self.gate_failed:
            raise LoopFault(f"the safety gate has tripped: {self.gate_failed}")

    def gather(self) -> None:
        """Wait for the neighbours; the device holds the safe voltage meanwhile."""
        settle, since, said = (0.0 if self.with_recorder else SETTLE), time.monotonic(), [""]
        while not self.ending:
            lacking = self.missing(self.with_recorder)
            if lacking:
                since = time.monotonic()
                if lacking != said:
                    self.log.info("waiting for " + ", ".join(lacking))
                    said = lacking
            elif self._rely():
                since = time.monotonic()
            elif time.monotonic() - since >= settle:
                return
            self.serve(SERVE_EVERY)
            self.tell()

    def rest(self) -> None:
        """Ramp to the safe voltage; a device that is not reached is tried for a while."""
        self.due = self.stepped = pace.now()
        until = time.monotonic() + DIAL_FOR
        while not self.settled and (self.connected or time.monotonic() < until):
            self.tick()

    @property
    def settled(self) -> bool:
        """Whether the device has its safe voltage, as far as anybody knows."""
        return self.connected and self.gate.at_rest

    def end(self) -> None:
        """Ramp down, then release; tell what was not told."""
        self.gate_failed = self.gate.reason if self.gate.state == "fault" else ""
        self.gate.deactivate(self.ending or "the end of the run")
        self.rest()
        self.tell()
        counts = ", ".join(f"{n} {name}" for name, n in vars(self.counts).items())
        self.say(f"{self.k} samples done; {counts}")
        if rclpy.ok():
            self.count()
        self.release("the end of the run")
        self.tell()
        if rclpy.ok():
            self.deliver()

    def close(self) -> None:
        """Give back what the middleware holds."""
        self.lifecycle.close()
        super().close()
