r"""Open loop: Eq 7 alone, or only its static part.

.. math:: u = \frac{w}{K} + B_2^{-1}(\ddot w - A_{22} \dot w) - \hat\varepsilon

The second term is there with `feedforward`, the last with `eps_compensation`. Without both
u = w/K, which excites the actuator with the reference itself: the frequency response from w to y
is then that of V over K. Compensating eps closes a loop: a disturbance observer.

Inputs
    `Reference` W (m, m/s, m/s^2), the same previewed, `Estimate` (V).
Outputs
    command u (V).
State
    what a slew limit has kept back.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from pea_controller.model import slew
from pea_controller.model.common import CommonParams
from pea_controller.model.slew import at_rest, kept_back
from pea_core.signals import Estimate, Reference


@dataclass(frozen=True)
class Params(CommonParams):
    """Feedforward alone: nothing is fed back, unless eps."""

    PRESET: ClassVar[str] = "open_loop"


class Coefficients(NamedTuple):
    """K (m/V), A_22 (1/s) and B_2 (m/(V s^2)); the switches are 0.0 or 1.0."""

    K: float
    A22: float
    B2: float
    use_ff: float
    use_eps: float
    actuator: slew.Coefficients


class State(NamedTuple):
    """What a slew limit has kept back: of no use here, but to a law that follows this one."""

    actuator: slew.State


def design(params: Params, T_s: float) -> Coefficients:
    """Convert to SI."""
    return Coefficients(
        K=params.K * 1e-6,
        A22=params.A22,
        B2=params.B2,
        use_ff=float(params.feedforward),
        use_eps=float(params.eps_compensation),
        actuator=params.actuator(T_s),
    )


def start(c: Coefficients) -> State:
    """At rest."""
    return State(at_rest())


def output(c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate) -> float:
    """Eq 7."""
    moving = c.use_ff * (W_ff.w_ddot - c.A22 * W_ff.w_dot) / c.B2
    return W_ff.w / c.K + moving - c.use_eps * x.eps


def update(
    c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate, u: float
) -> State:
    """Count what was not applied."""
    return State(kept_back(c.actuator, s.actuator, u))
