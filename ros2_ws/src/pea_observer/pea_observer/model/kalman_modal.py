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
from pea_observer.model import modes
from pea_observer.model.modes import Coefficients, State

__all__ = ["Coefficients", "Params", "State", "design", "output", "start", "update"]

start, output, update = modes.start, modes.output, modes.update


@dataclass(frozen=True)
class Params(modes.ModesParams):
    """Model, sensor's delay and noises."""

    PRESET: ClassVar[str] = "kalman_modal"

    estimator: Noises = group(Noises)


def design(params: Params, T_s: float) -> Coefficients:
    """Solve Riccati's equation for the extended model."""
    return modes.designed(params, kalman(params.modes, params.estimator, T_s), T_s)
