r"""Sine: w(t) = offset + amplitude sin(2 pi f t + phase).

phase_deg = -90 starts at rest at the lowest point: offset - amplitude cos(2 pi f t).

Outputs
    `Reference` (m, m/s, m/s^2), exact derivatives.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from pea_core.params import param
from pea_core.signals import Reference
from pea_reference.model.common import below_nyquist
from pea_reference.model.shaper import Shapeable


@dataclass(frozen=True)
class Params(Shapeable):
    """One sine."""

    amplitude_um: float = param(5.0, "um", 0.0, 1e4, help="amplitude", common=True)
    offset_um: float = param(5.0, "um", -1e4, 1e4, help="mean displacement", common=True)
    frequency_hz: float = param(10.0, "Hz", 1e-6, 1e5, help="frequency")
    phase_deg: float = param(0.0, "deg", -360.0, 360.0, help="phase at t = 0")


class Coefficients(NamedTuple):
    """Amplitude and offset (m), angular frequency (rad/s), phase (rad), period (s)."""

    amplitude: float
    offset: float
    omega: float
    phase: float
    T_s: float


def design(params: Params, T_s: float) -> Coefficients:
    """Convert to SI.

    Raises
    ------
    ParameterError
        The frequency is not below half the sample rate.
    """
    below_nyquist("frequency_hz", params.frequency_hz, T_s)
    return Coefficients(
        params.amplitude_um * 1e-6,
        params.offset_um * 1e-6,
        2.0 * math.pi * params.frequency_hz,
        math.radians(params.phase_deg),
        T_s,
    )


def segments(params: Params) -> tuple[tuple[float, float, float], ...]:
    """Start, end and period (s) of each part that repeats itself: one without end."""
    return ((0.0, math.inf, 1.0 / params.frequency_hz),)


def output(c: Coefficients, k: int) -> Reference:
    """Reference at sample k."""
    angle = c.omega * (k * c.T_s) + c.phase
    sine = c.amplitude * math.sin(angle)
    return Reference(
        c.offset + sine,
        c.amplitude * c.omega * math.cos(angle),
        -c.omega * c.omega * sine,
    )
