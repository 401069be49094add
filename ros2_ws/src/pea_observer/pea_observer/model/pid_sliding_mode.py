r"""PID-based sliding mode observer: the dual of Eq 14, which needs no matching condition.

The discontinuous injection of a sliding mode observer is replaced by a PID regulator of the
innovation r. All of it enters where eps does, so that v takes the place of eps:

.. math:: \bar x_k = \Phi \hat x_{k-1} + \Gamma (u_{k-1} + v_{I,k-1}), \quad
          r_k = y_k - C \bar x_k

.. math:: v_{I,k} = v_{I,k-1} + I T_s r_k, \quad
          v_{D,k} = \gamma v_{D,k-1} + \frac{D}{T_s} (r_k - r_{k-1}), \quad
          v_k = P r_k + v_{I,k} + v_{D,k}

.. math:: \hat x_k = \Phi \hat x_{k-1} + \Gamma (u_{k-1} + v_k), \quad \hat\varepsilon_k = v_k

In continuous time, with an ideal derivative and a constant unknown input, the error obeys

.. math:: \dddot e + (B_2 D - A_{22}) \ddot e + (B_2 P - A_{21}) \dot e + B_2 I e = 0

The derivative stands in for the velocity that C B = 0 hides. P, I and D follow from the exact
sampled error, whose three poles are put at exp(-omega_o T_s).

Inputs
    `Measurement` (m, V).
Outputs
    `Estimate` (m, m/s, V).
State
    the last estimate of x, integral and derivative part of v, and innovation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from pea_core.nominal import NominalModel, hold, state_space
from pea_core.params import ParameterError, param
from pea_core.signals import Estimate, Measurement


@dataclass(frozen=True)
class Params(NominalModel):
    """Nominal model and observer pole."""

    PRESET: ClassVar[str] = "pid_sliding_mode"

    omega_o: float = param(20000.0, "rad/s", 1.0, 1e6, help="triple observer pole")


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
    """Displacement (m), velocity (m/s), parts v_I and v_D of v (V), innovation r (m)."""

    x1: float
    x2: float
    v_I: float
    v_D: float
    r: float


def design(params: Params, T_s: float) -> Coefficients:
    r"""Discretise Eq 2 and find the PID gains.

    With a(z) = z^2 + a_1 z + a_2 the polynomial of Phi, an injection v reaches r through
    C Phi (z I - Phi)^{-1} Gamma = n (z - gamma) / a(z), n = C Phi Gamma and
    gamma = C Gamma a_2 / n. The derivative's filter takes that zero for its pole. What is left is

    .. math:: a(z) (z - 1 + C \Gamma I T_s) + n (k_0 z^2 + k_1 z + k_2) = (z - p)^3

    with k_0 = P + I T_s + D/T_s, k_1 = -(1 + gamma) P - gamma I T_s - 2 D/T_s and
    k_2 = gamma P + D/T_s: three linear equations for P, I and D.

    Raises
    ------
    ParameterError
        y does not tell eps at this sample period, or the filter would not be stable.
    """
    A, B, C = state_space(params)
    F, G = hold(A, B, T_s)
    a1, a2 = -float(np.trace(F)), float(np.linalg.det(F))
    b, n = float(G[0, 0]), float((C @ F @ G)[0, 0])
    gamma = b * a2 / n if n != 0.0 else math.nan
    if not abs(gamma) < 1.0:
        raise ParameterError(
            "the observer cannot be designed: y does not determine eps at this sample period"
        )
    p = math.exp(-params.omega_o * T_s)
    gains = np.linalg.solve(
        np.array(
            [
                [1.0, 1.0 + b / n, 1.0],
                [-(1.0 + gamma), a1 * b / n - gamma, -2.0],
                [gamma, a2 * b / n, 1.0],
            ]
        ),
        np.array([-3.0 * p - a1 + 1.0, 3.0 * p * p - a2 + a1, -p * p * p + a2]) / n,
    )
    return Coefficients(*np.concatenate([F.ravel(), G[:, 0], gains, [gamma]]).tolist())


def start(c: Coefficients) -> State:
    """At rest, no unknown input."""
    return State(0.0, 0.0, 0.0, 0.0, 0.0)


def output(c: Coefficients, s: State, measured: Measurement) -> Estimate:
    """Predict with the voltage that was applied; let the PID explain y."""
    u = measured.u_applied
    x1 = c.f11 * s.x1 + c.f12 * s.x2 + c.g1 * u
    x2 = c.f21 * s.x1 + c.f22 * s.x2 + c.g2 * u
    r = measured.y - (x1 + c.g1 * s.v_I)
    v = c.P * r + (s.v_I + c.I_T * r) + (c.gamma * s.v_D + c.D_T * (r - s.r))
    return Estimate(x1 + c.g1 * v, x2 + c.g2 * v, v)


def update(c: Coefficients, s: State, measured: Measurement, estimate: Estimate) -> State:
    """Keep the estimate; integrate and filter."""
    u = measured.u_applied
    r = measured.y - (c.f11 * s.x1 + c.f12 * s.x2 + c.g1 * u + c.g1 * s.v_I)
    v_D = c.gamma * s.v_D + c.D_T * (r - s.r)
    return State(estimate.x1, estimate.x2, s.v_I + c.I_T * r, v_D, r)
