r"""Extended-state observer: the unknown input eps of Eq 2 as a third, constant state.

.. math:: \frac{d}{dt}\begin{bmatrix} x_1 \\ x_2 \\ \varepsilon \end{bmatrix} =
          \begin{bmatrix} 0 & 1 & 0 \\ A_{21} & A_{22} & B_2 \\ 0 & 0 & 0 \end{bmatrix}
          \begin{bmatrix} x_1 \\ x_2 \\ \varepsilon \end{bmatrix} +
          \begin{bmatrix} 0 \\ B_2 \\ 0 \end{bmatrix} u

.. math:: \bar x_k = \Phi \hat x_{k-1} + \Gamma u_{k-1}, \quad
          \hat x_k = \bar x_k + L (y_k - \bar x_{1,k})

Phi and Gamma are the exact discretisation, u the voltage really applied; L puts all three
poles of the error at exp(-omega_o T_s). It needs no matching condition.

Inputs
    `Measurement` (m, V).
Outputs
    `Estimate` (m, m/s, V).
State
    the last estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from pea_core.nominal import NominalModel, hold, state_space
from pea_core.params import param
from pea_core.signals import Estimate, Measurement
from pea_observer.model.current_form import current_gain


@dataclass(frozen=True)
class Params(NominalModel):
    """Nominal model and observer pole."""

    PRESET: ClassVar[str] = "extended_state"

    omega_o: float = param(20000.0, "rad/s", 1.0, 1e6, help="triple observer pole")


class Coefficients(NamedTuple):
    """Rows 1 and 2 of Phi (3, 3) and Gamma (3), and L (3), entry by entry."""

    f11: float
    f12: float
    f13: float
    f21: float
    f22: float
    f23: float
    g1: float
    g2: float
    l1: float
    l2: float
    l3: float


class State(NamedTuple):
    """Displacement (m), velocity (m/s) and unknown input (V) after the last correction."""

    x1: float
    x2: float
    eps: float


def extended(model: NominalModel, T_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Phi (3, 3), Gamma (3, 1) and C (1, 3) of the extended model."""
    A2, B2, C2 = state_space(model)
    A = np.zeros((3, 3))
    A[:2, :2], A[:2, 2:] = A2, B2
    F, G = hold(A, np.vstack([B2, [[0.0]]]), T_s)
    return F, G, np.hstack([C2, [[0.0]]])


def coefficients(F: np.ndarray, G: np.ndarray, L: np.ndarray) -> Coefficients:
    """The extended model with a gain L (3), entry by entry."""
    return Coefficients(*F[:2].ravel().tolist(), *G[:2, 0].tolist(), *L.tolist())


def design(params: Params, T_s: float) -> Coefficients:
    """Discretise the extended model and place the poles."""
    F, G, C = extended(params, T_s)
    return coefficients(F, G, current_gain(F, C, [math.exp(-params.omega_o * T_s)] * 3))


def start(c: Coefficients) -> State:
    """At rest, no unknown input."""
    return State(0.0, 0.0, 0.0)


def output(c: Coefficients, s: State, measured: Measurement) -> Estimate:
    """Predict with the voltage that was applied, correct with y."""
    u = measured.u_applied
    x1 = c.f11 * s.x1 + c.f12 * s.x2 + c.f13 * s.eps + c.g1 * u
    x2 = c.f21 * s.x1 + c.f22 * s.x2 + c.f23 * s.eps + c.g2 * u
    r = measured.y - x1
    return Estimate(x1 + c.l1 * r, x2 + c.l2 * r, s.eps + c.l3 * r)


def update(c: Coefficients, s: State, measured: Measurement, estimate: Estimate) -> State:
    """Keep the estimate."""
    return State(estimate.x1, estimate.x2, estimate.eps)
