r"""Alpha-beta filter: displacement and velocity from y alone, no model of the actuator.

.. math:: \bar x_{1,k} = \hat x_{1,k-1} + T_s \hat x_{2,k-1}, \quad r_k = y_k - \bar x_{1,k}

.. math:: \hat x_{1,k} = \bar x_{1,k} + \alpha r_k, \quad
          \hat x_{2,k} = \hat x_{2,k-1} + \frac{\beta}{T_s} r_k

alpha = 1 - p^2 and beta = (1 - p)^2 put both poles of the error at p = exp(-omega_o T_s), the
critically damped choice. Under a constant acceleration a the estimate lags by

.. math:: x_1 - \hat x_1 = \frac{p^2}{(1 - p)^2} a T_s^2, \quad
          x_2 - \hat x_2 = \left(\frac{1 + p}{1 - p} - \frac{1}{2}\right) a T_s

Inputs
    `Measurement` (m); the voltage is not used.
Outputs
    `Estimate` (m, m/s) with eps = 0.
State
    the last estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from pea_core.nominal import NominalModel
from pea_core.params import param
from pea_core.signals import Estimate, Measurement
from pea_observer.model.luenberger import State, start, update

__all__ = ["Coefficients", "Params", "State", "design", "output", "start", "update"]

KNOWS_EPS = False


@dataclass(frozen=True)
class Params(NominalModel):
    """Observer pole; the nominal model is for the matching condition only."""

    PRESET: ClassVar[str] = "alpha_beta"

    omega_o: float = param(20000.0, "rad/s", 1.0, 1e6, help="double observer pole")


class Coefficients(NamedTuple):
    """alpha, beta / T_s (1/s) and T_s (s)."""

    alpha: float
    beta_T: float
    T_s: float


def design(params: Params, T_s: float) -> Coefficients:
    """Alpha and beta of the pole."""
    p = math.exp(-params.omega_o * T_s)
    return Coefficients(1.0 - p * p, (1.0 - p) * (1.0 - p) / T_s, T_s)


def output(c: Coefficients, s: State, measured: Measurement) -> Estimate:
    """Go on at the same velocity, correct with y."""
    x1 = s.x1 + c.T_s * s.x2
    r = measured.y - x1
    return Estimate(x1 + c.alpha * r, s.x2 + c.beta_T * r, 0.0)
