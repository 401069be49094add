r"""A block that can be changed while the loop runs: new values, another type, and no bump.

At the first sample that goes by a change, the block as it was and the block as it will be answer
the same signals. By what they differ, the gap, the new one is started: a law with an integral
takes it there (``absorb``); what is left is added to the output and fades to nothing,

.. math:: out_k = model_k + gap\,\frac{N - k}{N}, \quad k = 0 \ldots N

so the first output is that of the old block to rounding, and after that nothing steps but what
the new values make of new signals. N spans `FADE`.

Another type knows nothing yet. It runs beside the old one for `WARM`, told the same signals and
what was really applied, and takes over then.

A model may offer, besides what `pea_core.block` asks for,

``absorb(c, s, gap)``
    The state with which the output is higher by `gap`; the same state where it cannot.
``actuator``, a field of the state
    What is known of the actuator: another type that has it too takes it over.
``steady(c, s, *signals)``
    The output without what switches from sample to sample: there is no bump to be seen in that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cache
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

from pea_core import injection
from pea_core.block import Block, Model
from pea_core.injection import OFF, REFERENCE, VOLTAGE, ahead_of, at_reference, at_voltage, point
from pea_core.signals import Estimate, Measurement, Reference

FADE = 0.1
"""How long (s) what is left of a gap takes to fade."""

ROUNDING = 1e-9
"""A gap (V) that an integral leaves and that is none."""

WARM = 0.05
"""How long (s) another type runs beside the old one before it takes over."""


class Coefficients(NamedTuple):
    """Those of the model, 1/N, and those of what is injected."""

    c: Any
    share: float
    inject: injection.Coefficients


class State(NamedTuple):
    """That of the model, the gap (as the output), and for how many samples it still fades.

    k: samples since the injection was switched on.
    """

    s: Any
    gap: Any
    left: int
    k: int


def shifted(x: Estimate, gap: Estimate, share: float) -> Estimate:
    """The estimate with a share of a gap."""
    return Estimate(x.x1 + share * gap.x1, x.x2 + share * gap.x2, x.eps + share * gap.eps)


def copied(state: object) -> Any:
    """A state with arrays of its own."""
    if isinstance(state, tuple):
        return type(state)(*map(copied, state))
    return state.copy() if hasattr(state, "copy") else state


class Role(NamedTuple):
    """What a block's output is.

    none : a gap of nothing.  add : output, gap and share to output.
    wrap : a model with a fading gap.  commits : whether the block is told what came of its own
    output, not of the sum (an estimate is its own, a command is what the actuator gets).
    inject : from parameters and T_s to what is injected.
    """

    none: Any
    add: Callable[[Any, Any, float], Any]
    wrap: Callable[[Any], Any]
    commits: bool
    inject: Callable[[Any, float], injection.Coefficients]


@cache
def fading_observer(model: Model) -> SimpleNamespace:
    """The model of an observer, with a gap that fades."""
    inner_output, inner_update = model.output, model.update

    def output(c: Coefficients, s: State, measured: Measurement) -> Estimate:
        estimate = inner_output(c.c, s.s, measured)
        if s.left > 0:
            estimate = shifted(estimate, s.gap, s.left * c.share)
        return estimate

    def update(c: Coefficients, s: State, measured: Measurement, estimate: Estimate) -> State:
        own = estimate
        if s.left > 0:
            own = shifted(estimate, s.gap, -s.left * c.share)
        return State(inner_update(c.c, s.s, measured, own), s.gap, max(s.left - 1, 0), s.k)

    return SimpleNamespace(model=model, output=output, update=update)


@cache
def fading_law(model: Model) -> SimpleNamespace:
    """The model of a law, with a gap that fades and with what is injected."""
    inner_output, inner_update = model.output, model.update

    def output(c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate) -> float:
        if c.inject.where == REFERENCE:
            W = at_reference(c.inject, s.k, W)
            W_ff = ahead_of(c.inject, s.k, W_ff)
        u = inner_output(c.c, s.s, W, W_ff, x)
        if s.left > 0:
            u += s.left * c.share * s.gap
        if c.inject.where == VOLTAGE:
            u += at_voltage(c.inject, s.k, u)
        return u

    def update(
        c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate, u: float
    ) -> State:
        k = s.k
        if c.inject.where != OFF:
            k += 1
        if c.inject.where == REFERENCE:
            W = at_reference(c.inject, s.k, W)
            W_ff = ahead_of(c.inject, s.k, W_ff)
        if c.inject.where == VOLTAGE:
            u -= point(c.inject, s.k).w
        return State(inner_update(c.c, s.s, W, W_ff, x, u), s.gap, max(s.left - 1, 0), k)

    return SimpleNamespace(model=model, output=output, update=update)


def nothing(params: object, T_s: float) -> injection.Coefficients:
    """Nothing is injected into an estimate."""
    return injection.off(T_s)


OBSERVER = Role(Estimate(0.0, 0.0, 0.0), shifted, fading_observer, True, nothing)
LAW = Role(0.0, lambda u, gap, share: u + share * gap, fading_law, False, injection.of_law)


class Coming:
    """What a block will be.

    Attributes
    ----------
    block : Block
        Model, coefficients and, for another type, a state of its own.
    another : bool
        Whether it is of another type.
    wait : int
        Samples that it still runs beside the old one.
    """

    __slots__ = ("another", "block", "wait")

    def __init__(self, block: Block, another: bool, wait: int) -> None:
        self.block = block
        self.another = another
        self.wait = wait


class Live(Block):
    """A block whose values and type change while the loop runs.

    Parameters
    ----------
    models : mapping of str to module
        The types it may have.
    params : dataclass
        An instance of the ``Params`` of one of them.
    T_s : float
        Sample period (s).
    role : Role
        `OBSERVER` or `LAW`.

    Attributes
    ----------
    coming : Coming or None
        What it will be; None while no change is under way.
    """

    __slots__ = ("_ahead", "_models", "_role", "coming")

    def __init__(
        self, models: Mapping[str, ModuleType], params: object, T_s: float, role: Role
    ) -> None:
        self._models = {model.Params: model for model in models.values()}
        self._role = role
        self.coming: Coming | None = None
        self._ahead: tuple[Any, ...] | None = None
        self.T_s = T_s
        self.signals = self.out = None
        self.params = params
        self.model, self.c, self.s = self.rest(params, self.designed(params))

    def rest(self, params: object, c: object) -> tuple[Any, Any, Any]:
        """Model, coefficients and state at rest that it would have with `params`."""
        model = self._models[type(params)]
        return (
            self._role.wrap(model),
            Coefficients(c, 1.0 / self._samples(FADE), self._role.inject(params, self.T_s)),
            State(model.start(c), self._role.none, 0, 0),
        )

    def _samples(self, seconds: float) -> int:
        return max(math.ceil(seconds / self.T_s), 1)

    @property
    def kind(self) -> Any:
        """Its model as it stands in its package."""
        return self.model.model

    def designed(self, params: object) -> Any:
        """Coefficients of the model that `params` belong to."""
        self._role.inject(params, self.T_s)
        return self._models[type(params)].design(params, self.T_s)

    def adopt(self, params: object, c: object) -> None:
        """Become what `params` say from the next sample on; another type, after `WARM`.

        Parameters
        ----------
        params : dataclass
        c : NamedTuple
            The coefficients that are designed from them.
        """
        model = self._models[type(params)]
        if self.signals is None:
            self.params = params
            self.model, self.c, self.s = self.rest(params, c)
            return
        coming = self.coming
        if coming is not None and coming.another and coming.block.model is model:
            coming.block.params, coming.block.c = params, c
            return
        block = Block.__new__(Block)
        block.model, block.params, block.T_s, block.c = model, params, self.T_s, c
        block.signals = block.out = None
        another = model is not self.kind
        block.s = self._begun(model.start(c)) if another else None
        self.coming = Coming(block, another, self._samples(WARM) if another else 0)
        self._ahead = None

    def _begun(self, s: Any) -> Any:
        """State at rest of another type, with what is known of the actuator already."""
        known = getattr(self.s.s, "actuator", None)
        if known is None or not hasattr(s, "actuator"):
            return s
        return s._replace(actuator=copied(known))

    def restart(self) -> None:
        """Start anew, at rest, as what it is or will be."""
        params = self.planned
        self.coming = self.signals = self.out = None
        self.retune(params)

    @property
    def planned(self) -> Any:
        """Parameters that it will have, or has."""
        return self.params if self.coming is None else self.coming.block.params

    def foresee(self, *signals: object) -> None:
        """Tell what is coming its own signals of this sample, where its preview is another."""
        self._ahead = signals

    def output(self, *signals: object) -> Any:
        """Output of this sample; a change that is due takes effect."""
        if self.coming is not None:
            signals = self._follow(self.coming, signals)
        return super().output(*signals)

    def update(self, *realised: object) -> None:
        """Commit the sample whose output was last computed."""
        super().update(*realised)
        coming = self.coming
        if coming is not None and coming.another and coming.block.signals is not None:
            if not self._role.commits:
                coming.block.out = self.out
            coming.block.update(*realised)
            coming.wait -= 1

    def _follow(self, coming: Coming, signals: tuple[object, ...]) -> tuple[Any, ...]:
        """Let what is coming answer beside, or take over; the signals that count from now on."""
        ahead, self._ahead = self._ahead or signals, None
        if coming.wait > 0:
            coming.block.output(*ahead)
            return signals
        self.take_over(signals, ahead)
        return ahead

    def take_over(self, signals: tuple[object, ...], ahead: tuple[object, ...]) -> None:
        """Become what is coming, at a sample whose output is not computed yet.

        Parameters
        ----------
        signals, ahead : tuple
            Signals of this sample, as the old one and as the new one take them.
        """
        coming, none, add = self.coming, self._role.none, self._role.add
        assert coming is not None
        new, s = coming.block, coming.block.s if coming.another else self.s.s
        old, k = self.c.inject, self.s.k
        inject = self._role.inject(new.params, self.T_s)
        begun = k if _injected(new.params) == _injected(self.params) else 0
        signals, ahead = _disturbed(old, k, signals), _disturbed(inject, begun, ahead)
        was = _steady(self.kind, self.c.c, self.s.s, signals)
        if self.s.left > 0:
            was = add(was, self.s.gap, self.s.left * self.c.share)
        gap = add(was, _steady(new.model, new.c, s, ahead), -1.0)
        absorb = getattr(new.model, "absorb", None)
        if absorb is not None:
            s = absorb(new.c, s, gap)
            gap = add(was, _steady(new.model, new.c, s, ahead), -1.0)
            gap = none if abs(gap) < ROUNDING else gap
        if VOLTAGE in (old.where, inject.where):
            gap += at_voltage(old, k, was) - at_voltage(inject, begun, was)
        self.model, self.params = self._role.wrap(new.model), new.params
        self.c = Coefficients(new.c, self.c.share, inject)
        self.s = State(s, gap, 0 if gap == none else self._samples(FADE), begun)
        self.coming = None


def _steady(model: Model, c: object, s: object, signals: tuple[object, ...]) -> Any:
    answer: Any = getattr(model, "steady", model.output)(c, s, *signals)
    return answer


def _injected(params: object) -> Any:
    return getattr(params, "inject", None)


def _disturbed(c: injection.Coefficients, k: int, signals: tuple[Any, ...]) -> tuple[Any, ...]:
    """Signals of a law with what is injected at the reference."""
    if c.where != REFERENCE:
        return signals
    W, W_ff, x = signals
    return at_reference(c, k, W), ahead_of(c, k, W_ff), x
