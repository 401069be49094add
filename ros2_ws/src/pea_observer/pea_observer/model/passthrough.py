"""No observer: the true states of an ideal sensor, as the paper's own simulations use them.

Inputs
    `Measurement` with the true velocity.
Outputs
    `Estimate` with eps = 0: a sensor does not know the unknown input.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from pea_core.nominal import NominalModel
from pea_core.signals import Estimate, Measurement

NEEDS_VELOCITY = True
KNOWS_EPS = False


@dataclass(frozen=True)
class Params(NominalModel):
    """The nominal model, for the matching condition only."""

    PRESET: ClassVar[str] = "passthrough"


class Coefficients(NamedTuple):
    """What is said of eps: 0 (V)."""

    eps: float


class State(NamedTuple):
    """The last estimate of eps (V)."""

    eps: float


def design(params: Params, T_s: float) -> Coefficients:
    """Nothing to design."""
    return Coefficients(0.0)


def start(c: Coefficients) -> State:
    """No memory."""
    return State(c.eps)


def output(c: Coefficients, s: State, measured: Measurement) -> Estimate:
    """x̂ = x."""
    return Estimate(measured.y, measured.y_dot, c.eps)


def update(c: Coefficients, s: State, measured: Measurement, estimate: Estimate) -> State:
    """No memory."""
    return s
