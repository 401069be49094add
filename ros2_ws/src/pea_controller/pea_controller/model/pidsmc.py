r"""PID-based sliding mode controller, Eqs 7, 9, 12 and 14.

With e_1 = x_1 - w, e_2 = x_2 - \dot w (Eq 5) and q = m e_1 + e_2 (Eq 9):

.. math:: u = B_2^{-1}(\ddot w - A_{21} w - A_{22} \dot w)
              - B_2^{-1}(m e_2 + A_{21} e_1 + A_{22} e_2) + u_3 - \hat\varepsilon

.. math:: u_3 = -(P q + I \int q\,dt + D_c \dot q)

The integral is a backward rectangle kept in volts, v_I += I T_s q. By Eq 11 q' depends on u_3
itself, q' = B_2 u_3 once the other terms are compensated: an algebraic loop, solved as
u_3 = -(P q + v_I) / (1 + B_2 D_c). Conditional anti-windup: where the actuator cannot apply
the command, the integral keeps its value (`common.waits`).

Inputs
    `Reference` W (m, m/s, m/s^2), the same previewed for the feedforward, `Estimate` (m, m/s, V).
Outputs
    command u (V).
State
    integral v_I (V), patience left while the command is limited (samples).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from pea_controller.model.common import PATIENCE, CommonParams, feedforward, limited, waits
from pea_controller.model.sliding_surface import equivalent_control, switching_function
from pea_core.params import param
from pea_core.signals import Estimate, Reference


@dataclass(frozen=True)
class Params(CommonParams):
    """Sliding surface and PID of Eqs 9 and 14, in the paper's units."""

    m: float = param(5000.0, "1/s", 1e-3, 1e6, help="slope of the sliding surface")
    P: float = param(0.0012, "V s/um", 0.0, 10.0, help="proportional gain on q")
    I: float = param(6.0, "V/um", 0.0, 1e4, help="integral gain on q")  # noqa: E741
    D_c: float = param(0.0, "V s^2/um", 0.0, 1e-3, help="derivative gain on q")


class Coefficients(NamedTuple):
    """Eqs 8, 9, 12 and 14 in SI; the switches are 0.0 or 1.0."""

    A21: float
    A22: float
    B2: float
    m: float
    P: float
    I_T: float
    D: float
    use_ff: float
    use_eps: float
    voltage_min: float
    voltage_max: float
    patience: int


class State(NamedTuple):
    """Integral of Eq 14 (V), samples for which it still waits while the command is limited."""

    v_I: float
    spare: int


def design(params: Params, T_s: float) -> Coefficients:
    """Convert to SI; D is 1 + B_2 D_c."""
    return Coefficients(
        A21=params.A21,
        A22=params.A22,
        B2=params.B2,
        m=params.m,
        P=params.P * 1e6,
        I_T=params.I * 1e6 * T_s,
        D=1.0 + params.B2 * params.D_c * 1e6,
        use_ff=float(params.feedforward),
        use_eps=float(params.eps_compensation),
        voltage_min=params.voltage_min,
        voltage_max=params.voltage_max,
        patience=math.ceil(PATIENCE / T_s),
    )


def start(c: Coefficients) -> State:
    """No integral."""
    return State(0.0, c.patience)


def output(c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate) -> float:
    """Eqs 7, 12 and 14."""
    q = switching_function(c.m, W, x)
    v_I = s.v_I + c.I_T * q
    u_3 = -(c.P * q + v_I) / c.D
    u_ff = c.use_ff * feedforward(c.A21, c.A22, c.B2, W_ff)
    u_eq = equivalent_control(c.A21, c.A22, c.B2, c.m, W, x)
    return u_ff + u_eq + u_3 - c.use_eps * x.eps


def update(
    c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate, u: float
) -> State:
    """Integrate, unless the actuator cannot apply u."""
    q = switching_function(c.m, W, x)
    spare = max(s.spare - 1, 0) if limited(u, c.voltage_min, c.voltage_max) else c.patience
    if waits(u, -q, c.voltage_min, c.voltage_max, s.spare):
        return State(s.v_I, spare)
    return State(s.v_I + c.I_T * q, spare)


def absorb(c: Coefficients, s: State, gap: float) -> State:
    """Integral with which u is higher by `gap` (V); none where nothing leads it back."""
    return State(s.v_I - c.D * gap, s.spare) if c.I_T > 0.0 else s
