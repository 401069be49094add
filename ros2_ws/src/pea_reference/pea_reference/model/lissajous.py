r"""Lissajous figure that closes after a frame, as fine as is asked for.

.. math:: x = \tfrac{\text{width}}{2} \sin\frac{2 \pi n_x t}{F}, \quad
          y = \tfrac{\text{height}}{2} \sin\frac{2 \pi n_y t}{F}, \quad n_y = n, \; n_x = n + 1

n and n + 1 have no common divisor and one of them is even, so the curve closes after the frame
time F and no part of it is passed twice. Its lines are furthest from each other in the middle,

.. math:: h = \frac{\pi A_x A_y}{n \sqrt{A_x^2 + A_y^2}}

with A the amplitudes; n is the least with h at most `resolution_um`. The amplitude rises from 0 by
q of `scan` during the share `start` of the first frame time; frame 0 begins after that.

Source: T. Tuma, J. Lygeros, V. Kartik, A. Sebastian, A. Pantazi, Nanotechnology 23, 2012.

Outputs
    `Reference` (m, m/s, m/s^2), exact derivatives, w'' continuous.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pea_core.params import ParameterError, param
from pea_core.signals import Reference
from pea_reference.model.scan import (
    FRAME,
    LINE,
    Q_1,
    Q_2,
    Q_3,
    Peaks,
    events_of,
    in_order,
    keep,
    q,
    rounded,
    samples_enough,
    shared,
)
from pea_reference.model.shaper import Shapeable

PARTS = ("x", "y")

COUNT_MAX = 1_000_000
"""Most periods of a frame."""


@dataclass(frozen=True)
class Params(Shapeable):
    """One axis of a Lissajous figure."""

    part: str = param("x", choices=PARTS, fixed=True, help="motion of this axis")
    offset_um: float = param(5.0, "um", -1e4, 1e4, help="mean displacement", common=True)
    width_um: float = param(8.0, "um", 1e-3, 1e4, help="way of x, twice its amplitude", fixed=True)
    height_um: float = param(8.0, "um", 1e-3, 1e4, help="way of y, twice its amplitude", fixed=True)
    resolution_um: float = param(
        0.25, "um", 1e-4, 1e4, help="largest distance between its lines", fixed=True
    )
    frame_time_s: float = param(2.0, "s", 1e-4, 1e6, help="time after which it closes", fixed=True)
    start: float = param(
        0.1, "", 1e-3, 1.0, help="share of a frame in which the amplitude rises", fixed=True
    )

    def __post_init__(self) -> None:
        n = periods(self)[1]
        if n > COUNT_MAX:
            finest = self.resolution_um * n / COUNT_MAX
            raise ParameterError(
                f"resolution_um = {self.resolution_um:g}: asks for {n} periods in a frame, more "
                f"than {COUNT_MAX}; give at least {rounded(finest, up=True)} um"
            )


class Coefficients(NamedTuple):
    """Offset, amplitude (m), periods of a frame, frame time (s), start (s)."""

    offset: float
    amplitude: float
    periods: int
    F: float
    start: float
    T_s: float


def periods(params: Params) -> tuple[int, int]:
    """Periods of x and y in a frame, without a common divisor."""
    width, height = params.width_um, params.height_um
    n = math.ceil(
        0.5 * math.pi * width * height
        / (params.resolution_um * math.hypot(width, height)) * (1.0 - 1e-12)
    )  # fmt: skip
    n = max(n, 1)
    return n + 1, n


def bounds(params: Params) -> Peaks:
    """Largest velocity, acceleration and jerk of this axis (SI), its start included."""
    amplitude, count = _own(params)
    o, T = 2.0 * math.pi * count, params.start
    one = Peaks(
        o + Q_1 / T,
        o**2 + 2.0 * Q_1 / T * o + Q_2 / T**2,
        o**3 + 3.0 * Q_1 / T * o**2 + 3.0 * Q_2 / T**2 * o + Q_3 / T**3,
    )
    return Peaks(*(amplitude * value for value in one)).faster(1.0 / params.frame_time_s)


def _own(params: Params) -> tuple[float, int]:
    """Amplitude (m) and periods of this axis."""
    i = PARTS.index(params.part)
    return 0.5e-6 * (params.width_um, params.height_um)[i], periods(params)[i]


def design(params: Params, T_s: float) -> Coefficients:
    """Convert to SI and check the pace.

    Raises
    ------
    ParameterError
        The frame time is too short for the stage, or for the sample rate.
    """
    amplitude, count = _own(params)
    F = params.frame_time_s
    quarter = 0.25 * F / max(periods(params))
    samples_enough("frame_time_s", F, "s", quarter, T_s)
    keep("frame_time_s", F, "s", params.shaper, bounds(params))
    return Coefficients(params.offset_um * 1e-6, amplitude, count, F, params.start * F, T_s)


scan = shared


def segments(params: Params) -> tuple[tuple[float, float, float], ...]:
    """Start, end and period (s) of the frames, which repeat without end."""
    return ((params.start * params.frame_time_s, math.inf, params.frame_time_s),)


def events(params: Params, T_s: float, first: int, last: int) -> np.ndarray:
    """Frames, and the periods of x as lines, that begin at samples first to last - 1.

    Returns
    -------
    (n,) array
        Of dtype `scan.EVENT`, by sample.
    """
    F, start = params.frame_time_s, params.start * params.frame_time_s
    begin = max(math.floor((first * T_s - start) / F) - 1, 0)
    frame = np.arange(begin, max(math.ceil((last * T_s - start) / F) + 1, begin))
    count = periods(params)[0]
    line = np.arange(count)
    t = start + (frame[:, None] + line / count) * F
    return in_order(
        [
            events_of(start + frame * F, T_s, FRAME, frame),
            events_of(t, T_s, LINE, frame[:, None], line),
        ],
        first,
        last,
    )


def output(c: Coefficients, k: int) -> Reference:
    """Reference at sample k."""
    t = k * c.T_s - c.start
    frames = t / c.F
    omega = 2.0 * math.pi * c.periods / c.F
    angle = 2.0 * math.pi * c.periods * (frames - math.floor(frames))
    sine, cosine = math.sin(angle), math.cos(angle)
    w, w_1, w_2 = sine, omega * cosine, -omega * omega * sine
    if t < 0.0:
        e, e_1, e_2 = q(1.0 + t / c.start)
        e_1, e_2 = e_1 / c.start, e_2 / (c.start * c.start)
        w, w_1, w_2 = e * w, e * w_1 + e_1 * w, e * w_2 + 2.0 * e_1 * w_1 + e_2 * w
    return Reference(c.offset + c.amplitude * w, c.amplitude * w_1, c.amplitude * w_2)
