"""No estimate: y as it is measured, for laws with an estimator of their own.

Inputs
    `Measurement` (m).
Outputs
    `Estimate` with x1 = y (m), and x2 and eps = 0.
State
    none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from pea_core.nominal import NominalModel
from pea_core.signals import Estimate, Measurement
from pea_observer.model.passthrough import Coefficients, State, design, start, update

__all__ = ["Coefficients", "Params", "State", "design", "output", "start", "update"]

KNOWS_EPS = False


@dataclass(frozen=True)
class Params(NominalModel):
    """The nominal model, for the matching condition only."""

    PRESET: ClassVar[str] = "measured"


def output(c: Coefficients, s: State, measured: Measurement) -> Estimate:
    """x1 = y."""
    return Estimate(measured.y, c.eps, c.eps)
