r"""PID-based sliding mode controller, Eqs 7, 9, 12 and 14.

With e_1 = x_1 - w, e_2 = x_2 - \dot w (Eq 5) and q = m e_1 + e_2 (Eq 9):

.. math:: u = B_2^{-1}(\ddot w - A_{21} w - A_{22} \dot w)
              - B_2^{-1}(m e_2 + A_{21} e_1 + A_{22} e_2) + u_3 - \hat\varepsilon

.. math:: u_3 = -(P q + I \int q\,dt + D_c \dot q)

The integral is a backward rectangle kept in volts, v_I += I T_s q. By Eq 11 q' depends on u_3
itself and on the unknown input,

.. math:: \dot q = B_2 (u_3 + \varepsilon - \hat\varepsilon),

so Eq 14 is an algebraic loop. `q_dot` chooses how it is solved:

nominal (default)
    q' = B_2 u_3, which drops eps: u_3 = -(P q + v_I) / (1 + B_2 D_c). This is less than the
    paper's law: D_c only divides the gains P and I by 1 + B_2 D_c.
measured
    eps is taken from the change of q over the last interval, compared with its change by the
    nominal model without eps:

    .. math:: \varepsilon_k = \frac{[m\ 1](\hat x_k - \Phi \hat x_{k-1} - \Gamma u_{k-1})}
              {[m\ 1]\,\Gamma}, \quad
              u_3 = -\frac{P q + v_I + B_2 D_c (\varepsilon_k - \hat\varepsilon)}{1 + B_2 D_c}

    where u is the voltage that acted. This is q' of Eq 11, solved for u_3 implicitly. On the
    nominal plant eps_k is 0, so the loop has the poles of `nominal` for every D_c; an explicit
    backward difference of q is unstable from D_c = 1.5e-7 on. The noise of x passes to u_3 through
    eps_k, multiplied by B_2 D_c / (1 + B_2 D_c).

A fitted inverse hysteresis may be applied to the first term (`inverse`).

Anti-windup: while the command is outside the voltage range, the integral keeps its value
(`common.waits`); for a slew limit see `slew`.

Inputs
    `Reference` W (m, m/s, m/s^2), the same previewed for the feedforward, `Estimate` (m, m/s, V).
Outputs
    command u (V).
State
    integral v_I (V), patience left while the command is limited (samples), the last x, the last
    voltages that act on it, the state of the slew limit, the plays of the inverse hysteresis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from pea_controller.model import inverse, slew
from pea_controller.model.common import (
    PATIENCE,
    CommonParams,
    counted_once,
    feedforward,
    patient,
    waits,
)
from pea_controller.model.inverse import centred, fed, moved
from pea_controller.model.slew import acting, at_rest, freed, kept_back
from pea_controller.model.sliding_surface import equivalent_control, switching_function
from pea_core.params import group, param
from pea_core.signals import Estimate, Reference

COMPARED = True


@dataclass(frozen=True)
class Params(CommonParams):
    """Sliding surface and PID of Eqs 9 and 14, in the paper's units."""

    PRESET: ClassVar[str] = "recommended"

    m: float = param(5000.0, "1/s", 1e-3, 1e6, help="slope of the sliding surface")
    P: float = param(0.0012, "V s/um", 0.0, 10.0, help="proportional gain on q")
    I: float = param(6.0, "V/um", 0.0, 1e4, help="integral gain on q")  # noqa: E741
    D_c: float = param(0.0, "V s^2/um", 0.0, 1e-3, help="derivative gain on q")
    q_dot: str = param(
        "nominal",
        choices=("nominal", "measured"),
        help="q' of Eq 14: of the nominal model, which drops eps, or with eps as q has moved",
    )
    inverse: inverse.Params = group(inverse.Params)

    def __post_init__(self) -> None:
        super().__post_init__()
        counted_once(self.inverse, self.eps_compensation)


class Coefficients(NamedTuple):
    """Eqs 8, 9, 12 and 14 in SI; the switches are 0.0 or 1.0.

    D: 1 + B_2 D_c.  to_eps: 1 / [m 1] Gamma (V s/m).  measured: whether `q_dot` is.
    actuator: see `slew`.  inverse: see `inverse`.
    """

    A21: float
    A22: float
    B2: float
    m: float
    P: float
    I_T: float
    D: float
    to_eps: float
    use_ff: float
    use_eps: float
    patience: int
    actuator: slew.Coefficients
    measured: bool
    inverse: inverse.Coefficients


