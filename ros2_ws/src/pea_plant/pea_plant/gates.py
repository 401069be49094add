"""The gates of several axes as one: they trip, ramp, and are reset together.

Each axis has a `pea_plant.gate.Gate` with limits of its own. Where one trips, or the axes leave the
area that is permitted, all do at the same sample. What is one number for an axis is a tuple here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

from pea_plant import gate
from pea_plant.gate import ACTIVE, FAULT, OTHER_AXIS, PERMITTED_AREA, Gate, Transition
from pea_plant.model.stage import area, inside, matrix


class Gates:
    """See the head of this module; attributes and methods as of `Gate`.

    Parameters
    ----------
    params : sequence of pea_plant.plant.Params
        One an axis.
    T_s : float
        Sample period (s).
    axes : sequence of str
        Their names.

    Raises
    ------
    ParameterError
        The permitted area is none.
    """

    def __init__(self, params: Sequence[Any], T_s: float, axes: Sequence[str]) -> None:
        self.axes = tuple(axes)
        self.each = tuple(Gate(own, T_s) for own in params)
        stage, n = params[0].stage, len(self.each)
        self.corners = area(stage.permitted_um, n)
        self._to_axes = matrix(stage.sensors_to_axes, n, "sensors_to_axes")[:2]
        self.transitions: list[Transition] = []
        self.cause = ""
        self.stamp = 0

    @property
    def params(self) -> tuple[Any, ...]:
        """Limits of each axis."""
        return tuple(own.params for own in self.each)

    @property
    def first(self) -> int:
        """The axis that was the first to trip."""
        reasons = [own.s.reason for own in self.each]
        return next((i for i, r in enumerate(reasons) if r not in (gate.NONE, OTHER_AXIS)), 0)

    @property
    def state(self) -> str:
        """One of `STATES`."""
        return self.each[0].state

    @property
    def reason(self) -> str:
        """One of `REASONS`: of the first axis that has tripped."""
        return self.each[self.first].reason

    @property
    def s(self) -> Any:
        """State and reason of all, voltage of each (V)."""
        state, reason = self.each[0].s.state, self.each[self.first].s.reason
        return SimpleNamespace(state=state, reason=reason, u=tuple(own.s.u for own in self.each))

    @property
    def c(self) -> Any:
        """Safe voltages (V), how stale a command may be, whether the error is looked at."""
        return SimpleNamespace(
            safe=tuple(own.c.safe for own in self.each),
            stale=min((own.c.stale for own in self.each if own.c.stale), default=0),
            following=any(own.c.following for own in self.each),
        )

    @property
    def at_rest(self) -> bool:
        """Whether each driver has the safe voltage, for good."""
        return all(own.at_rest for own in self.each)

    def adopt(self, params: Sequence[Any]) -> None:
        """Take new limits; while active, tighter ones only; errors as `Gate.adopt`."""
        for own, new in zip(self.each, params, strict=True):
            if own.s.state == ACTIVE:
                gate.refuse_looser(own.params, new)
        for own, new in zip(self.each, params, strict=True):
            own.adopt(new)

    def step(
        self,
        u: Sequence[float],
        fresh: bool,
        y: Sequence[float],
        w: Sequence[float],
        elapsed: float,
        apart: float,
    ) -> tuple[float, ...]:
        """One sample: the voltages that the driver may see (V)."""
        after = [
            gate.step(own.c, own.s, u[i], fresh, y[i], w[i], elapsed, apart)
            for i, own in enumerate(self.each)
        ]
        active = self.each[0].s.state == ACTIVE
        found = [i for i, s in enumerate(after) if s.state == FAULT]
        within = True
        if len(self.corners) and all(map(math.isfinite, y)):
            within = inside(self.corners, *(self._to_axes @ y).tolist())
        for i, own in enumerate(self.each):
            if active and i not in found and (found or not within):
                before = gate.tripped(own.s, OTHER_AXIS if found else PERMITTED_AREA)
                after[i] = gate.step(own.c, before, u[i], fresh, y[i], w[i], elapsed, apart)
        for i, own in enumerate(self.each):
            own.follow(after[i], u[i], y[i], elapsed)
        if active and (found or not within):
            self._tell()
        return tuple(own.s.u for own in self.each)

    def _all(self, act: Callable[[Gate, int], bool]) -> bool:
        """The same for all; whether they did it."""
        done = [act(own, i) for i, own in enumerate(self.each)]
        if any(done):
            self._tell(done.index(True))
        return any(done)

    def _tell(self, which: int | None = None) -> None:
        """One transition for all, by the axis that was first."""
        first = self.first if which is None else which
        own = self.each[first]
        (*_, last) = own.transitions
        for each in self.each:
            each.transitions.clear()
        text = last.cause
        if which is None:
            text = f"{self.axes[first]}: {text}"
        if own.s.state == FAULT:
            self.cause = text
        self.transitions.append(Transition(self.stamp, last.before, last.after, text))

    def configure(self, u: Sequence[float], cause: str) -> bool:
        """From unconfigured to inactive, over a driver that has u (V) now."""
        return self._all(lambda own, i: own.configure(u[i], cause))

    def activate(self, cause: str) -> bool:
        """From inactive to active, starting softly from the voltages there are."""
        return self._all(lambda own, i: own.activate(cause))

    def deactivate(self, cause: str) -> bool:
        """From active to inactive."""
        return self._all(lambda own, i: own.deactivate(cause))

    def trip(self, reason: int, about: str = "") -> bool:
        """To fault, for a reason that the gates cannot see themselves; a fault keeps its first."""
        return self._all(lambda own, i: own.trip(reason, about))

    def reset(self, u: Sequence[float], cause: str) -> bool:
        """From fault to inactive, over a driver that has u (V) now."""
        return self._all(lambda own, i: own.reset(u[i], cause))

    def found(self, u: Sequence[float]) -> None:
        """Take note that the driver, reached again, has u (V): go on from there."""
        for own, one in zip(self.each, u, strict=True):
            own.found(one)

    def cleanup(self, cause: str) -> bool:
        """From inactive, or fault, to unconfigured: the driver is released."""
        return self._all(lambda own, i: own.cleanup(cause))
