r"""Integral action on a damped stage: an inner loop that damps, notches that follow modes.

.. math:: u = H^{-1}(u_{ff}) + N(z)\,\Bigl(K_p e + K_i \int e\,dt\Bigr) - D\,e - \hat\varepsilon,
          \quad e = w - x_1

D is the inner loop. It feeds the deviation back positively, through a low-pass filter of gain
g/K at rest, g < 1:

ppf
    Positive position feedback,

    .. math:: D(s) = \frac{g}{K} \frac{\omega_f^2}{s^2 + 2 \zeta_f \omega_f s + \omega_f^2}
irc
    Integral resonant control. A feedthrough -d K added to the actuator, d > 1, puts a zero below
    each pole, so an integrator -k/s around both damps all modes at once; moved over to the
    controller it is

    .. math:: D(s) = \frac{g}{K} \frac{p}{s + p}, \quad g = \frac{1}{d}, \quad p = k\,d\,K

With g the actuator looks stiffer by 1 / (1 - g) at rest, where g >= 1 would make it unstable. D
sees -e, not x_1, so what is fed forward along w stays right.

N is a chain of notches, one for each frequency,

.. math:: N(s) = \prod_i \frac{s^2 + 2 z_i \omega_i s + \omega_i^2}
                              {s^2 + 2 p_i \omega_i s + \omega_i^2}

sampled by the bilinear transform that keeps omega_i where it is. Notch and inner loop are told
frequencies: those that identification has found.

Sources: S. S. Aphale, A. J. Fleming, S. O. R. Moheimani, Smart Mater. Struct. 16, 2007 (irc);
C. J. Goh, T. K. Caughey, Int. J. Control 41, 1985 (ppf).

Inputs
    `Reference` W (m, m/s, m/s^2), the same previewed for the feedforward, `Estimate` (m, m/s, V).
Outputs
    command u (V).
State
    integral (V), states of the inner loop and of the notches (V), patience left while the command
    is limited (samples), what a slew limit has kept back, the plays of the inverse hysteresis.
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
from pea_controller.model.slew import at_rest, freed, kept_back
from pea_core.nominal import hold
from pea_core.params import ParameterError, group, param
from pea_core.signals import Estimate, Reference


@dataclass(frozen=True)
class Params(CommonParams):
    """Gains, inner loop and notches, in the paper's units."""

    PRESET: ClassVar[str] = "damped_irc"

    K_p: float = param(0.0, "V/um", 0.0, 1e4, help="proportional gain")
    K_i: float = param(5000.0, "V/(um s)", 0.0, 1e8, help="integral gain")
    damping: str = param(
        "irc", choices=("none", "ppf", "irc"), help="inner loop that damps the resonance"
    )
    damping_gain: float = param(
        0.5, "", 0.0, 0.99, help="g: gain of the inner loop at rest, relative to 1/K"
    )
    damping_omega: float = param(
        5450.0, "rad/s", 1.0, 1e6, help="omega_f of ppf, p of irc: follows the first mode"
    )
    damping_zeta: float = param(0.5, "", 0.01, 10.0, help="zeta_f of ppf")
    notch_omega_n: tuple[float, ...] = param(
        (5450.0,), "rad/s", 1.0, 1e6, help="frequency of each notch", fixed=True
    )
    notch_zero: tuple[float, ...] = param(
        (1.0,), "", 0.0, 10.0, help="z_i: depth of each notch; as large as its pole: none"
    )
    notch_pole: tuple[float, ...] = param((1.0,), "", 1e-3, 10.0, help="p_i: width of each notch")
    inverse: inverse.Params = group(inverse.Params)

    def __post_init__(self) -> None:
        super().__post_init__()
        counted_once(self.inverse, self.eps_compensation)
        counts = {len(self.notch_omega_n), len(self.notch_zero), len(self.notch_pole)}
        if len(counts) > 1 or not self.notch_omega_n:
            raise ParameterError(
                f"notch_omega_n, notch_zero and notch_pole have {len(self.notch_omega_n)}, "
                f"{len(self.notch_zero)} and {len(self.notch_pole)} values: give one of each for "
                "each notch"
            )


class Coefficients(NamedTuple):
    """Gains in SI.  F (2, 2), G (2) entry by entry, and d (V/m): states and gain of the inner loop.

    b0, b1, b2, a1, a2 (n): notches.
    """

    A21: float
    A22: float
    B2: float
    K_p: float
    K_i_T: float
    f11: float
    f12: float
    f21: float
    f22: float
    g1: float
    g2: float
    d: float
    b0: np.ndarray
    b1: np.ndarray
    b2: np.ndarray
    a1: np.ndarray
    a2: np.ndarray
    use_ff: float
    use_eps: float
    patience: int
    actuator: slew.Coefficients
    inverse: inverse.Coefficients


