r"""A reference whose jumps are moves: at its start, and wherever its parameters change.

From the sample k_0 of a change on, w goes from the old signal w_o to the new one w_n,

.. math:: w = w_n + (1 - f)\,(w_o - w_n), \quad f = \sum_i A_i\,g(t - t_i)

with f of `model.shaper`, for the way that lies between the two. Its derivatives are exact, by the
product rule. Where both rest, w keeps the limits of the shaper; where they move, the part that
gets from one to the other does. Before the first sample w is at rest at `shaper.rest_um`. A
change that comes during a move begins when that one has ended, so moves never add up; of several
that wait the last one counts.
"""

from __future__ import annotations

from functools import cache
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

from pea_core.block import Signal
from pea_core.signals import Reference
from pea_reference.model.shaper import NO_MOVE, Curve, curve, done, impulses

NEVER = 2**62
"""A sample that does not come."""

LOOKS = 20
"""Samples at which the way between two signals is looked at."""


class Coefficients(NamedTuple):
    """Signals a, b, n (coefficients of the model) in turn, moves to b at k_1 and to n at k_2.

    rest : w before the first sample (m).  from_rest: whether the first move begins there, not at
    a.  to_b, to_n: how the moves go.
    """

    rest: float
    from_rest: bool
    a: Any
    b: Any
    n: Any
    k_1: int
    k_2: int
    to_b: Curve
    to_n: Curve
    T_s: float


def mixed(old: Reference, new: Reference, f: float, f_1: float, f_2: float) -> Reference:
    """Between two signals, a share f of the way; f_1, f_2: its derivatives."""
    gap, gap_1, gap_2 = old.w - new.w, old.w_dot - new.w_dot, old.w_ddot - new.w_ddot
    rest = 1.0 - f
    return Reference(
        new.w + rest * gap,
        new.w_dot + rest * gap_1 - f_1 * gap,
        new.w_ddot + rest * gap_2 - 2.0 * f_1 * gap_1 - f_2 * gap,
    )


@cache
def wrapped(model: Any) -> SimpleNamespace:
    """The model of a reference, with moves in place of jumps."""
    inner, inner_design = model.output, model.design

    def design(params: Any, T_s: float) -> Coefficients:
        c = inner_design(params, T_s)
        rest = params.shaper.rest_um * 1e-6
        made = Coefficients(rest, True, c, c, c, 0, NEVER, NO_MOVE, NO_MOVE, T_s)
        return made._replace(to_b=way(params.shaper, made, 0))

    def way(shaper: Any, c: Coefficients, k: int) -> Curve:
        """The move from a, or from rest, to b that begins at sample k."""
        kind = impulses(shaper)

        def gap(i: int) -> Reference:
            old = Reference(c.rest, 0.0, 0.0) if c.from_rest else inner(c.a, k + i)
            new = inner(c.b, k + i)
            return Reference(old.w - new.w, old.w_dot - new.w_dot, old.w_ddot - new.w_ddot)

        first = gap(0)
        if first.w == 0.0 and first.w_dot == 0.0:
            return NO_MOVE
        found = curve(shaper, first.w, kind)
        span = found.length / c.T_s
        widest = max(abs(gap(round(i * span / LOOKS)).w) for i in range(LOOKS + 1))
        return curve(shaper, widest, kind)

    def output(c: Coefficients, k: int) -> Reference:
        if k >= c.k_2:
            new = inner(c.n, k)
            f, f_1, f_2 = done(c.to_n, (k - c.k_2) * c.T_s)
            if f == 1.0 and f_1 == 0.0 and f_2 == 0.0:
                return new
            return mixed(inner(c.b, k), new, f, f_1, f_2)
        new = inner(c.b, k)
        f, f_1, f_2 = done(c.to_b, (k - c.k_1) * c.T_s)
        if f == 1.0 and f_1 == 0.0 and f_2 == 0.0:
            return new
        old = inner(c.a, k)
        if c.from_rest:
            old = Reference(c.rest, 0.0, 0.0)
        return mixed(old, new, f, f_1, f_2)

    return SimpleNamespace(model=model, design=design, output=output, way=way)


def model_of(model: Any, params: Any) -> Any:
    """The model that gives the reference of `params`: itself, or with moves for jumps."""
    return wrapped(model) if moves(params) else model


def moves(params: object) -> bool:
    """Whether jumps become moves; the reference of a lab may have no shaper."""
    shaper = getattr(params, "shaper", None)
    return shaper is not None and bool(shaper.on)


def jumps(signal: Any, samples: int, rest: float, least: float) -> dict[int, float]:
    """Samples at which w jumps by more than `least` (m), and rests then; the jumps (m).

    Parameters
    ----------
    signal : Signal
    samples : int
        How many are looked at.
    rest : float
        w before the first sample (m).
    least : float
    """
    before, found = rest, {}
    for k in range(samples):
        now = signal.at(k)
        if abs(now.w - before) > least and now.w_dot == 0.0 and now.w_ddot == 0.0:
            found[k] = now.w - before
        before = now.w
    return found


class Shaped(Signal):
    """A reference with moves in place of jumps; see the head of this module."""

    __slots__ = ("_coming",)

    def __init__(self, model: ModuleType, params: Any, T_s: float) -> None:
        super().__init__(wrapped(model), params, T_s)
        self._coming: Coefficients | None = None

    def adopt(self, params: Any, c: Any) -> None:
        """Go over to new parameters from the next sample that is asked for."""
        self.params, self._coming = params, c

    def due(self, k: int) -> Coefficients:
        """Coefficients for the samples from k on; a change that waits begins."""
        c: Coefficients = self.c
        if self._coming is None:
            return c
        if k >= c.k_2:
            c = c._replace(from_rest=False, a=c.b, b=c.n, k_1=c.k_2, to_b=c.to_n)
        k_2 = max(k, c.k_1 + 1 + int(c.to_b.length / self.T_s))
        if c.to_b is NO_MOVE:
            k_2 = k
        after = c._replace(from_rest=False, a=c.b, b=self._coming.b)
        to_n = self.model.way(self.params.shaper, after, k_2)
        self.c = c._replace(n=self._coming.b, k_2=k_2, to_n=to_n)
        self._coming = None
        return self.c


def signal(model: ModuleType, params: object, T_s: float) -> Signal:
    """The reference of some parameters."""
    return (Shaped if moves(params) else Signal)(model, params, T_s)
