r"""Sliding mode controller with a boundary layer: `smc` with a continuous Eq 13.

.. math:: u_3 = -\eta\, \mathrm{sat}(q / \phi), \quad \mathrm{sat}(x) = \max(-1, \min(1, x))

Inside the layer |q| < phi this is proportional control of q, PIDSMC with P = eta / phi and I = 0.
A constant eps is held by q = phi eps / eta, which leaves the static error

.. math:: e_1 = \varepsilon \phi / (\eta m)

eta must be above the bound of eps, or q leaves the layer.

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

from pea_controller.model import slew, smc
from pea_controller.model.common import feedforward
from pea_controller.model.slew import freed
from pea_controller.model.sliding_surface import equivalent_control, switching_function
from pea_controller.model.smc import State, start, update
from pea_core.params import param
from pea_core.signals import Estimate, Reference

__all__ = ["Coefficients", "Params", "State", "design", "output", "start", "update"]

COMPARED = True


@dataclass(frozen=True)
class Params(smc.Params):
    """Sliding surface and switching gain of `smc`, and a boundary layer."""

    PRESET: ClassVar[str] = "smc_boundary_layer"

    phi: float = param(8000.0, "um/s", 1e-6, 1e9, help="half width of the boundary layer")


class Coefficients(NamedTuple):
    """Eqs 8, 9 and 12, eta (V) and phi (m/s); the switches are 0.0 or 1.0."""

    A21: float
    A22: float
    B2: float
    m: float
    eta: float
    phi: float
    use_ff: float
    use_eps: float
    actuator: slew.Coefficients


def design(params: Params, T_s: float) -> Coefficients:
    """Convert to SI."""
    return Coefficients(
        A21=params.A21,
        A22=params.A22,
        B2=params.B2,
        m=params.m,
        eta=params.eta,
        phi=params.phi * 1e-6,
        use_ff=float(params.feedforward),
        use_eps=float(params.eps_compensation),
        actuator=params.actuator(T_s),
    )


def sat(x: float) -> float:
    """X within -1 and 1."""
    return min(max(x, -1.0), 1.0)


def output(c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate) -> float:
    """Eqs 7, 12 and 13, with sat(q / phi) for sgn(q)."""
    x = freed(s.actuator, x)
    q = switching_function(c.m, W, x)
    u_3 = -c.eta * sat(q / c.phi)
    u_ff = c.use_ff * feedforward(c.A21, c.A22, c.B2, W_ff)
    u_eq = equivalent_control(c.A21, c.A22, c.B2, c.m, W, x)
    return u_ff + u_eq + u_3 - c.use_eps * x.eps
