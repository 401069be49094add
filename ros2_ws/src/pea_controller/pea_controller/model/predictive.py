r"""PIDSMC on the predicted error, with its own estimate of what remains of eps.

The law of Eqs 7, 9 and 12 with u_3 = -P q, given what costs the plain one its precision:

1. An inverse of the hysteresis, driven by the reference alone. With v = u_ff of Eq 7 the voltage
   that the linear model needs, one Dahl operator says what H takes from it,

   .. math:: \frac{dh}{dv} = \frac{h_{max}\,\mathrm{sgn}\,\dot v - h}{\lambda},

   and u_ff + h is fed forward. After each turn of w it has the steep slope that every hysteresis
   has there; no noise enters it, and it is in no loop.
2. An estimator of [x1, x2, eps_r, eps_r'] whose input is u - h - c, so that it has to follow only
   the residual eps_r = eps + h + c, c from `repetitive`:

   .. math:: \varepsilon_k = \varepsilon_{k-1} + T_s \varepsilon'_{k-1}, \quad
             x_k = \Phi x_{k-1} + \Gamma (u_{k-1} - h_{k-1} - c_{k-1} + \varepsilon_k),

   corrected with \hat x_1; its four poles are those of a Butterworth filter of bandwidth omega_o.
   It is the integral action of the law.
3. A prediction over the plant's delay d of error and residual, since the commands on their way
   are known:

   .. math:: e_{k+d} = \Phi e_{k+d-1} + \Gamma (u - h - c - v + \varepsilon), \quad
             \varepsilon_{k+d+1} = \varepsilon_k + (d + 1)\,T_s \varepsilon'_k.

4. The velocity that a held voltage leaves. Where the displacement follows w, the sampled velocity
   is not w' but, v rising by \Delta v from the interval before t_k to the one after,

   .. math:: \dot w - B_2 T_s \Delta v / 12, \quad e_1 = x_1 - w, \quad
             e_2 = x_2 - (\dot w - B_2 T_s \Delta v / 12)

   up to the fourth order of T_s; w' itself would cost 2.7 nm at 160 Hz.

.. math:: u = v + h + c - B_2^{-1}(m e_2 + A_{21} e_1 + A_{22} e_2) - P q - \hat\varepsilon_r,
          \quad q = m e_1 + e_2

Of the observer it takes \hat x_1 alone, so any observer will do that hardly filters it. The
estimator is told what the limits leave of u; under a slew limit e is that of `slew` besides.

Inputs
    `Reference` W (m, m/s, m/s^2), the same previewed for the feedforward, `Estimate` (m, m/s, V).
Outputs
    command u (V).
State
    estimates, the last commands as the estimator counts them, the Dahl operator, the plays of the
    inverse hysteresis, what is learned, what a slew limit has kept back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np

from pea_controller.model import inverse, repetitive, slew
from pea_controller.model.common import CommonParams, feedforward
from pea_controller.model.inverse import added, centred, moved
from pea_controller.model.repetitive import acts, blank, correction, learned
from pea_controller.model.slew import applied, at_rest, kept_back
from pea_controller.model.sliding_surface import equivalent_control, switching_function
from pea_core.nominal import NominalModel, hold, ramping, state_space
from pea_core.params import ParameterError, group, param
from pea_core.signals import Estimate, Reference

LAG = 2.0
"""By how much the estimate of a loop of lower gain lags behind eps, in 1/omega_o."""


NEEDS = {"eps_compensation": True}


@dataclass(frozen=True)
class Params(CommonParams):
    """Sliding surface, estimator, hysteresis and learning, in the paper's units."""

    PRESET: ClassVar[str] = "precise"

    eps_compensation: bool = param(True, help="the law's own residual is always subtracted")
    m: float = param(9000.0, "1/s", 1e-3, 1e6, help="slope of the sliding surface")
    P: float = param(0.0017, "V s/um", 0.0, 10.0, help="proportional gain on q")
    omega_o: float = param(9000.0, "rad/s", 10.0, 1e6, help="bandwidth of the estimator")
    hysteresis_max: float = param(
        6.0, "V", 0.0, 1e4, help="h_max: half the width of the hysteresis fed forward"
    )
    hysteresis_length: float = param(
        17.0, "V", 1e-3, 1e4, help="lambda: voltage over which it builds up after a reversal"
    )
    learning: str = param(
        "none", choices=("none", "repetitive"), help="learn on periodic references", fixed=True
    )
    learning_rate: float = param(0.2, "", 0.0, 1.0, help="gamma: share learned each period")
    learning_bandwidth_hz: float = param(
        5000.0, "Hz", 1.0, 1e6, help="highest frequency that is learned", fixed=True
    )
    learning_frequency_hz: float = param(
        0.0, "Hz", 0.0, 1e6, help="frequency of the reference; 0: found from it", fixed=True
    )
    learning_period_max: float = param(
        1.0, "s", 1e-6, 10.0, help="longest period to be learned", fixed=True
    )

    inverse: inverse.Params = group(inverse.Params)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.feedforward:
            raise ParameterError(
                "feedforward = False: this law reaches w by its feedforward alone, and would stay "
                "off by all of a level; leave it true, or take type pidsmc"
            )
        if not self.eps_compensation:
            raise ParameterError(
                "eps_compensation = False: this law rests on its own estimate of eps; "
                "leave it true, or take type pidsmc"
            )


