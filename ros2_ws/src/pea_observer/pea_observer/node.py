"""The observer's node: measurements in, estimates out."""

from __future__ import annotations

import math
import sys
from typing import Any

from pea_core.axes import each, in_fields, observers, of_each, per_axis, side_by_side
from pea_core.live import OBSERVER, Live
from pea_core.loop import LoopFault
from pea_core.params import ParameterError
from pea_core.signals import Measurement
from pea_observer.matching import matching
from pea_observer.model import CHOICE, MODELS
from pea_ros.block_node import BlockNode
from pea_ros.neighbours import Neighbours
from pea_ros.shell import run
from pea_wire import convert
from pea_wire.topics import DISPLACEMENT, STATE


class ObserverNode(BlockNode):
    """Estimates x̂_k and eps from y_k and the voltage applied until then."""

    def __init__(self) -> None:
        super().__init__("observer", CHOICE)
        blocks = [Live(MODELS, params, self.T_s, OBSERVER) for params in per_axis(self.params)]
        self.observer: Any = side_by_side(blocks, observers)
        self.neighbours = Neighbours(self.node, "observer", ("plant", "controller"), self.neighbour)
        self.parameters.connect(self.check, self.observer.retune)
        self.displacement = self.inbox(DISPLACEMENT)
        self.state = self.outbox(STATE, self.forms.state.size)
        for params in dict.fromkeys(per_axis(self.params)):
            self.log.info(f"{CHOICE.type_of(params)}; {matching(params, self.T_s)}")
        self.compile(self.compiled)

    def meet(self) -> None:
        """Learn whether the plant goes on while this node is started again."""
        self.ask_plant()

    @property
    def needs_velocity(self) -> bool:
        """Whether it must be told the true velocity."""
        return any(getattr(one.kind, "NEEDS_VELOCITY", False) for one in each(self.observer))

    def check(self, params: Any) -> None:
        """Try a design before it is swapped in."""
        self.observer.try_design(params)
        for own, block in zip(per_axis(params), each(self.observer), strict=True):
            model, told = MODELS[CHOICE.type_of(own)], block.signals
            if getattr(model, "NEEDS_VELOCITY", False) and told and math.isnan(told[0].y_dot):
                raise ParameterError(
                    f"type = {CHOICE.type_of(own)!r}: needs the true velocity, which "
                    f"{DISPLACEMENT.name} does not carry; choose another observer"
                )
        values = self.parameters.all
        self.beside(lambda: self.neighbours.judge(values, params, self.log.warning))

    def compiled(self) -> Any:
        """The hot path, compiled."""
        from pea_ros.hop import observer_hop

        takes: tuple[Any, ...] = (self.forms.displacement_ideal,)
        if not self.needs_velocity:  # else one without it is told apart, and refused
            takes = (self.forms.displacement, self.forms.displacement_ideal)
        ends = (self.displacement, self.state)
        return self.make_hop(self.observer, observer_hop, *ends, takes, self.forms.state, ())

    def restart(self, again: bool) -> None:
        """Know nothing of what was."""
        self.observer.restart()

    def measured(self, data: bytes) -> None:
        """Send the estimate of this sample, then commit it."""
        if self.read(DISPLACEMENT, convert.marked, data):
            return  # no sample: loop time stands still
        stamp, *told = self.read(DISPLACEMENT, self.forms.decode_displacement, data)
        if stamp != self.k * self.T_ns and not self.expect(DISPLACEMENT, stamp):
            return
        measured = of_each(Measurement, told)
        if self.needs_velocity and any(math.isnan(one.y_dot) for one in per_axis(measured)):
            raise LoopFault(
                "passthrough needs the true velocity, which /pea/displacement does not carry: "
                "set sensor.ideal of the plant, or choose another observer"
            )
        estimate = self.observer.output(measured)
        self.state.send(self.forms.state.encode(stamp, *in_fields(estimate)))
        self.observer.update()
        self.k += 1

    def reach(self) -> tuple[int, Any]:
        """Any number of samples."""
        return sys.maxsize, ()

    def run(self) -> None:
        """Estimate until the loop ends."""
        self.wait_for_peers(self.with_recorder)
        self.spin(self.displacement, self.measured)


def main(args: list[str] | None = None) -> None:
    """Run ``ros2 run pea_observer observer``."""
    run(ObserverNode, "observer", args)
