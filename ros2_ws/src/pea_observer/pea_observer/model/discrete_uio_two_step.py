r"""Unknown-input observer of the sampled plant that waits for two samples.

eps is taken to be the same in two neighbouring intervals. Then two measurements tell of one
unknown, and what is left over places the poles that `discrete_uio` leaves at the sampling zero.
With a the state to which u alone, without eps, would have led from the last delayed estimate:

.. math:: a_{k-1} = \Phi \hat x_{k-2} + \Gamma u_{k-2}, \quad
          r_k = \begin{bmatrix} y_{k-1} - C a_{k-1} \\
          y_k - C(\Phi a_{k-1} + \Gamma u_{k-1}) \end{bmatrix}
          = \begin{bmatrix} C \Phi \\ C \Phi^2 \end{bmatrix} e_{k-2} + M \varepsilon, \quad
          M = \begin{bmatrix} C \Gamma \\ C (\Phi + I) \Gamma \end{bmatrix}

.. math:: \hat\varepsilon_k = M^+ r_k, \quad
          \hat x_{k-1} = a_{k-1} + G r_k, \quad
          \hat x_k = \Phi \hat x_{k-1} + \Gamma (u_{k-1} + \hat\varepsilon_k)

G M = Gamma takes eps out of the error e, which is left with two poles at exp(-omega_o T_s).

Inputs
    `Measurement` (m, V).
Outputs
    `Estimate` (m, m/s, V).
State
    a, and how far the last measurement was from it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from pea_core.nominal import NominalModel, hold, state_space
from pea_core.params import ParameterError, param
from pea_core.signals import Estimate, Measurement
from pea_observer.model.current_form import place


@dataclass(frozen=True)
class Params(NominalModel):
    """Nominal model and observer pole."""

    PRESET: ClassVar[str] = "discrete_uio_two_step"

    omega_o: float = param(30000.0, "rad/s", 1.0, 1e6, help="double observer pole")


class Coefficients(NamedTuple):
    """Phi (2, 2), Gamma (2), G (2, 2) and M^+ (2), entry by entry."""

    f11: float
    f12: float
    f21: float
    f22: float
    g1: float
    g2: float
    k11: float
    k12: float
    k21: float
    k22: float
    h1: float
    h2: float


class State(NamedTuple):
    """a_{k-1} (m, m/s), and r1 = y_{k-1} - C a_{k-1} (m)."""

    a1: float
    a2: float
    r1: float


def design(params: Params, T_s: float) -> Coefficients:
    """Take eps out of the error and place its poles."""
    A, B, C = state_space(params)
    F, G = hold(A, B, T_s)
    tells = np.vstack([C @ F, C @ F @ F])
    M = np.vstack([C @ G, C @ (F + np.eye(2)) @ G])
    length = math.hypot(M[0, 0], M[1, 0])
    if not length > 0.0:
        raise ParameterError("the observer cannot be designed: y does not determine eps")
    plus = M.T / length / length
    free = np.array([[M[1, 0], -M[0, 0]]]) / length
    p = math.exp(-params.omega_o * T_s)
    Z = place(F - G @ plus @ tells, free @ tells, [p, p])
    gain = G @ plus + np.outer(Z, free)
    return Coefficients(
        *F.ravel().tolist(), *G[:, 0].tolist(), *gain.ravel().tolist(), *plus[0].tolist()
    )


def start(c: Coefficients) -> State:
    """At rest."""
    return State(0.0, 0.0, 0.0)


def output(c: Coefficients, s: State, measured: Measurement) -> Estimate:
    """Correct x_{k-1} with two measurements, then go on to x_k."""
    u = measured.u_applied
    r2 = measured.y - (c.f11 * s.a1 + c.f12 * s.a2 + c.g1 * u)
    v = u + c.h1 * s.r1 + c.h2 * r2
    x1 = s.a1 + c.k11 * s.r1 + c.k12 * r2
    x2 = s.a2 + c.k21 * s.r1 + c.k22 * r2
    return Estimate(c.f11 * x1 + c.f12 * x2 + c.g1 * v, c.f21 * x1 + c.f22 * x2 + c.g2 * v, v - u)


def update(c: Coefficients, s: State, measured: Measurement, estimate: Estimate) -> State:
    """Take eps out of the estimate again: a_k."""
    a1 = estimate.x1 - c.g1 * estimate.eps
    return State(a1, estimate.x2 - c.g2 * estimate.eps, measured.y - a1)
