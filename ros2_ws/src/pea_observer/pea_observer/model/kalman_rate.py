r"""Stationary Kalman filter with [eps, eps'] as states: eps' is the random walk.

.. math:: \varepsilon_k = \varepsilon_{k-1} + T_s \varepsilon'_{k-1} + w_{1,k}, \quad
          \varepsilon'_k = \varepsilon'_{k-1} + w_{2,k}, \quad
          x_k = \Phi x_{k-1} + \Gamma (u_{k-1} + \varepsilon_k), \quad y_k = x_{1,k} + n_k

with eps_k held over the interval that ends at t_k, white n of variance sigma^2, and w what a
random walk of eps' with density q leaves after one sample:

.. math:: E\, w w^T = q^2 \begin{bmatrix} T_s^3/3 & T_s^2/2 \\ T_s^2/2 & T_s \end{bmatrix}

It follows a ramp of eps without lag. q belongs to the signal: it rises with its frequency.

Inputs
    `Measurement` (m, V).
Outputs
    `Estimate` (m, m/s, V).
State
    displacement, velocity, eps and eps' after the last correction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from pea_core.nominal import NominalModel, hold, ramping, state_space
from pea_core.params import param
from pea_core.signals import Estimate, Measurement
from pea_core.units import NM
from pea_observer.model.current_form import kalman_gain


@dataclass(frozen=True)
class Params(NominalModel):
    """Nominal model and noises."""

    PRESET: ClassVar[str] = "kalman_rate"

    noise_nm: float = param(0.7, "nm", 1e-3, 1e6, help="sensor noise sigma, rms")
    eps_rate_walk: float = param(
        1e5, "V/s/sqrt(s)", 1.0, 1e10, help="q: how far eps' walks, rms after one second"
    )


class Coefficients(NamedTuple):
    """Phi (2, 2), Gamma (2), L (4) entry by entry, and the sample period (s)."""

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
    T_s: float


class State(NamedTuple):
    """Displacement (m), velocity (m/s), eps (V) and eps' (V/s) after the last correction."""

    x1: float
    x2: float
    eps: float
    eps_dot: float


def design(params: Params, T_s: float) -> Coefficients:
    """Discretise Eq 2 and solve Riccati's equation for the extended model."""
    A, B, C2 = state_space(params)
    F2, G2 = hold(A, B, T_s)
    F, into = ramping(F2, G2, T_s)
    C = np.hstack([C2, np.zeros((1, 2))])
    walk = np.array([[T_s**3 / 3.0, T_s**2 / 2.0], [T_s**2 / 2.0, T_s]])
    Q = params.eps_rate_walk**2 * into @ walk @ into.T
    K = params.K * 1e-6
    scale = np.array([K, K * params.omega_n, 1.0, params.omega_n])
    L = kalman_gain(F, C, Q, (params.noise_nm * NM) ** 2, scale)
    return Coefficients(*np.concatenate([F2.ravel(), G2[:, 0], L, [T_s]]).tolist())


def start(c: Coefficients) -> State:
    """At rest, no unknown input."""
    return State(0.0, 0.0, 0.0, 0.0)


def output(c: Coefficients, s: State, measured: Measurement) -> Estimate:
    """Predict with the voltage that was applied, correct with y."""
    eps = s.eps + c.T_s * s.eps_dot
    v = measured.u_applied + eps
    x1 = c.f11 * s.x1 + c.f12 * s.x2 + c.g1 * v
    x2 = c.f21 * s.x1 + c.f22 * s.x2 + c.g2 * v
    r = measured.y - x1
    return Estimate(x1 + c.l1 * r, x2 + c.l2 * r, eps + c.l3 * r)


def update(c: Coefficients, s: State, measured: Measurement, estimate: Estimate) -> State:
    """Keep the estimate; correct eps'."""
    v = measured.u_applied + s.eps + c.T_s * s.eps_dot
    r = measured.y - (c.f11 * s.x1 + c.f12 * s.x2 + c.g1 * v)
    return State(estimate.x1, estimate.x2, estimate.eps, s.eps_dot + c.l4 * r)