class Coefficients(NamedTuple):
    """Phi (2, 2), Gamma (2) and gain L (4) entry by entry; the law in SI.

    ripple: B_2 T_s / 12 (m/(V s)).  h_max (V), length: 1/lambda (1/V).  delay: d (samples).
    actuator: see `slew`.  inverse: see `inverse`.
    """

    f11: float
    f12: float
    f21: float
    f22: float
    g1: float
    g2: float
    l1: float
    l2: float
    l3: float
    l4: float
    A21: float
    A22: float
    B2: float
    m: float
    P: float
    ripple: float
    h_max: float
    length: float
    delay: int
    T_s: float
    actuator: slew.Coefficients
    learning: repetitive.Coefficients
    inverse: inverse.Coefficients


class State(NamedTuple):
    """x1 (m), x2 (m/s), eps (V), eps_dot (V/s) after the last correction.

    net (d + 1): u - h - c of the last commands, the oldest first (V).  v (d + 1): voltages of Eq 7
    with them (V).  h: that of the hysteresis with the last one (V).  memory: see `repetitive`.
    actuator: see `slew`.  inverse: see `inverse`.
    """

    x1: float
    x2: float
    eps: float
    eps_dot: float
    net: np.ndarray
    v: np.ndarray
    h: float
    memory: repetitive.State
    actuator: slew.State
    inverse: inverse.State


def estimator_gain(model: NominalModel, omega_o: float, T_s: float) -> np.ndarray:
    """L (4) that gives the estimator of [x1, x2, eps, eps'] Butterworth's poles at omega_o.

    Raises
    ------
    ParameterError
        omega_o lies beyond half the sample rate, or rounding would leave an error that does not
        die out.
    """
    from scipy.signal import place_poles  # takes as long to import as all the rest

    if omega_o * T_s >= math.pi:
        raise ParameterError(
            f"omega_o = {omega_o:g}: must be below half the sample rate, {math.pi / T_s:g} rad/s"
        )
    A, B, _ = state_space(model)
    F, _ = ramping(*hold(A, B, T_s), T_s)
    size = np.array([model.K * 1e-6, model.K * 1e-6 * model.omega_n, 1.0, model.omega_n])
    F, seen = F * size / size[:, None], np.array([[1.0, 0.0, 0.0, 0.0]])
    poles = np.exp(omega_o * T_s * np.exp(1j * math.pi * np.array([5.0, 7.0]) / 8.0))
    try:
        L = place_poles(F.T, (seen @ F).T, np.append(poles, poles.conj())).gain_matrix[0]
        radius = float(np.abs(np.linalg.eigvals(F - np.outer(L, seen @ F))).max())
    except (ValueError, np.linalg.LinAlgError):
        radius = math.inf
    if not radius < 1.0:
        raise ParameterError(
            f"omega_o = {omega_o:g}: the estimator cannot be designed, its error would not die "
            "out at this sample period"
        )
    return np.asarray(L * size / size[0])


def design(params: Params, T_s: float) -> Coefficients:
    """Discretise Eq 2, place the estimator's poles, convert to SI."""
    A, B, _ = state_space(params)
    F, G = hold(A, B, T_s)
    f11, f12, f21, f22 = F.ravel().tolist()
    g1, g2 = G[:, 0].tolist()
    l1, l2, l3, l4 = estimator_gain(params, params.omega_o, T_s).tolist()
    return Coefficients(
        f11=f11,
        f12=f12,
        f21=f21,
        f22=f22,
        g1=g1,
        g2=g2,
        l1=l1,
        l2=l2,
        l3=l3,
        l4=l4,
        A21=params.A21,
        A22=params.A22,
        B2=params.B2,
        m=params.m,
        P=params.P * 1e6,
        ripple=params.B2 * T_s / 12.0,
        h_max=params.hysteresis_max,
        length=1.0 / params.hysteresis_length,
        delay=params.delay_samples,
        T_s=T_s,
        actuator=params.actuator(T_s),
        learning=repetitive.design(
            params.learning == "repetitive",
            params.learning_rate,
            params.learning_bandwidth_hz,
            params.learning_frequency_hz,
            params.learning_period_max,
            params.delay_samples + 1 + round(LAG / (params.omega_o * T_s)),
            T_s,
        ),
        inverse=inverse.design(params.inverse),
    )


