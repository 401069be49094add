r"""Sum of sines, for measuring a frequency response in one run.

.. math:: w = w_0 + \sum_i a_i \sin(2 \pi f_i t + \varphi_i)

Schroeder's phases keep the peaks low: with p_i the share of the power in line i,

.. math:: \varphi_i = -2 \pi \sum_{l < i} (i - l)\, p_l

(M. R. Schroeder, IEEE Trans. Information Theory 16, 1970). They assume frequencies in rising
order at equal distances.

Outputs
    `Reference` (m, m/s, m/s^2), exact derivatives.
"""

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from pea_core.params import param
from pea_core.signals import Reference
from pea_reference.model.common import below_nyquist, one_each, some
from pea_reference.model.shaper import Shapeable


@dataclass(frozen=True)
class Params(Shapeable):
    """Sines at once."""

    offset_um: float = param(5.0, "um", -1e4, 1e4, help="mean displacement", common=True)
    frequencies_hz: tuple[float, ...] = param(
        (10.0, 20.0, 30.0, 40.0, 50.0), "Hz", 1e-6, 1e5, help="frequencies"
    )
    amplitudes_um: tuple[float, ...] = param(
        (1.0,), "um", 0.0, 1e4, help="amplitude of each, or of all"
    )
    phases: str = param(
        "schroeder", help="where the phases come from", choices=("schroeder", "listed")
    )
    phases_deg: tuple[float, ...] = param(
        (0.0,), "deg", -36000.0, 36000.0, help="phase of each, or of all, where listed"
    )

    def __post_init__(self) -> None:
        some("frequencies_hz", self.frequencies_hz)
        one_each("amplitudes_um", self.amplitudes_um, len(self.frequencies_hz))
        one_each("phases_deg", self.phases_deg, len(self.frequencies_hz))


class Coefficients(NamedTuple):
    """Offset (m), and of each sine (n): amplitude (m), omega (rad/s), phase (rad); period (s)."""

    offset: float
    amplitude: np.ndarray
    omega: np.ndarray
    phase: np.ndarray
    T_s: float


def schroeder(amplitude: np.ndarray) -> np.ndarray:
    """Phases (n) in rad, within +-pi, for amplitudes (n) of any unit."""
    power = amplitude * amplitude
    total = power.sum()
    share = power / total if total > 0.0 else power
    phase = -2.0 * math.pi * np.concatenate([[0.0], np.cumsum(np.cumsum(share))[:-1]])
    return np.arctan2(np.sin(phase), np.cos(phase))


def design(params: Params, T_s: float) -> Coefficients:
    """Convert to SI.

    Raises
    ------
    ParameterError
        A frequency is not below half the sample rate.
    """
    f = params.frequencies_hz
    for i, f_i in enumerate(f):
        below_nyquist(f"frequencies_hz[{i}]", f_i, T_s)
    amplitude = np.array(one_each("amplitudes_um", params.amplitudes_um, len(f))) * 1e-6
    if params.phases == "schroeder":
        phase = schroeder(amplitude)
    else:
        phase = np.radians(one_each("phases_deg", params.phases_deg, len(f)))
    return Coefficients(params.offset_um * 1e-6, amplitude, 2.0 * math.pi * np.array(f), phase, T_s)


def lines(params: Params) -> tuple[float, ...]:
    """Frequencies (Hz) at which a response can be measured."""
    return params.frequencies_hz


def segments(params: Params) -> tuple[tuple[float, float, float], ...]:
    """Start, end and period (s) of the sum: one without end, none where no period is common."""
    lines = [Fraction(f).limit_denominator(1_000_000) for f in params.frequencies_hz]
    if any(abs(float(line) - f) > 1e-12 * f for line, f in zip(lines, params.frequencies_hz)):
        return ()
    whole = math.lcm(*(line.denominator for line in lines))
    base = math.gcd(*(int(line * whole) for line in lines))
    return ((0.0, math.inf, whole / base),)


def output(c: Coefficients, k: int) -> Reference:
    """Reference at sample k."""
    t = k * c.T_s
    w = c.offset
    w_dot = 0.0
    w_ddot = 0.0
    for i in range(c.omega.size):
        amplitude, omega = float(c.amplitude[i]), float(c.omega[i])
        angle = omega * t + float(c.phase[i])
        sine = amplitude * math.sin(angle)
        w += sine
        w_dot += amplitude * omega * math.cos(angle)
        w_ddot -= omega * omega * sine
    return Reference(w, w_dot, w_ddot)
