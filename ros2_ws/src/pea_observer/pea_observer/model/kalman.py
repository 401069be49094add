r"""Stationary Kalman filter with the unknown input eps of Eq 2 as a random walk.

.. math:: \varepsilon_k = \varepsilon_{k-1} + w_k, \quad
          x_k = \Phi x_{k-1} + \Gamma (u_{k-1} + \varepsilon_k), \quad y_k = x_{1,k} + n_k

with eps_k held over the interval that ends at t_k, white w of variance q^2 T_s and white n of
variance sigma^2. The model and the two steps, predict and correct, are those of `extended_state`;
only the gain L differs: it is the one that gives the least variance for the ratio q / sigma.

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
from typing import ClassVar

import numpy as np

from pea_core.nominal import NominalModel
from pea_core.params import param
from pea_core.units import NM
from pea_observer.model.current_form import kalman_gain
from pea_observer.model.extended_state import (
    Coefficients,
    State,
    coefficients,
    extended,
    output,
    start,
    update,
)

__all__ = ["Coefficients", "Params", "State", "design", "output", "start", "update"]


@dataclass(frozen=True)
class Params(NominalModel):
    """Nominal model and noises."""

    PRESET: ClassVar[str] = "kalman"

    noise_nm: float = param(0.7, "nm", 1e-3, 1e6, help="sensor noise sigma, rms")
    eps_walk: float = param(
        30.0, "V/sqrt(s)", 1e-3, 1e6, help="q: how far eps walks, rms after one second"
    )


def design(params: Params, T_s: float) -> Coefficients:
    """Solve Riccati's equation for the extended model."""
    F, G, C = extended(params, T_s)
    walk = F[:, 2] * params.eps_walk * math.sqrt(T_s)
    K = params.K * 1e-6
    scale = np.array([K, K * params.omega_n, 1.0])
    return coefficients(
        F, G, kalman_gain(F, C, np.outer(walk, walk), (params.noise_nm * NM) ** 2, scale)
    )
