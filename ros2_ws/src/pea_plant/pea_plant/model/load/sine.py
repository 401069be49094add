r"""Sinusoidal load: f_e(t) = offset + amplitude sin(2 pi f t + phase)."""

import math
from dataclasses import dataclass
from typing import NamedTuple

from pea_core.params import param
from pea_plant.model.load.common import LoadParams, volts


@dataclass(frozen=True)
class Params(LoadParams):
    """One sine."""

    amplitude: float = param(1.0, "V or N", 0.0, 1e4, help="amplitude")
    offset: float = param(0.0, "V or N", -1e4, 1e4, help="mean load")
    frequency_hz: float = param(50.0, "Hz", 1e-6, 1e5, help="frequency")
    phase_deg: float = param(0.0, "deg", -360.0, 360.0, help="phase at t = 0")


class Coefficients(NamedTuple):
    """Amplitude and offset (V), angular frequency (rad/s), phase (rad), period (s)."""

    amplitude: float
    offset: float
    omega: float
    phase: float
    T_s: float


def design(params: Params, T_s: float, K: float) -> Coefficients:
    """Convert to volts, with V's steady-state gain K (um/V), and to SI."""
    unit = volts(params, K)
    return Coefficients(
        params.amplitude * unit,
        params.offset * unit,
        2.0 * math.pi * params.frequency_hz,
        math.radians(params.phase_deg),
        T_s,
    )


def output(c: Coefficients, k: int) -> float:
    """Volts-equivalent load (V) at sample k."""
    return c.offset + c.amplitude * math.sin(c.omega * (k * c.T_s) + c.phase)