class State(NamedTuple):
    """v_I: integral of Eq 14 (V).  spare: samples of patience left (see `common.waits`).

    x1 (m), x2 (m/s): last estimate.  acted (delay + 1): last commands as the actuator applies them,
    the oldest first (V).  actuator: see `slew`.  inverse: see `inverse`.
    """

    v_I: float
    spare: int
    x1: float
    x2: float
    acted: np.ndarray
    actuator: slew.State
    inverse: inverse.State


def design(params: Params, T_s: float) -> Coefficients:
    """Convert to SI."""
    actuator = params.actuator(T_s)
    return Coefficients(
        A21=params.A21,
        A22=params.A22,
        B2=params.B2,
        m=params.m,
        P=params.P * 1e6,
        I_T=params.I * 1e6 * T_s,
        D=1.0 + params.B2 * params.D_c * 1e6,
        to_eps=1.0 / (params.m * actuator.g1 + actuator.g2),
        use_ff=float(params.feedforward),
        use_eps=float(params.eps_compensation),
        patience=math.ceil(PATIENCE / T_s),
        actuator=actuator,
        measured=params.q_dot == "measured",
        inverse=inverse.design(params.inverse),
    )


def start(c: Coefficients) -> State:
    """No integral."""
    acted = np.zeros(c.actuator.delay + 1)
    return State(0.0, c.patience, 0.0, 0.0, acted, at_rest(c.actuator), centred(c.inverse))


def unknown(c: Coefficients, s: State, x: Estimate) -> float:
    """Eps (V) over the last interval, as q has moved."""
    a, u = c.actuator, s.acted[0]
    r1 = x.x1 - (a.f11 * s.x1 + a.f12 * s.x2 + a.g1 * u)
    r2 = x.x2 - (a.f21 * s.x1 + a.f22 * s.x2 + a.g2 * u)
    return (c.m * r1 + r2) * c.to_eps


def output(c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate) -> float:
    """Eqs 7, 12 and 14."""
    x = freed(s.actuator, x)
    q = switching_function(c.m, W, x)
    v_I = s.v_I + c.I_T * q
    if c.measured:
        eps = unknown(c, s, x) - c.use_eps * x.eps
        u_3 = -(c.P * q + v_I + (c.D - 1.0) * eps) / c.D
    else:
        u_3 = -(c.P * q + v_I) / c.D
    u_ff = fed(c.inverse, s.inverse, c.use_ff * feedforward(c.A21, c.A22, c.B2, W_ff))
    u_eq = equivalent_control(c.A21, c.A22, c.B2, c.m, W, x)
    return u_ff + u_eq + u_3 - c.use_eps * x.eps


def update(
    c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate, u: float
) -> State:
    """Integrate, unless the actuator cannot apply u."""
    x = freed(s.actuator, x)
    q = switching_function(c.m, W, x)
    spare = patient(u, c.actuator.low, c.actuator.high, s.spare, c.patience)
    v_I = s.v_I + c.I_T * q
    if waits(u, -q, c.actuator.low, c.actuator.high, s.spare):
        v_I = s.v_I
    for i in range(c.actuator.delay):
        s.acted[i] = s.acted[i + 1]
    s.acted[c.actuator.delay] = acting(c.actuator, s.actuator, u)
    actuator = kept_back(c.actuator, s.actuator, u)
    v = c.use_ff * feedforward(c.A21, c.A22, c.B2, W_ff)
    inverse = moved(c.inverse, s.inverse, v)
    return State(v_I, spare, x.x1, x.x2, s.acted, actuator, inverse)


def absorb(c: Coefficients, s: State, gap: float) -> State:
    """Integral with which u is higher by `gap` (V); none where nothing leads it back."""
    return s._replace(v_I=s.v_I - c.D * gap) if c.I_T > 0.0 else s


def equivalent_pid(params: Params) -> dict[str, float]:
    """Gains of the PID + D^2 law of e = w - x1 that this is, in the paper's units.

    K_p = P m + I - 1/K, K_i = I m, K_d = P + (m + A22)/B2 + D_c m, K_dd = D_c.
    """
    P, I, D_c, m = params.P, params.I, params.D_c, params.m  # noqa: E741
    return {
        "K_p_V_per_um": P * m + I - 1.0 / params.K,
        "K_i_V_per_um_s": I * m,
        "K_d_V_s_per_um": P + (m + params.A22) / (params.B2 * 1e6) + D_c * m,
        "K_dd_V_s2_per_um": D_c,
    }
