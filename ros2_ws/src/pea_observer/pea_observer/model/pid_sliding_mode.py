r"""PID-based sliding mode observer: the dual of Eq 14, which needs no matching condition.

The discontinuous injection of a sliding mode observer is replaced by a PID regulator of the
innovation r. All of it enters where eps does, so that v takes the place of eps:

.. math:: \hat x_k = \Phi \hat x_{k-1} + \Gamma (u_{k-1} + v_k), \quad
          r_k = y_k - C (\Phi \hat x_{k-1} + \Gamma u_{k-1})

.. math:: v_k = P r_k + v_{I,k} + v_{D,k}, \quad v_{I,k} = v_{I,k-1} + I T_s r_k, \quad
          v_{D,k} = \gamma v_{D,k-1} + D \frac{r_k - r_{k-1}}{T_s}, \quad
          \hat\varepsilon_k = v_k

In continuous time, with an ideal derivative and a constant unknown input, the error obeys

.. math:: \dddot e + (B_2 D - A_{22}) \ddot e + (B_2 P - A_{21}) \dot e + B_2 I e = 0

The derivative stands in for the velocity that C B = 0 hides. P, I, D and gamma follow from the
exact sampled error: three of its poles are put at exp(-omega_o T_s), the fourth, which the
derivative's filter brings, at 0.

Inputs
    `Measurement` (m, V).
Outputs
    `Estimate` (m, m/s, V).
State
    the last estimate of x, integral, filtered derivative and innovation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pea_core.nominal import NominalModel, hold, state_space
from pea_core.params import ParameterError, param
from pea_core.signals import Estimate, Measurement

P4=0.0;V=True

@dataclass(frozen=True)
class Params(NominalModel):
    """Nominal model and observer pole."""

    omega_o: float = param(15000.0, "rad/s", 1.0, 1e6, help="triple observer pole")


class Coefficients(NamedTuple):
    """Phi (2, 2) and Gamma (2), entry by entry; P, I T_s, D / T_s (V/m) and gamma."""

    f11: float
    f12: float
    f21: float
    f22: float
    g1: float
    g2: float
    P: float
    I_T: float
    D_T: float
    gamma: float


class State(NamedTuple):
    """Displacement (m) and velocity (m/s), integral v_I (V), innovation r (m)."""

    x1: float
    x2: float
    v_I: float
    v_D: float
    r: float


def design(params: Params, T_s: float) -> Coefficients:
    r"""Discretise Eq 2 and find the PID gains.

    From v to -r the sampled model is n(z)/a(z) with a = z^2 + a_1 z + a_2 and
    C (z I - Phi)^{-1} Gamma = (b_1 z + b_2)/a, n = (b_2 - b_1 a_1) z - b_1 a_2. With the PID as
    (k_0 z^2 + k_1 z + k_2)/((z - 1)(z - gamma)) the error's polynomial is

    .. math:: (z - 1) (z - \gamma) a(z) + n(z) (k_0 z^2 + k_1 z + k_2) = (z - p)^3 z

    Raises
    ------
    ParameterError
        The filter of the derivative would not be stable.
    """
    A, B, C = state_space(params)
    F, G = hold(A, B, T_s)
    a = np.array([1.0, -np.trace(F), np.linalg.det(F)])
    b1, b2 = G[0, 0], F[0, 1] * G[1, 0] - F[1, 1] * G[0, 0]
    p = math.exp(-params.omega_o * T_s)
    p_4=P4*p
    wanted = np.poly([p, p, p, p_4])
    n = np.array([b2 - b1 * a[1], -b1 * a[2]])
    scale = float(np.abs(n).max())
    if not scale > 0.0:
        raise ParameterError("the observer cannot be designed: y does not tell eps")
    without = np.polymul([1.0, -1.0], a)  # times z - gamma
    columns = np.zeros((4, 4))
    for i in range(3):
        columns[i : i + 2, i] = n / scale
    columns[:, 3] = -without
    try:
        *k, gamma = np.linalg.solve(columns, (wanted - np.append(without, 0.0))[1:])
    except np.linalg.LinAlgError:
        gamma = math.nan
    if not abs(gamma) < 1.0:
        raise ParameterError(
            f"omega_o = {params.omega_o:g}: the derivative's filter would have its pole at "
            f"{gamma:.3g}, outside the unit circle"
        )
    I_T = sum(k) / (1.0 - gamma)
    D_T = np.polyval(k, gamma) / (1.0 - gamma) ** 2
    gains = np.array([k[0] - I_T - D_T, I_T, D_T]) / scale
    return Coefficients(*F.ravel().tolist(), *G[:, 0].tolist(), *gains.tolist(), float(gamma))


def start(c: Coefficients) -> State:
    """At rest, no unknown input."""
    return State(0.0, 0.0, 0.0, 0.0, 0.0)


def output(c: Coefficients, s: State, measured: Measurement) -> Estimate:
    """Predict with the voltage that was applied, let the PID explain y."""
    u = measured.u_applied
    x1 = c.f11 * s.x1 + c.f12 * s.x2 + c.g1 * u
    x2 = c.f21 * s.x1 + c.f22 * s.x2 + c.g2 * u
    r = measured.y - x1
    v = c.P * r + (s.v_I + c.I_T * r) + (c.gamma * s.v_D + c.D_T * (r - s.r))
    return Estimate(x1 + c.g1 * v, x2 + c.g2 * v, v if V else s.v_I + c.I_T * r)


def update(c: Coefficients, s: State, measured: Measurement, estimate: Estimate) -> State:
    """Keep the estimate; integrate."""
    r = measured.y - (c.f11 * s.x1 + c.f12 * s.x2 + c.g1 * measured.u_applied)
    v_D = c.gamma * s.v_D + c.D_T * (r - s.r)
    return State(estimate.x1, estimate.x2, s.v_I + c.I_T * r, v_D, r)
