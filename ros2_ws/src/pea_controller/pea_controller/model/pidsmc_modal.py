r"""PIDSMC with its sliding surface on a model of several modes behind a delay, docs/resonant.md.

With delta the deviation from the reference's trajectory in modal coordinates, e_1 and e_2 the
displacement and velocity of the mode of largest gain in it, and B_2 = K_i omega_i^2 of that mode:

.. math:: q = m e_1 + e_2, \quad
          \dot q = m e_2 + A_{21} e_1 + A_{22} e_2 + B_2 (u_{SM} + \varepsilon)

.. math:: u = v + h(v) - B_2^{-1}(m e_2 + A_{21} e_1 + A_{22} e_2) + u_3 - \varepsilon, \quad
          u_3 = -\frac{P q + I \int q\,dt}{1 + B_2 D_c}

e and eps are those at the instant at which u begins to act (`modal`). On the surface that mode
decays as exp(-m t), and every other mode as it does by itself: the zeros of the transfer from u
to q are -m and the poles of the other modes, so the sliding motion is stable where V is. With one
mode and no delay these are Eqs 7 to 14, q' solved for u_3 as `pidsmc` does.

Inputs
    `Reference` W (m, m/s, m/s^2), the same previewed, `Estimate` (m, m/s, V), x1 as measured.
Outputs
    command u (V).
State
    see `modal`; integral v_I (V).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pea_controller.model import modal, slew
from pea_controller.model.common import limited
from pea_controller.model.modal import (
    ModalParams,
    Row,
    absorbed,
    begun,
    committed,
    product,
    row,
    seen,
)
from pea_core.modal import ModalModel
from pea_core.params import param
from pea_core.signals import Estimate, Reference

TAKES_MEASUREMENT = True


@dataclass(frozen=True)
class Params(ModalParams):
    """Model, estimator, sliding surface and PID of Eqs 9 and 14."""

    m: float = param(5000.0, "1/s", 1e-3, 1e6, help="slope of the sliding surface")
    P: float = param(0.0012, "V s/um", 0.0, 10.0, help="proportional gain on q")
    I: float = param(0.0, "V/um", 0.0, 1e4, help="integral gain on q")  # noqa: E741
    D_c: float = param(0.0, "V s^2/um", 0.0, 1e-3, help="derivative gain on q")


class Coefficients(NamedTuple):
    """Those of `modal`; rows of the command without integral, and of q; I T_s; 1 + B_2 D_c."""

    of: modal.Coefficients
    g: Row
    q: Row
    I_T: float
    D: float


class State(NamedTuple):
    """That of `modal`, integral (V).  actuator: see `slew`."""

    of: modal.State
    v_I: float
    actuator: slew.State


def surface(model: ModalModel, m: float) -> np.ndarray:
    """S (2n) of q = S delta."""
    S = np.zeros(2 * len(model.K))
    first = 2 * int(np.argmax(np.abs(model.K)))
    S[first], S[first + 1] = m, 1.0
    return S


def gains(model: ModalModel, m: float, P: float, D: float) -> np.ndarray:
    """g (2n) of the command without the integral, Eqs 12 and 14; P in V s/m."""
    i = int(np.argmax(np.abs(model.K)))
    omega, zeta, K = model.omega_n[i], model.zeta[i], model.K[i] * 1e-6
    g = P / D * surface(model, m)
    B2 = K * omega * omega
    g[2 * i] += -omega * omega / B2
    g[2 * i + 1] += (m - 2.0 * zeta * omega) / B2
    return np.asarray(g)


def design(params: Params, T_s: float) -> Coefficients:
    """Surface and gains in modal coordinates, predicted."""
    model = params.modes
    i = int(np.argmax(np.abs(model.K)))
    B2 = abs(model.K[i]) * 1e-6 * model.omega_n[i] ** 2
    D = 1.0 + B2 * params.D_c * 1e6
    sign = 1.0 if model.K[i] > 0.0 else -1.0
    g = row(params, gains(model, params.m, sign * params.P * 1e6, D), 1.0, T_s, T_s)
    q = row(params, surface(model, params.m), 0.0, 0.0, T_s)
    I_T = sign * params.I * 1e6 * T_s
    of = modal.design(params, T_s, lambda z: [(g, 1.0), (q, I_T / D / (1.0 - 1.0 / z))])
    return Coefficients(of, g, q, I_T, D)


def start(c: Coefficients) -> State:
    """At rest, no integral."""
    s = begun(c.of)
    return State(s, 0.0, s.actuator)


def output(c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate) -> float:
    """Eqs 7, 12 and 14 on the predicted deviation."""
    now = seen(c.of, s.of, W, W_ff, x.x1)
    u = now.u_ff - product(c.of, s.of, c.g, now)
    if c.I_T != 0.0:
        u -= (s.v_I + c.I_T * product(c.of, s.of, c.q, now)) / c.D
    return u


def update(
    c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate, u: float
) -> State:
    """Integrate, unless the actuator cannot apply u; keep the rest."""
    v_I = s.v_I
    if c.I_T != 0.0 and not limited(u, c.of.actuator.low, c.of.actuator.high):
        v_I += c.I_T * product(c.of, s.of, c.q, seen(c.of, s.of, W, W_ff, x.x1))
    after = committed(c.of, s.of, W, W_ff, x.x1, u)
    return State(after, v_I, after.actuator)


def absorb(c: Coefficients, s: State, gap: float) -> State:
    """Unknown input with which u is higher by `gap` (V)."""
    return s._replace(of=absorbed(s.of, gap))


unlearned = modal.unlearned
