r"""Sliding mode controller, Eqs 7, 9, 12 and 13.

With e_1 = x_1 - w, e_2 = x_2 - \dot w (Eq 5) and q = m e_1 + e_2 (Eq 9):

.. math:: u = B_2^{-1}(\ddot w - A_{21} w - A_{22} \dot w)
              - B_2^{-1}(m e_2 + A_{21} e_1 + A_{22} e_2) + u_3 - \hat\varepsilon

.. math:: u_3 = -\eta\, \mathrm{sgn}(q)

eta must be above the bound of eps, or of eps - \hat\varepsilon where that is subtracted; then
q q' < 0 off the surface. Sampled, q steps over zero by up to B_2 (eta + |eps|) T_s and u switches
between two values: chattering.

Inputs
    `Reference` W (m, m/s, m/s^2), the same previewed for the feedforward, `Estimate` (m, m/s, V).
Outputs
    command u (V).
State
    what a slew limit has kept back.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from pea_controller.model import slew
from pea_controller.model.common import CommonParams, feedforward
from pea_controller.model.slew import at_rest, freed, kept_back
from pea_controller.model.sliding_surface import equivalent_control, switching_function
from pea_core.params import param
from pea_core.signals import Estimate, Reference

COMPARED = True


@dataclass(frozen=True)
class Params(CommonParams):
    """Sliding surface and switching gain of Eqs 9 and 13."""

    PRESET: ClassVar[str] = "smc"

    m: float = param(5000.0, "1/s", 1e-3, 1e6, help="slope of the sliding surface")
    eta: float = param(12.0, "V", 0.0, 1e4, help="switching gain, above the bound of eps")


class Coefficients(NamedTuple):
    """Eqs 8, 9, 12 and 13 in SI; the switches are 0.0 or 1.0."""

    A21: float
    A22: float
    B2: float
    m: float
    eta: float
    use_ff: float
    use_eps: float
    actuator: slew.Coefficients


class State(NamedTuple):
    """What a slew limit has kept back."""

    actuator: slew.State


def design(params: Params, T_s: float) -> Coefficients:
    """Convert to SI."""
    return Coefficients(
        A21=params.A21,
        A22=params.A22,
        B2=params.B2,
        m=params.m,
        eta=params.eta,
        use_ff=float(params.feedforward),
        use_eps=float(params.eps_compensation),
        actuator=params.actuator(T_s),
    )


def start(c: Coefficients) -> State:
    """At rest."""
    return State(at_rest(c.actuator))


def sgn(x: float) -> float:
    """-1, 0 or 1."""
    if x > 0.0:
        return 1.0
    if x < 0.0:
        return -1.0
    return 0.0


def output(c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate) -> float:
    """Eqs 7, 12 and 13."""
    q = switching_function(c.m, W, freed(s.actuator, x))
    return steady(c, s, W, W_ff, x) - c.eta * sgn(q)


def steady(c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate) -> float:
    """Eqs 7 and 12: the command without what switches."""
    x = freed(s.actuator, x)
    u_ff = c.use_ff * feedforward(c.A21, c.A22, c.B2, W_ff)
    u_eq = equivalent_control(c.A21, c.A22, c.B2, c.m, W, x)
    return u_ff + u_eq - c.use_eps * x.eps


def update(
    c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate, u: float
) -> State:
    """Count what was not applied."""
    return State(kept_back(c.actuator, s.actuator, u))


def switching(params: Params) -> float:
    """Steps of the command (V) in steady state: eta to either side."""
    return 2.0 * params.eta
