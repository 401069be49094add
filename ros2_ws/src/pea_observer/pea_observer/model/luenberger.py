r"""Luenberger observer of the nominal model, Eq 2 with eps = 0, in current form.

.. math:: \bar x_k = \Phi \hat x_{k-1} + \Gamma u_{k-1}, \quad
          \hat x_k = \bar x_k + L (y_k - \bar x_{1,k})

Phi and Gamma are the exact discretisation; L puts both poles of the error at
exp(-omega_o T_s). It knows of no unknown input, so eps biases it.

Inputs
    `Measurement` (m, V).
Outputs
    `Estimate` (m, m/s) with eps = 0.
State
    the last estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from pea_core.nominal import NominalModel, hold, state_space
from pea_core.params import param
from pea_core.signals import Estimate, Measurement
from pea_observer.model.current_form import current_gain

KNOWS_EPS = False


@dataclass(frozen=True)
class Params(NominalModel):
    """Nominal model and observer pole."""

    PRESET: ClassVar[str] = "luenberger"

    omega_o: float = param(20000.0, "rad/s", 1.0, 1e6, help="double observer pole")


class Coefficients(NamedTuple):
    """Phi (2, 2), Gamma (2) and L (2), entry by entry."""

    f11: float
    f12: float
    f21: float
    f22: float
    g1: float
    g2: float
    l1: float
    l2: float


class State(NamedTuple):
    """Displacement (m) and velocity (m/s) after the last correction."""

    x1: float
    x2: float


def design(params: Params, T_s: float) -> Coefficients:
    """Discretise Eq 2 and place the poles."""
    A, B, C = state_space(params)
    F, G = hold(A, B, T_s)
    L = current_gain(F, C, [math.exp(-params.omega_o * T_s)] * 2)
    return Coefficients(*F.ravel().tolist(), *G[:, 0].tolist(), *L.tolist())


def start(c: Coefficients) -> State:
    """At rest."""
    return State(0.0, 0.0)


def output(c: Coefficients, s: State, measured: Measurement) -> Estimate:
    """Predict with the voltage that was applied, correct with y."""
    u = measured.u_applied
    x1 = c.f11 * s.x1 + c.f12 * s.x2 + c.g1 * u
    x2 = c.f21 * s.x1 + c.f22 * s.x2 + c.g2 * u
    r = measured.y - x1
    return Estimate(x1 + c.l1 * r, x2 + c.l2 * r, 0.0)


def update(c: Coefficients, s: State, measured: Measurement, estimate: Estimate) -> State:
    """Keep the estimate."""
    return State(estimate.x1, estimate.x2)
