"""The plant's node in wall time: it paces, and drives a device or the simulated actuator.

Sample k is taken at its deadline: the newest command passes the gate, the driver exchanges it for
y_k, and y_k is published with the voltage applied until then. A command that comes late acts at
the next sample; one that does not come is held, and counted.

Loop time stands still where the gate is not active and the stage is at rest, so no controller
integrates in vain. The displacement is then published all the same, marked, now and then.
"""

from __future__ import annotations

import contextlib
import gc
import math
import signal
import time
from collections import deque
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import rclpy
from lifecycle_msgs.msg import Transition
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.lifecycle.node import LifecycleNodeMixin
from std_srvs.srv import Trigger

from pea_core.axes import POINT, in_fields, per_axis
from pea_core.loop import LoopFault
from pea_core.params import ParameterError, param
from pea_engine import pace
from pea_plant import drivers, gate, plant
from pea_plant.alarm import breaking
from pea_plant.driven import Between
from pea_plant.gate import CONTROLLERS
from pea_plant.rig import SOFT_START, Rig
from pea_ros import params as ros_params
from pea_ros.block_node import BlockNode
from pea_ros.shell import SERVE_EVERY, SETTLE, Given
from pea_ros.transport import Outbox
from pea_wire import convert, diagnostics
from pea_wire.convert import ConversionError
from pea_wire.topics import DISPLACEMENT, FOLLOWED, NAMESPACE, OWNED, RECORDED, SIGNAL, VOLTAGE

SPIN_NS = 50_000
"""How long before a deadline the sleep ends (ns): Python wakes some 40 us late."""

FIRST = 30.0
"""Seconds that loop time waits for the first command: the others may still get ready, and those
that are not the plant have no priority yet."""

SHOW_EVERY = 0.05
"""Seconds between two displacements while loop time stands still."""

END = object()
"""No further piece of what is due."""

CONFIGURE = ("configure", Transition.TRANSITION_CONFIGURE)
"""Label and number of a lifecycle transition."""

AUTOSTART, LIFECYCLE = "autostart", "asked by a lifecycle service"

OK, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


@dataclass(frozen=True)
class Params(plant.Params):
    """The plant, and what paces it."""

    clock: str = param("wall", choices=("wall",), help="leave out for lock-step", fixed=True)


def wanted() -> bool:
    """Whether the parameters given to this process ask for wall time: by `clock`, or a device."""
    node = Given(
        "plant",
        namespace=NAMESPACE,
        automatically_declare_parameters_from_overrides=True,
        start_parameter_services=False,
        enable_rosout=False,
    )
    try:
        given = ros_params.overrides(node)
    finally:
        with pace.ordinary():
            node.destroy_node()
    return asked(given)


def asked(given: Mapping[str, object]) -> bool:
    """The same of parameters by name: a driver may be one axis's alone (``x.driver.type``)."""
    kinds = {v for name, v in given.items() if f".{name}".endswith(".driver.type")}
    return bool(kinds - {drivers.CHOICE.default}) or "clock" in given


class _Turn:
    """Lets the executor serve the others once."""

    def __await__(self) -> Generator[None, None, None]:
        yield


class Lifecycle(LifecycleNodeMixin):
    """Lifecycle services of a node that exists already.

    Parameters
    ----------
    owner : WallNode
        Told of each transition.
    """

    def __init__(self, owner: WallNode) -> None:
        node = owner.node
        self.handle, self.default_callback_group = node.handle, ReentrantCallbackGroup()
        self._services = node._services
        self.owner = owner
        super().__init__()
        for service in self._services:
            if service.srv_name.endswith("/change_state"):
                service.callback = self._asked(service.callback)

    def _asked(self, change: Any) -> Any:
        """Take note of who manages the node; refuse what the state does not allow.

        Nobody else waits while the device is connected.
        """

        async def answer(request: Any, response: Any) -> Any:
            self.owner.managed = True
            asked = request.transition
            if (asked.label or asked.id) in CONFIGURE and self.state == "unconfigured":
                with contextlib.suppress(ParameterError):  # the transition meets and tells it
                    self.owner.rig.begin()
                while self.owner.rig.reaching:
                    await _Turn()
            try:
                return change(request, response)
            except rclpy_implementation.RCLError:  # rclpy would end the node
                response.success = False
                return response

        return answer

    def close(self) -> None:
        """Give back the node's handle: else the middleware outlives it, and the interpreter."""
        self._state_machine.destroy_when_not_in_use()

    @property
    def state(self) -> str:
        """Name of the state."""
        return str(self._state_machine.current_state[1])

    def on_configure(self, state: object) -> TransitionCallbackReturn:
        """Connect the driver; the gate goes inactive."""
        return OK if self.owner.connect("configure") else FAILURE

    def on_activate(self, state: object) -> TransitionCallbackReturn:
        """Let commands through, softly."""
        owner = self.owner
        if refusal := owner.rig.refusal():
            owner.say(f"not activated: {refusal}")
            return FAILURE
        return OK if owner.gate.activate(owner.asker) else FAILURE

    def on_deactivate(self, state: object) -> TransitionCallbackReturn:
        """Ramp to the safe voltage; after a trip the gate does so already."""
        self.owner.gate.deactivate(self.owner.asker)
        return OK

    def on_cleanup(self, state: object) -> TransitionCallbackReturn:
        """Release the device, once the stage is at rest."""
        owner = self.owner
        if owner.rig.release("cleanup"):
            return OK
        why = "the stage is not at rest" if owner.rig.connected else owner.rig.unreached
        owner.say(f"not released: {why}")
        return FAILURE

    def on_shutdown(self, state: object) -> TransitionCallbackReturn:
        """End the node."""
        self.owner.gate.deactivate("shutdown")
        self.owner.ending = "shutdown"
        return OK


