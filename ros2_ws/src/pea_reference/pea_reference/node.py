"""The reference's node: sends the desired displacement ahead, in chunks."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import rclpy

from pea_core.axes import per_axis, references, side_by_side
from pea_core.loop import CHUNK
from pea_core.params import ParameterError
from pea_reference.model import CHOICE, MODELS, events_of
from pea_reference.shaped import jumps, signal
from pea_ros.block_node import BlockNode
from pea_ros.neighbours import Neighbours
from pea_ros.shell import SETTLE, run
from pea_ros.transport import Inbox, NaiveInbox, Outbox
from pea_wire import convert, scanning
from pea_wire.topics import CONSUMED, EVENTS, RECORDED, REFERENCE

PATIENCE = 30.0
"""Seconds without word of the recorder, or of the controller, which has one every few hundred
samples."""

AHEAD = 3 * CHUNK
"""Samples sent beyond the one the controller has said it used."""


LOOKED_AT = 10_000
"""Samples in which a raw step is looked for before the loop starts."""

KNOWN = 2.0
"""Seconds that its neighbours have to report their parameters then."""


class ReferenceNode(BlockNode):
    """Keeps the controller supplied; a new parameter acts from the next chunk on."""

    def __init__(self) -> None:
        super().__init__("reference", CHOICE)
        made = []
        for params in per_axis(self.params):
            model = MODELS[CHOICE.type_of(params)]
            made.append(signal(model, params, self.T_s))
            if hasattr(model, "understood"):
                self.log.info(model.understood(params))
        self.signal: Any = side_by_side(made, references)
        self.raw = any(jumps(each, LOOKED_AT, 0.0, 0.0) for each in made)
        others = ("plant", "observer", "controller")
        self.neighbours = Neighbours(self.node, "reference", others, self.neighbour)
        self.parameters.connect(self.check, self.signal.retune)
        found = [events_of(params, self.T_s) for params in per_axis(self.params)]
        self.scanned = next((each for each in found if each is not None), None)
        if self.scanned is not None:
            self.events = Outbox(self.node, EVENTS)  # the loop waits for nobody who listens
        self.told = 0
        self.reference = self.outbox(REFERENCE)
        self.consumed = self.inbox(CONSUMED)
        self.recorded = self.inbox(RECORDED)
        self.samples = 0
        self.last = (convert.LAST - 1) // self.T_ns - 2 * AHEAD
        self.used = -1

    def check(self, params: Any) -> None:
        """Try a design before it is swapped in; see that the law holds what jumps."""
        self.signal.try_design(params)
        own = self.parameters.all
        self.beside(lambda: self.neighbours.judge(own, params, self.log.warning))

    def meet(self) -> None:
        """Warn of a raw step that the law will not hold."""
        if not self.raw:
            return
        end = time.monotonic() + KNOWN
        while not self.neighbours.known and time.monotonic() < end and rclpy.ok():
            self.serve(0.02)
        try:
            self.neighbours.judge(self.parameters.all, self.params, self.log.warning)
        except ParameterError as error:
            self.log.warning(str(error))

    def consume(self, data: bytes) -> None:
        """Go on from where the controller is; a new one begins again, or is anywhere.

        Raises
        ------
        ConversionError
            It cannot be there.
        """
        used = self.progress(CONSUMED, data, self.last)
        if used > self.k and self.used >= 0 and not self.newcomer(CONSUMED):
            self.progress(CONSUMED, data, self.k)  # what was not sent is not used
        whole = used - used % CHUNK
        self.k = whole if used <= self.used else max(self.k, whole)
        self.used = used
        self.tell(used)
        self.supply(used)

    def tell(self, used: int) -> None:
        """Publish the events of the scan up to sample `used`."""
        if self.scanned is None:
            return
        first = self.told if self.told <= used else used
        found = self.scanned(first, used)
        if len(found):
            self.events.send(scanning.encode(found, self.T_ns))
        self.told = used

    def supply(self, used: int) -> None:
        """Send chunks until they reach `AHEAD` samples beyond sample `used`."""
        while self.k < used + AHEAD:
            points = np.array([self.signal.at(k) for k in range(self.k, self.k + CHUNK)])
            points = points.reshape(CHUNK, -1)
            self.reference.send(self.forms.reference.encode(self.stamp, self.T_ns, points))
            self.k += CHUNK

    def word(self, inbox: Inbox | NaiveInbox, patience: float) -> bytes | None:
        """First message of a topic, waited for so many seconds; None where none has come."""
        end = time.monotonic() + patience
        data = inbox.take()
        while data is None and time.monotonic() < end and rclpy.ok():
            self.wait(inbox, 0.02)
            data = inbox.take()
        return data

    def run(self) -> None:
        """Supply until the loop ends, first what recorder and controller are ready for.

        A publisher knows a subscriber before that knows the publisher; what is sent in between is
        lost. Who has spoken knows all it listens to. A controller of another make may be silent.
        """
        self.wait_for_peers(self.with_recorder, 0.0 if self.with_recorder else SETTLE)
        if self.with_recorder or self.recorded.publishers:
            self.word(self.recorded, PATIENCE)
        asked = self.word(self.consumed, SETTLE)
        if asked is None:
            self.supply(0)
        else:
            self.consume(asked)
        self.spin(self.consumed, self.consume, silence=PATIENCE)


def main(args: list[str] | None = None) -> None:
    """Run ``ros2 run pea_reference reference``."""
    run(ReferenceNode, "reference", args)