class State(NamedTuple):
    """v_I: integral (V).  d1, d2: inner loop (m, m/s).  n1, n2 (n): notches (V).

    spare: patience left (samples).  actuator: see `slew`.  inverse: see `inverse`.
    """

    v_I: float
    d1: float
    d2: float
    n1: np.ndarray
    n2: np.ndarray
    spare: int
    actuator: slew.State
    inverse: inverse.State


def notches(params: Params, T_s: float) -> np.ndarray:
    """b0, b1, b2, a1, a2 (5, n) of the notches.

    Raises
    ------
    ParameterError
        A frequency is not below half the sample rate.
    """
    rows = []
    for omega, zero, pole in zip(
        params.notch_omega_n, params.notch_zero, params.notch_pole, strict=True
    ):
        if omega * T_s >= math.pi:
            raise ParameterError(
                f"notch_omega_n = {omega:g}: must be below half the sample rate, "
                f"{math.pi / T_s:g} rad/s"
            )
        t = math.tan(0.5 * omega * T_s)
        a0 = 1.0 + 2.0 * pole * t + t * t
        middle = 2.0 * (t * t - 1.0)
        rows.append(
            (
                (1.0 + 2.0 * zero * t + t * t) / a0,
                middle / a0,
                (1.0 - 2.0 * zero * t + t * t) / a0,
                middle / a0,
                (1.0 - 2.0 * pole * t + t * t) / a0,
            )
        )
    return np.array(rows).T


def design(params: Params, T_s: float) -> Coefficients:
    """Convert to SI and sample the filters."""
    p, zeta = params.damping_omega, params.damping_zeta
    if params.damping == "irc":
        A, B = np.array([[-p, 0.0], [0.0, -p]]), np.array([[p], [0.0]])
    else:
        A, B = np.array([[0.0, 1.0], [-p * p, -2.0 * zeta * p]]), np.array([[0.0], [p * p]])
    F, G = hold(A, B, T_s)
    b0, b1, b2, a1, a2 = notches(params, T_s)
    f11, f12, f21, f22 = F.ravel().tolist()
    g1, g2 = G[:, 0].tolist()
    gain = 0.0 if params.damping == "none" else params.damping_gain / (params.K * 1e-6)
    return Coefficients(
        A21=params.A21,
        A22=params.A22,
        B2=params.B2,
        K_p=params.K_p * 1e6,
        K_i_T=params.K_i * 1e6 * T_s,
        f11=f11,
        f12=f12,
        f21=f21,
        f22=f22,
        g1=g1,
        g2=g2,
        d=gain,
        b0=b0.copy(),
        b1=b1.copy(),
        b2=b2.copy(),
        a1=a1.copy(),
        a2=a2.copy(),
        use_ff=float(params.feedforward),
        use_eps=float(params.eps_compensation),
        patience=math.ceil(PATIENCE / T_s),
        actuator=params.actuator(T_s),
        inverse=inverse.design(params.inverse),
    )


def start(c: Coefficients) -> State:
    """At rest, no error before sample 0."""
    n = c.b0.size
    return State(
        v_I=0.0,
        d1=0.0,
        d2=0.0,
        n1=np.zeros(n),
        n2=np.zeros(n),
        spare=c.patience,
        actuator=at_rest(c.actuator),
        inverse=centred(c.inverse),
    )


def output(c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate) -> float:
    """Feedforward, integral through the notches, inner loop."""
    x = freed(s.actuator, x)
    e = W.w - x.x1
    v = c.K_p * e + s.v_I + c.K_i_T * e
    for i in range(c.b0.size):
        v = float(c.b0[i] * v + s.n1[i])
    u_ff = fed(c.inverse, s.inverse, c.use_ff * feedforward(c.A21, c.A22, c.B2, W_ff))
    # what a deviation of this sample adds to the filter acts from the next one on
    return u_ff + v + c.d * s.d1 - c.use_eps * x.eps


def update(
    c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate, u: float
) -> State:
    """Run the filters; integrate, unless the actuator cannot apply u."""
    x = freed(s.actuator, x)
    e = W.w - x.x1
    v_I = s.v_I + c.K_i_T * e
    v = c.K_p * e + v_I
    for i in range(c.b0.size):
        passed = c.b0[i] * v + s.n1[i]
        s.n1[i] = c.b1[i] * v - c.a1[i] * passed + s.n2[i]
        s.n2[i] = c.b2[i] * v - c.a2[i] * passed
        v = passed
    if waits(u, e, c.actuator.low, c.actuator.high, s.spare):
        v_I = s.v_I
    spare = patient(u, c.actuator.low, c.actuator.high, s.spare, c.patience)
    d1 = c.f11 * s.d1 + c.f12 * s.d2 - c.g1 * e
    d2 = c.f21 * s.d1 + c.f22 * s.d2 - c.g2 * e
    plays = moved(c.inverse, s.inverse, c.use_ff * feedforward(c.A21, c.A22, c.B2, W_ff))
    actuator = kept_back(c.actuator, s.actuator, u)
    return State(v_I, d1, d2, s.n1, s.n2, spare, actuator, plays)