class WallNode(BlockNode):
    """Paces the loop in wall time, over a rig."""

    def __init__(self) -> None:
        super().__init__("plant", Params)
        several = len(self.axes) > 1
        trigger = getattr(per_axis(self.params)[0].driver, "trigger", "none")
        if trigger != "none":
            raise ParameterError(
                f"driver.trigger = {trigger!r}: the plant's node is not told a scan's events; run "
                "the loop in one process (pea run --mode composed --clock wall), or leave it out"
            )
        self.rig = Rig(self.params, self.T_s, tell=self.tell, axes=self.axes if several else ())
        self.matrices = Between(self.params) if several else None
        self.gate = self.rig.gate
        self.gate_failed = ""
        self.parameters.connect(self.rig.check, self.rig.adopt)
        self.voltage = self.inbox(VOLTAGE)
        self.following = self.inbox(FOLLOWED)
        self.inbox(RECORDED)  # it waits for nobody in wall time, but the recorder waits for it
        self.publishers.oversee(OWNED)
        self.chunks: deque[tuple[int, np.ndarray]] = deque()
        ideal = self.rig.simulated and any(own.sensor.ideal for own in per_axis(self.params))
        self.codec = self.forms.displacement_ideal if ideal else self.forms.displacement
        self.displacement = self.outbox(DISPLACEMENT, self.codec.size)
        if hasattr(self.rig.driver, "signal"):
            self.signal = Outbox(self.node, SIGNAL)  # the loop waits for nobody who listens
        self.asker = LIFECYCLE
        self.managed = self.gathered = False
        self.ending = ""
        self.answered = -1
        self.counts = SimpleNamespace(late=0, missing=0, overruns=0)
        self._told = dict(vars(self.counts))
        self.patient = self._show_at = 0.0
        self._pieces: Iterator[None] | None = None
        self.lifecycle = Lifecycle(self)
        for name, handler in (("enable", self.enable), ("stop", self.stop), ("reset", self.reset)):
            self.node.create_service(Trigger, f"~/{name}", handler)

    # States

    def connect(self, cause: str) -> bool:
        """Connect the rig; whether it is."""
        try:
            self.log.info(self.rig.connect(cause))
        except (ParameterError, LoopFault) as error:
            self.log.error(str(error))
            return False
        return True

    def agree(self) -> None:
        """Let the lifecycle follow the gate: active only as long as that is."""
        if self.gate.s.state != gate.ACTIVE and self.lifecycle.state == "active":
            self.lifecycle.trigger_deactivate()
        self.tell()

    # Services

    def enable(self, request: object, response: Any) -> Any:
        """``~/enable``: from inactive to active."""
        if self.gate.state != "inactive":
            response.message = f"{self.gate.state}, {self.gate.reason}: must be inactive; " + (
                "call ~/reset first" if self.gate.state == "fault" else "nothing to do"
            )
        elif text := self.intruder(every=True) or self.rig.refusal():
            response.message = text
        else:
            self.managed, self.asker = True, "asked by ~/enable"
            response.success = self.lifecycle.trigger_activate() == OK
            self.asker = LIFECYCLE
            response.message = self.gate.state
        self.agree()
        return response

    def stop(self, request: object, response: Any) -> Any:
        """``~/stop``: emergency stop, from whatever state; answers with what was reached."""
        self.managed = True
        response.success, response.message = self.rig.stop("asked by ~/stop", self.tick)
        self.agree()
        return response

    def reset(self, request: object, response: Any) -> Any:
        """``~/reset``: from fault to inactive, where the device is reached."""
        self.managed = True
        if self.gate.state != "fault":
            response.message = f"{self.gate.state}: there is no fault"
        elif not self.rig.connected:
            response.message = self.rig.unreached
        else:
            response.success = self.gate.reset(self.gate.s.u, "asked by ~/reset")
            response.message = self.gate.state
        self.agree()
        return response

    # One sample

    def newest(self) -> tuple[Any, bool]:
        """The newest command (V), and whether one has come that is not stale.

        One for a sample that was never measured, or that was answered, is another loop's.
        """
        u, fresh = self.rig.nothing, False
        active = self.gate.s.state == gate.ACTIVE
        for data in self.voltage.messages():
            try:
                stamp, _, _, v = self.read(VOLTAGE, self.forms.voltage.decode, data)
            except ConversionError as error:
                self.foreign(str(error))
                continue
            k, rest = divmod(stamp, self.T_ns)
            if rest or not self.answered < k < self.k:
                if 0 <= k <= self.answered and not rest:
                    self.foreign(f"sample {k} is commanded twice: more than one controller")
                else:
                    self.foreign(
                        f"a command is stamped {stamp} ns, samples are 0 to {self.k - 1} times "
                        f"{self.T_ns} ns: another loop's"
                    )
                continue
            u, self.answered = v, k
            age = self.k - 1 - k
            self.counts.late += age > 0
            stale = self.gate.c.stale
            fresh = not stale or age <= stale
        if not fresh and self.answered >= 0 and active:
            self.counts.missing += 1
        return u, fresh

    def foreign(self, text: str) -> None:
        """Trip on what is not of this loop; while nothing is commanded it does no harm."""
        if self.gate.s.state == gate.ACTIVE:
            self.gate.trip(CONTROLLERS, text)

    def desired(self) -> Any:
        """Displacement desired at this sample (m), NaN where it is not known; of each axis."""
        if not self.gate.c.following:
            return self.rig.nothing
        assert self.following is not None
        for data in self.following.messages():
            try:
                stamp, _, points = self.read(
                    self.following.topic, self.forms.reference.receive, data
                )
            except ConversionError as error:
                self.foreign(str(error))
                continue
            self.chunks.append((stamp // self.T_ns, points[:, ::POINT]))
        while self.chunks and self.chunks[0][0] + len(self.chunks[0][1]) <= self.k:
            self.chunks.popleft()
        if not self.chunks or self.k < self.chunks[0][0]:
            return self.rig.nothing
        first, w = self.chunks[0]
        found = w[self.k - first].tolist()
        return found[0] if self.matrices is None else tuple(found)

    def tick(self) -> None:
        """One sample: rig, displacement."""
        if not self.rig.pace(SPIN_NS) and self.gate.s.state == gate.ACTIVE:
            self.counts.overruns += 1
        self.gate.stamp = self.stamp
        u, fresh = self.newest()
        w, between = self.desired(), self.matrices
        if between is not None:
            u, w = between.actuators(u), between.sensors(w)
        if self.rig.step(u, fresh, w):
            measured = self.rig.measured
            self.publish(measured if between is None else in_fields(between.axes(measured)))
        self.agree()

    def publish(self, measured: Any) -> None:
        """Send y_k, as long as loop time goes on; it does so from the first command on."""
        if not rclpy.ok() or (self.samples and self.k >= self.samples):
            return
        if not self.gathered:
            self.show(measured)
        elif self.gate.s.state == gate.ACTIVE or (self.k and not self.gate.at_rest):
            if self.k == 0:
                self.patient = time.monotonic() + FIRST
            if self.k == 1:
                if self.answered < 0 and time.monotonic() < self.patient:
                    return
                self.log.info(f"loop starts, T_s = {self.T_s * 1e6:g} us, wall time")
            y, y_dot, u_applied = measured
            lean = self.codec is self.forms.displacement
            values = (y, u_applied) if lean else (y, y_dot, u_applied)
            if math.isfinite(detected := self.rig.signal):
                self.signal.send(convert.DETECTED.encode(self.stamp, detected))
            self.displacement.send(self.codec.encode(self.stamp, *values))
            self.k += 1
        else:
            self.show(measured)

    def show(self, measured: Any) -> None:
        """Send the displacement while loop time stands still, now and then, marked as no sample."""
        codec, now = self.forms.marked.get(self.gate.state), time.monotonic()
        if codec is not None and now >= self._show_at:
            self._show_at = now + SHOW_EVERY
            y, _, u_applied = measured
            self.displacement.show(codec.encode(self.stamp, y, u_applied))

    def look(self) -> None:
        """Do a piece of what is due between two samples, and more where the next one is far.

        Requests do not wait for the pieces: with a slow device each piece takes an exchange.
        """
        while rclpy.ok() and (self._pieces or time.monotonic() >= self._serve_at):
            if self._pieces and time.monotonic() >= self._serve_at:
                self.answer(0.0)
            self._pieces = self._pieces or self.chores()
            if next(self._pieces, END) is END:
                self._pieces = None
                self.agree()
            if self.rig.elapsed > self.T_ns // 2:
                return

    def lookout(self) -> Iterator[None]:
        """Trip where a topic has a second publisher."""
        for text in self.publishers.each(self.watched, every=True):
            if text:
                self.foreign(text)
            yield

    # Words

    def tell(self) -> None:
        """Tell every transition, in the log and on the diagnostics, and what else has come up."""
        notes, self.rig.notes = self.rig.notes, []
        for note in notes:
            if rclpy.ok():
                self.log.warning(note)
        transitions: list[gate.Transition] = self.gate.transitions
        self.gate.transitions = []
        for transition in transitions:
            text = f"{transition.before} -> {transition.after}: {transition.cause}"
            if rclpy.ok():
                if diagnostics.of_gate(transition.after):
                    self.log.error(text)
                else:
                    self.log.info(text)
                self._diagnostics.publish(
                    diagnostics.transition(*transition, self.space, self.hardware)
                )

    @property
    def hardware(self) -> str:
        """Who the driver says that it drives."""
        return getattr(self.rig.driver, "identity", "") or "pea"

    def _diagnose(self, now: float) -> None:
        super()._diagnose(now)
        self.count()

    def count(self) -> None:
        """Tell the gate's state, and what was late; warn where something was since last time."""
        counts = dict(vars(self.counts))
        level = diagnostics.OK if counts == self._told else diagnostics.WARN
        level = max(level, diagnostics.of_gate(self.gate.state))
        self._told = counts
        values = {"samples": self.k, "reason": self.gate.reason, **counts}
        values[SOFT_START] = f"{self.rig.soft_start:.6g}"
        self._diagnostics.publish(
            diagnostics.encode(
                *(self.stamp, f"{self.name}: gate", level, self.gate.state, values),
                *(self.space, self.hardware),
            )
        )

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
            pace.settle()  # the watchdog, too: it inherits the priority
        with self.interrupts(), breaking(self.rig):
            if self.lifecycle.trigger_configure() != OK:
                assert self.rig.failure is not None
                raise self.rig.failure
            try:
                self.gather()
                if not (self.ending or self.managed):
                    self.asker = AUTOSTART
                    self.lifecycle.trigger_activate()
                    self.asker = LIFECYCLE
                gc.freeze()
                self.rig.restart()
                self.gathered = True
                while not (self.ending or self.done):
                    self.tick()
                    self.look()
            finally:
                self.end()
        if self.gate_failed:
            raise LoopFault(f"the safety gate has tripped: {self.gate_failed}")

    @property
    def done(self) -> bool:
        """Whether a run that has an end is at it: after a fault too, as nobody resets that."""
        fault = self.gate.s.state == gate.FAULT
        return bool(self.samples) and (fault or self.k >= self.samples)

    def gather(self) -> None:
        """Wait for the neighbours; the device has the safe voltage meanwhile, or is on its way."""
        settle, since, said = (0.0 if self.with_recorder else SETTLE), time.monotonic(), [""]
        look_at = 0.0
        self.rig.restart()
        while not (self.ending or self.done):
            self.tick()
            self.look()
            if (now := time.monotonic()) < look_at:
                continue
            look_at = now + SERVE_EVERY
            if lacking := self.missing(self.with_recorder):
                since = now
                if lacking != said:
                    self.log.info("waiting for " + ", ".join(lacking))
                    said = lacking
            elif self._rely():
                since = now
            elif now - since >= settle and self.rig.settled | (self.gate.s.state == gate.ACTIVE):
                return

    def end(self) -> None:
        """Ramp down, then release; tell what was not told."""
        self.gate_failed = self.gate.cause if self.gate.state == "fault" else ""
        self.gate.deactivate(self.ending or "the end of the run")
        self.rig.restart()
        self.rig.rest(self.tick)
        self.tell()
        counts = ", ".join(f"{n} {name}" for name, n in vars(self.counts).items())
        self.say(f"{self.k} samples done; {counts}")
        if rclpy.ok():
            self.count()
        self.rig.close("the end of the run")
        self.tell()
        if rclpy.ok():
            self.deliver()

    def close(self) -> None:
        """Give back what the middleware holds."""
        self.lifecycle.close()
        super().close()
