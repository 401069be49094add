r"""Triangle with rounded turns, so that its second derivative exists and is continuous.

Over a quarter of a period, p = f t from the lowest point, 0 <= p <= 1/4, with r = rounding/4:

.. math:: \frac{dw}{dp} = v\,g(p/r), \quad g(x) = \frac{3x - x^3}{2} \;(x < 1), \quad
          g = 1 \;(x \ge 1)

The other quarters are its mirror images. v = a / (1/4 - 3 r/8) makes the amplitude exactly a.
It starts at its lowest point, at rest; rounding 1 is nearly a sine.

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
    """One triangle."""

    amplitude_um: float = param(5.0, "um", 0.0, 1e4, help="amplitude", common=True)
    offset_um: float = param(5.0, "um", -1e4, 1e4, help="mean displacement", common=True)
    frequency_hz: float = param(10.0, "Hz", 1e-6, 1e5, help="frequency")
    rounding: float = param(0.1, "", 0.001, 1.0, help="share of the period that is rounded")


class Coefficients(NamedTuple):
    """Offset (m), f (Hz), v (m), r (1), period (s)."""

    offset: float
    f: float
    v: float
    r: float
    T_s: float


def design(params: Params, T_s: float) -> Coefficients:
    """Convert to SI.

    Raises
    ------
    ParameterError
        The frequency is not below half the sample rate.
    """
    below_nyquist("frequency_hz", params.frequency_hz, T_s)
    r = params.rounding / 4.0
    v = params.amplitude_um * 1e-6 / (0.25 - 0.375 * r)
    return Coefficients(params.offset_um * 1e-6, params.frequency_hz, v, r, T_s)


def segments(params: Params) -> tuple[tuple[float, float, float], ...]:
    """Start, end and period (s) of each part that repeats itself: one without end."""
    return ((0.0, math.inf, 1.0 / params.frequency_hz),)


def output(c: Coefficients, k: int) -> Reference:
    """Reference at sample k."""
    cycles = c.f * (k * c.T_s)
    p = cycles - math.floor(cycles)
    falls = p >= 0.5
    if falls:
        p -= 0.5
    late = p > 0.25
    if late:
        p = 0.5 - p
    x = p / c.r
    if x < 1.0:
        w = c.v * (0.375 * c.r - 0.25 + c.r * x * x * (0.75 - 0.125 * x * x))
        w_dot = c.v * c.f * (0.5 * x * (3.0 - x * x))
        w_ddot = c.v * c.f * c.f / c.r * (1.5 * (1.0 - x * x))
    else:
        w = c.v * (p - 0.25)
        w_dot = c.v * c.f
        w_ddot = 0.0
    if late:
        w = -w
        w_ddot = -w_ddot
    if falls:
        w, w_dot, w_ddot = -w, -w_dot, -w_ddot
    return Reference(c.offset + w, w_dot, w_ddot)
