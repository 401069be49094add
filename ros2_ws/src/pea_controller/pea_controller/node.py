"""The controller's node: estimates and the reference in, commands out."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import rclpy

from pea_controller.model import CHOICE, MODELS
from pea_controller.model.common import (
    BOUNDLESS,
    OF_THE_PLANT,
    followed,
    following,
    limits,
    within,
)
from pea_core.axes import (
    POINT,
    laws,
    of_each,
    per_axis,
    preview_of,
    references_of,
    side_by_side,
    split,
)
from pea_core.config import flat, own_of, spread
from pea_core.live import LAW, Live
from pea_core.loop import CHUNK, Horizon, LoopFault, command
from pea_core.signals import Estimate
from pea_ros.block_node import BlockNode
from pea_ros.neighbours import Neighbours
from pea_ros.shell import SILENCE, run
from pea_wire import convert
from pea_wire.topics import CONSUMED, DISPLACEMENT, FOLLOWED, REFERENCE, STATE, VOLTAGE

RING = 4 * convert.POINTS
"""Samples of reference kept for compiled code: a power of two."""

ROOM = RING - 2 * convert.POINTS
"""Samples of reference known ahead from which on chunks wait until they are needed."""

ASK_AGAIN = 0.3
"""Seconds without anything of the reference after which it is asked again: a publisher may send
before it knows its subscriber, and what it sends then is lost."""


class ControllerNode(BlockNode):
    """Computes u_k from x̂_k and the reference, which arrives ahead in chunks."""

    def __init__(self) -> None:
        super().__init__("controller", CHOICE)
        blocks = [Live(MODELS, params, self.T_s, LAW) for params in per_axis(self.params)]
        self.controller: Any = side_by_side(blocks, laws)
        self.actuators = (BOUNDLESS,) * len(blocks)
        self.plant: dict[str, Any] = {}
        self.neighbours = Neighbours(self.node, "controller", ("plant", "observer"), self.neighbour)
        self.neighbours.changed = self.follow
        self.parameters.connect(self.check, self.controller.retune)
        self.horizon = Horizon(self.T_s)
        self.state = self.inbox(STATE)
        self.reference = self.inbox(REFERENCE)
        self.publishers.oversee([DISPLACEMENT])  # an observer that holds leaves a gap
        self.followed = self.outbox(FOLLOWED)  # who discovers VOLTAGE knows of this one, too
        self.voltage = self.outbox(VOLTAGE, self.forms.voltage.size)
        self.consumed = self.outbox(CONSUMED)
        self.points = np.zeros((RING, POINT * len(self.axes)))
        self.due = 0
        self.repeats = False
        self.compile(self.compiled)

    def compiled(self) -> Any:
        """The hot path, compiled."""
        from pea_ros.hop import controller_hop

        ends = (self.state, self.voltage)
        form = ((self.forms.state,), self.forms.voltage)
        return self.make_hop(self.controller, controller_hop, *ends, *form, self.reach_extra())

    def check(self, params: Any) -> None:
        """Try a design before it is swapped in."""
        self.within(params)
        self.controller.try_design(params)
        own = self.parameters.all
        self.beside(lambda: self.neighbours.judge(own, params, self.log.warning))

    def within(self, params: Any) -> None:
        """Refuse limits wider than the plant's."""
        for own, actuator in zip(per_axis(params), self.actuators, strict=True):
            within(own, actuator)

    def meet(self) -> None:
        """Take over the plant's limits and delay where none were given; refuse wider limits."""
        names = spread(self.axes, dict.fromkeys(OF_THE_PLANT))
        plant = self.ask_plant(*names)
        needed = spread(self.axes, dict.fromkeys(OF_THE_PLANT[:3]))
        if missing := [name for name in needed if name not in plant]:
            self.log.warning(f"the plant does not report {', '.join(missing)}: the law's own count")
            return
        self.plant = plant
        self.bound()
        given = self.parameters.given
        following_plant = flat(self.axes, [following(own) for own in self.plants])
        taken = {name: value for name, value in following_plant.items() if name not in given}
        self.parameters.adopt(taken)
        self.within(self.parameters.params)

    @property
    def plants(self) -> list[dict[str, Any]]:
        """What the plant has told of each axis."""
        return [own_of(self.axes, axis, self.plant) for axis in self.axes]

    def bound(self) -> None:
        """Take what the plant can apply from what it has told."""
        self.actuators = tuple(limits(own) for own in self.plants)

    def follow(self, other: str, changed: dict[str, object]) -> None:
        """Take over limits that the plant changes while the loop runs."""
        names = spread(self.axes, dict.fromkeys(OF_THE_PLANT))
        new = {name: changed[name] for name in names if name in changed}
        if other != "plant" or not self.plant or new.items() <= self.plant.items():
            return
        self.plant |= new
        self.bound()
        values = self.parameters.values
        given = self.parameters.given | self.parameters.live
        own = [
            followed(own_of(self.axes, axis, values), plant, own_of(self.axes, axis, marks))
            for marks in (dict.fromkeys(given),)
            for axis, plant in zip(self.axes, self.plants, strict=True)
        ]
        self.parameters.follow(flat(self.axes, own))

    def restart(self, again: bool) -> None:
        """Know nothing of what was; where the loop begins again, so does the reference."""
        self.controller.restart()
        if again:
            while self.reference.take() is not None:
                pass
            self.horizon, self.due = Horizon(self.T_s), 0

    def receive(self) -> None:
        """Take the chunks of reference that have come, in order; what is past may be missing.

        One that is started again in wall time may mean another signal: it begins where this ends.
        """
        while self.horizon.end - self.k < ROOM and (data := self.reference.take()) is not None:
            stamp, times, points = self.read(REFERENCE, self.forms.reference.receive, data)
            stamps = stamp + times
            if self.has(stamps, points):
                continue
            if self.horizon.end * self.T_ns < stamp <= self.stamp:
                self.horizon = Horizon(self.T_s, stamp // self.T_ns)
            known = self.horizon.end - stamp // self.T_ns
            self.repeats = known > 0 and (self.repeats or (self.wall and self.newcomer(REFERENCE)))
            if self.repeats:
                stamps, points = stamps[known:], points[known:]
                if not len(points):
                    continue
            expected = (self.horizon.end + np.arange(len(stamps))) * self.T_ns
            if not np.array_equal(stamps, expected):
                raise LoopFault(
                    f"{REFERENCE.name}: expected points from sample {self.horizon.end} on, "
                    f"{self.T_ns} ns apart, got stamps {stamps[0]} to {stamps[-1]} ns"
                )
            self.points[(self.horizon.end + np.arange(len(points))) % RING] = points
            self.followed.send(self.forms.reference.encode(int(stamps[0]), self.T_ns, points))
            self.horizon.extend(self.horizon.end, references_of(points))

    def has(self, stamps: np.ndarray, points: np.ndarray) -> bool:
        """Whether a chunk is here already, to the bit: asked twice, one may answer twice."""
        k, rest = np.divmod(stamps, self.T_ns)
        here = (
            not rest.any() and max(0, self.horizon.end - RING) <= k[0] and k[-1] < self.horizon.end
        )
        return bool(here) and np.array_equal(self.points[k % RING], points)

    def foresee(self) -> None:
        """Say where it is due how far the reference is used; wait until what is needed is here."""
        if self.k < self.due:
            return
        self.due = self.k - self.k % (CHUNK // 2) + CHUNK // 2
        self.horizon.forget(self.k)  # compiled code does not
        self.consumed.send(convert.encode_time(self.stamp))
        self.receive()
        asked = heard = time.monotonic()
        end = self.horizon.end
        while not self.horizon.knows(self.k + CHUNK // 2) and rclpy.ok():
            self.wait(self.reference, 0.02)
            self.receive()
            now = time.monotonic()
            if self.horizon.end == end and now - asked > ASK_AGAIN:
                self.consumed.send(convert.encode_time(self.stamp))
                asked = now
            if now - heard > SILENCE:
                self.miss(REFERENCE, SILENCE)
                heard = now + 4 * SILENCE

    def estimated(self, data: bytes) -> None:
        """Send the command of this sample, then commit it."""
        stamp, *told = self.read(STATE, self.forms.state.receive, data)
        if stamp != self.k * self.T_ns and not self.expect(STATE, stamp):
            return
        self.foresee()
        _, u = command(self.controller, self.horizon, self.k, of_each(Estimate, told))
        self.voltage.send(self.forms.voltage.encode(stamp, u))
        self.controller.update()
        self.k += 1

    def reach_extra(self) -> tuple[Any, ...]:
        """The reference, how far it is looked ahead, and T_s: see `controller_hop`."""
        ahead, theta = split(preview_of(self.controller.params))
        return self.points, ahead, theta, self.T_s

    def reach(self) -> tuple[int, Any]:
        """As far as the reference is there for sure."""
        self.foresee()
        return self.k + CHUNK // 2 - self.k % (CHUNK // 2), self.reach_extra()

    def run(self) -> None:
        """Control until the loop ends."""
        self.wait_for_peers(self.with_recorder)
        self.foresee()
        self.spin(self.state, self.estimated)


def main(args: list[str] | None = None) -> None:
    """Run ``ros2 run pea_controller controller``."""
    run(ControllerNode, "controller", args)
