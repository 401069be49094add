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
from typing import ClassVar, NamedTuple

from pea_core.nominal import NominalModel
from pea_core.signals import Estimate, Measurement

KNOWS_EPS = False


@dataclass(frozen=True)
class Params(NominalModel):
    """The nominal model, for the matching condition only."""

    PRESET: ClassVar[str] = "measured"


class Coefficients(NamedTuple):
    """What is said of velocity and eps: nothing."""

    zero: float


class State(NamedTuple):
    """Nothing."""

    zero: float


def design(params: Params, T_s: float) -> Coefficients:
    """Nothing to design."""
    return Coefficients(0.0)


def start(c: Coefficients) -> State:
    """No memory."""
    return State(c.zero)


def output(c: Coefficients, s: State, measured: Measurement) -> Estimate:
    """x1 = y."""
    return Estimate(measured.y, c.zero, c.zero)


def update(c: Coefficients, s: State, measured: Measurement, estimate: Estimate) -> State:
    """No memory."""
    return s
