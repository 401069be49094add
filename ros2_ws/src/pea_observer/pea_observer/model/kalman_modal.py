r"""Stationary Kalman filter on modes behind a delay, with [eps, eps'] as states.

Model, delays and prediction are those of `modes`. The filter follows from the sensor's noise, the
random walk of eps' and a white voltage at the input, which stands for errors of the model:
`pea_core.modal.kalman`. With one mode, no delay and no white voltage it is `kalman_rate`.

Inputs
    `Measurement` (m, V).
Outputs
    `Estimate` (m, m/s, V).
State
    see `modes`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from pea_core.modal import Noises, kalman
from pea_core.params import group
from pea_core.signals import Estimate, Measurement
from pea_observer.model import modes
from pea_observer.model.modes import Coefficients, State, begun, estimated, kept


@dataclass(frozen=True)
class Params(modes.ModesParams):
    """Model, sensor's delay and noises."""

    PRESET: ClassVar[str] = "kalman_modal"

    estimator: Noises = group(Noises)


def design(params: Params, T_s: float) -> Coefficients:
    """Solve Riccati's equation for the extended model."""
    return modes.designed(params, kalman(params.modes, params.estimator, T_s), T_s)


def start(c: Coefficients) -> State:
    """At rest, no unknown input."""
    return begun(c)


def output(c: Coefficients, s: State, measured: Measurement) -> Estimate:
    """Predict, correct, and predict to the present."""
    return estimated(c, s, measured)


def update(c: Coefficients, s: State, measured: Measurement, estimate: Estimate) -> State:
    """Keep the corrected estimate and the voltage."""
    return kept(c, s, measured)
