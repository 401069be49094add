r"""Levant's robust exact differentiator, aided by the nominal model, discretised exactly.

The differentiator of second order for [x1, x2, eps] corrects with the roots of the innovation r,
|r|^{2/3}, |r|^{1/3} and |r|^0, times its sign, and is exact in finite time for |eps'| <= L.
Written with the innovation itself, these are the gains of a linear observer whose pole depends
on r,

.. math:: \omega_k = \max\left(\omega_{min},\;
          \left(\frac{1.1\, B_2 L}{|r_k|}\right)^{1/3}\right)

so that the exact discretisation is the extended-state observer (`extended_state`) with that pole,
Phi and Gamma the exact step of the model:

.. math:: \hat x_k = \bar x_k + (\Phi - e^{-\omega_k T_s} I)^3 w\, r_k, \quad
          w = \begin{bmatrix} C\Phi \\ C\Phi^2 \\ C\Phi^3 \end{bmatrix}^{-1}
              \begin{bmatrix} 0 \\ 0 \\ 1 \end{bmatrix}

No step chatters: as r goes to 0 the gain goes to the dead-beat one and the correction to 0.
omega_min keeps a large r from making the observer slower than the actuator. L belongs to the
signal: with eps' beyond it lock is lost down to omega_min.

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

from pea_core.nominal import NominalModel
from pea_core.params import ParameterError, param
from pea_core.signals import Estimate, Measurement
from pea_observer.model.current_form import current_gain, direction
from pea_observer.model.extended_state import State, extended, start, update

__all__ = ["Coefficients", "Params", "State", "design", "output", "start", "update"]


@dataclass(frozen=True)
class Params(NominalModel):
    """Nominal model and bound of eps'."""

    PRESET: ClassVar[str] = "levant"

    eps_rate: float = param(50000.0, "V/s", 1e-3, 1e9, help="L: bound of |eps'|")
    omega_min: float = param(8000.0, "rad/s", 1.0, 1e6, help="slowest observer pole")


class Coefficients(NamedTuple):
    """Rows 1 and 2 of Phi (3, 3) and Gamma (3), and the gain as a polynomial of the pole.

    The gain for the pole 1 - q is a0 + q (a1 + q (a2 + q a3)) for x1, b alike for x2, and
    q^3 c3 for eps.  reach : 1.1 B_2 L (m/s^3).  omega_min (rad/s).  T_s (s).
    """

    f11: float
    f12: float
    f13: float
    f21: float
    f22: float
    f23: float
    g1: float
    g2: float
    a0: float
    a1: float
    a2: float
    a3: float
    b0: float
    b1: float
    b2: float
    b3: float
    c3: float
    reach: float
    omega_min: float
    T_s: float


def design(params: Params, T_s: float) -> Coefficients:
    """Discretise the extended model; find the gain as a polynomial of the pole."""
    F, G, C = extended(params, T_s)
    current_gain(F, C, [math.exp(-params.omega_min * T_s)] * 3)  # refuses what it cannot place
    D = F - np.eye(3)
    w = direction(F, C @ F)
    # (F - (1 - q) I)^3 w = D^3 w + 3 q D^2 w + 3 q^2 D w + q^3 w
    powers = np.column_stack([D @ D @ D @ w, 3.0 * D @ D @ w, 3.0 * D @ w, w])
    if not np.isfinite(powers).all():
        raise ParameterError("the observer cannot be designed: y does not determine all states")
    reach = 1.1 * params.B2 * params.eps_rate
    rest = np.array([w[2], reach, params.omega_min, T_s])
    entries = np.concatenate([F[:2].ravel(), G[:2, 0], powers[:2].ravel(), rest])
    return Coefficients(*entries.tolist())


def output(c: Coefficients, s: State, measured: Measurement) -> Estimate:
    """Predict with the voltage that was applied, correct with y at the pole of this r."""
    u = measured.u_applied
    x1 = c.f11 * s.x1 + c.f12 * s.x2 + c.f13 * s.eps + c.g1 * u
    x2 = c.f21 * s.x1 + c.f22 * s.x2 + c.f23 * s.eps + c.g2 * u
    r = measured.y - x1
    q = 1.0
    if r != 0.0:
        q -= math.exp(-c.T_s * max(c.omega_min, math.pow(c.reach / abs(r), 1.0 / 3.0)))
    l1 = c.a0 + q * (c.a1 + q * (c.a2 + q * c.a3))
    l2 = c.b0 + q * (c.b1 + q * (c.b2 + q * c.b3))
    return Estimate(x1 + l1 * r, x2 + l2 * r, s.eps + q * q * q * c.c3 * r)