def start(c: Coefficients) -> State:
    """At rest, nothing known."""
    memory, plays = blank(c.learning), centred(c.inverse)
    net, v = np.zeros(c.delay + 1), np.zeros(c.delay + 1)
    return State(0.0, 0.0, 0.0, 0.0, net, v, 0.0, memory, at_rest(c.actuator), plays)


def hysteresis(c: Coefficients, s: State, v: float) -> float:
    """What H takes at v (V): of the fitted one, or of Dahl's operator after a monotone change."""
    if c.inverse.on:
        return added(c.inverse, s.inverse, v)
    last = s.v[c.delay]
    end = c.h_max if v > last else -c.h_max
    return s.h + (s.h - end) * math.expm1(-abs(v - last) * c.length)


def stepped(c: Coefficients, x1: float, x2: float, v: float) -> tuple[float, float]:
    """Phi x + Gamma v."""
    return c.f11 * x1 + c.f12 * x2 + c.g1 * v, c.f21 * x1 + c.f22 * x2 + c.g2 * v


def corrected(c: Coefficients, s: State, y: float) -> tuple[float, float, float, float]:
    """Estimates of x1, x2, eps and eps' at this sample, where x1 is measured as y (m)."""
    eps = s.eps + c.T_s * s.eps_dot
    x1, x2 = stepped(c, s.x1, s.x2, s.net[0] + eps)
    r = y - x1
    return x1 + c.l1 * r, x2 + c.l2 * r, eps + c.l3 * r, s.eps_dot + c.l4 * r


def output(c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate) -> float:
    """Estimate, predict over the delay, apply Eqs 7, 9 and 12."""
    x1, x2, eps, eps_dot = corrected(c, s, x.x1)
    v = feedforward(c.A21, c.A22, c.B2, W_ff)
    rise = (s.v[1] if c.delay > 0 else v) - s.v[0]
    e1, e2 = x1 - W.w, x2 - (W.w_dot - c.ripple * rise)
    eps += c.T_s * eps_dot
    for i in range(1, c.delay + 1):
        e1, e2 = stepped(c, e1, e2, s.net[i] - s.v[i] + eps)
        eps += c.T_s * eps_dot
    e1, e2 = e1 - s.actuator.d1, e2 - s.actuator.d2
    zero, e = Reference(0.0, 0.0, 0.0), Estimate(e1, e2, 0.0)
    u_eq = equivalent_control(c.A21, c.A22, c.B2, c.m, zero, e)
    u_ff = v + hysteresis(c, s, v) + correction(c.learning, s.memory)
    return u_ff + u_eq - c.P * switching_function(c.m, zero, e) - eps


def update(
    c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate, u: float
) -> State:
    """Keep the estimates and what the limits leave of u; learn."""
    x1, x2, eps, eps_dot = corrected(c, s, x.x1)
    v = feedforward(c.A21, c.A22, c.B2, W_ff)
    h = hysteresis(c, s, v)
    now = correction(c.learning, s.memory)
    net = applied(c.actuator, s.actuator, u) - h - now
    for i in range(c.delay):
        s.net[i], s.v[i] = s.net[i + 1], s.v[i + 1]
    s.net[c.delay], s.v[c.delay] = net, v
    memory = learned(c.learning, s.memory, W, eps)
    if acts(c.learning, memory) != acts(c.learning, s.memory):
        # the correction ends: the residual takes it over, so that u does not step
        jump = correction(c.learning, memory) - now
        eps += jump
        for i in range(c.delay + 1):
            s.net[i] -= jump
    actuator = kept_back(c.actuator, s.actuator, u)
    plays = moved(c.inverse, s.inverse, v)
    return State(x1, x2, eps, eps_dot, s.net, s.v, h, memory, actuator, plays)


def absorb(c: Coefficients, s: State, gap: float) -> State:
    """Residual with which u is higher by `gap` (V).

    The commands on their way are counted against it, so that no other estimate moves.
    """
    return s._replace(eps=s.eps - gap, net=s.net + gap)


def unlearned(params: Params) -> Params:
    """The law without what it learns from period to period."""
    return replace(params, learning=Params.learning)
