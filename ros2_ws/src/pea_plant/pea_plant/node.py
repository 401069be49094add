"""The plant's node: commands in, measurements out."""

from __future__ import annotations

import sys
from typing import Any

import rclpy

from pea_core.axes import in_fields, per_axis
from pea_plant import specimen
from pea_plant.drivers.simulated import Simulated
from pea_plant.gate import Transition
from pea_plant.plant import Params
from pea_plant.stage import Stage
from pea_ros.block_node import BlockNode
from pea_ros.shell import SETTLE, run
from pea_ros.transport import Outbox
from pea_wire import convert, diagnostics
from pea_wire.topics import DISPLACEMENT, OWNED, RECORDED, REFERENCE, SIGNAL, VOLTAGE, WINDOW


class PlantNode(BlockNode):
    """Paces the loop: sends y_k, waits for u_k."""

    def __init__(self) -> None:
        super().__init__("plant", Params)
        actuators = [Simulated(params, self.T_s) for params in per_axis(self.params)]
        self.plant: Any = actuators[0] if len(actuators) == 1 else Stage(actuators, self.axes)
        self.parameters.connect(self.plant.try_design, self.plant.retune)
        ideal = any(params.sensor.ideal for params in per_axis(self.params))
        self.codec = self.forms.displacement_ideal if ideal else self.forms.displacement
        self.displacement = self.outbox(DISPLACEMENT, self.codec.size)
        self.voltage = self.inbox(VOLTAGE)
        self.recorded = self.inbox(RECORDED)
        self.awaited = [REFERENCE]  # if anybody listens to one
        self.publishers.oversee(OWNED)
        self.allowed = 0
        self.tripped = False
        self.specimen = specimen.of(per_axis(self.params))
        if self.specimen is None:
            self.compile(self.compiled)
        else:
            self.signal = Outbox(self.node, SIGNAL)  # the loop waits for nobody who listens

    def compiled(self) -> Any:
        """The hot path, compiled."""
        from pea_ros.hop import plant_hop

        ends = (self.voltage, self.displacement)
        form = ((self.forms.voltage,), self.codec)
        return self.make_hop(self.plant, plant_hop, *ends, *form, (self.plant.ahead(1), 0))

    def measure(self) -> None:
        """Send y_k with the voltage applied until now."""
        if self.k >= self.allowed:
            self.hold()
        y, y_dot, u_applied = in_fields(self.plant.read())
        if self.specimen is not None:
            told = specimen.seen(self.specimen, self.plant)
            self.signal.send(convert.DETECTED.encode(self.k * self.T_ns, told))
        lean = self.codec is self.forms.displacement
        values = (y, u_applied) if lean else (y, y_dot, u_applied)
        self.displacement.send(self.codec.encode(self.k * self.T_ns, *values))

    def hold(self) -> None:
        """Wait for the recorder, so that nothing is lost."""
        while rclpy.ok():
            while (data := self.recorded.take()) is not None:
                self.allowed = self.progress(RECORDED, data, self.k) + WINDOW
            if self.k < self.allowed:
                return
            if not (self.with_recorder or self.recorded.publishers):
                self.allowed = self.k + WINDOW
                return
            self.wait(self.recorded, 0.02)

    def command(self, data: bytes) -> None:
        """Apply u_k and go on to the next sample."""
        stamp, _, _, u = self.read(VOLTAGE, self.forms.voltage.decode, data)
        if stamp != self.k * self.T_ns and not self.expect(VOLTAGE, stamp):
            return
        self.plant.write(u)
        self.k += 1
        if self.k != self.samples:
            self.measure()

    def reach(self) -> tuple[int, Any]:
        """As far as the recorder allows, and not the last sample, which nothing follows."""
        ahead = min(self.allowed, self.samples or sys.maxsize) - 1 - self.k
        if ahead <= 0:
            return self.k, ()
        return self.k + ahead, (self.plant.ahead(ahead), self.k + 1)

    def reached(self, samples: int) -> None:
        """Forget the noise that was used."""
        self.plant.noise(samples)

    def tell_trip(self) -> None:
        """Say that the safety gate has tripped, before the samples are sent to the recorder."""
        found: Transition | None = self.plant.transition
        if not self.tripped and found is not None:
            self.tripped = True
            self._diagnostics.publish(diagnostics.transition(*found, self.space))

    def serve(self, wait: float = 0.0) -> None:
        """Serve parameters and services; tell a trip."""
        self.tell_trip()
        super().serve(wait)

    def deliver(self) -> None:
        """See that everything has arrived, a trip too."""
        self.tell_trip()
        super().deliver()

    def run(self) -> None:
        """Run the loop to its end."""
        self.wait_for_peers(self.with_recorder, 0.0 if self.with_recorder else SETTLE)
        self.log.info(f"loop starts, T_s = {self.T_s * 1e6:g} us")
        self.measure()
        self.spin(self.voltage, self.command)
        self.say(f"{self.k} samples done")


def main(args: list[str] | None = None) -> None:
    """Run ``ros2 run pea_plant plant``."""
    from pea_plant.wall_node import WallNode, wanted

    run(lambda: WallNode() if wanted() else PlantNode(), "plant", args)
