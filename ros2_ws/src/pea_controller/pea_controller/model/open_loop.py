r"""Open loop: Eq 7 alone, or only its static part.

.. math:: u = H^{-1}\Bigl(\frac{w}{K} + B_2^{-1}(\ddot w - A_{22} \dot w)\Bigr) - \hat\varepsilon

H is the identity unless an inverse is given (`inverse`). The second term is there with
`feedforward`, the last with `eps_compensation`. Without both u = w/K, which excites the actuator
with the reference itself: the frequency response from w to y is then that of V over K.
Compensating eps closes a loop: a disturbance observer.

Inputs
    `Reference` W (m, m/s, m/s^2), the same previewed, `Estimate` (V).
Outputs
    command u (V).
State
    what a slew limit has kept back, the plays of the inverse hysteresis.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from pea_controller.model import inverse, slew
from pea_controller.model.common import CommonParams, counted_once
from pea_controller.model.inverse import centred, fed, moved
from pea_controller.model.slew import at_rest, kept_back
from pea_core.params import group
from pea_core.signals import Estimate, Reference


@dataclass(frozen=True)
class Params(CommonParams):
    """Feedforward alone: nothing is fed back, unless eps."""

    PRESET: ClassVar[str] = "open_loop"

    inverse: inverse.Params = group(inverse.Params)

    def __post_init__(self) -> None:
        super().__post_init__()
        counted_once(self.inverse, self.eps_compensation)


class Coefficients(NamedTuple):
    """K (m/V), A_22 (1/s) and B_2 (m/(V s^2)); the switches are 0.0 or 1.0."""

    K: float
    A22: float
    B2: float
    use_ff: float
    use_eps: float
    actuator: slew.Coefficients
    inverse: inverse.Coefficients


class State(NamedTuple):
    """actuator: what a slew limit has kept back, for a law that follows this one.

    inverse: see `inverse`.
    """

    actuator: slew.State
    inverse: inverse.State


def design(params: Params, T_s: float) -> Coefficients:
    """Convert to SI."""
    return Coefficients(
        K=params.K * 1e-6,
        A22=params.A22,
        B2=params.B2,
        use_ff=float(params.feedforward),
        use_eps=float(params.eps_compensation),
        actuator=params.actuator(T_s),
        inverse=inverse.design(params.inverse),
    )


def start(c: Coefficients) -> State:
    """At rest."""
    return State(at_rest(c.actuator), centred(c.inverse))


def needed(c: Coefficients, W_ff: Reference) -> float:
    """Effective voltage of Eq 7 (V)."""
    moving = c.use_ff * (W_ff.w_ddot - c.A22 * W_ff.w_dot) / c.B2
    return W_ff.w / c.K + moving


def output(c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate) -> float:
    """Eq 7."""
    return fed(c.inverse, s.inverse, needed(c, W_ff)) - c.use_eps * x.eps


def update(
    c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate, u: float
) -> State:
    """Count what was not applied."""
    inverse = moved(c.inverse, s.inverse, needed(c, W_ff))
    return State(kept_back(c.actuator, s.actuator, u), inverse)
