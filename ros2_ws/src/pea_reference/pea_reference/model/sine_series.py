r"""Series of sines, whole periods of each frequency, one after the other.

.. math:: w = w_0 - a \cos\bigl(2 \pi f_i (t - t_i)\bigr), \quad
          t_i \le t < t_{i+1} = t_i + n_i / f_i

w_0 is the offset and a the amplitude. Each sine starts and ends at rest at its lowest point, so
w and w' are continuous; w'' exists throughout and steps by a (2 pi)^2 (f_{i+1}^2 - f_i^2) from
one sine to the next. After the last the series begins again.

Outputs
    `Reference` (m, m/s, m/s^2), exact derivatives.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pea_core.params import ParameterError, param
from pea_core.signals import Reference
from pea_reference.model.common import below_nyquist, one_each, some
from pea_reference.model.shaper import Shapeable


@dataclass(frozen=True)
class Params(Shapeable):
    """Sines in a row."""

    amplitude_um: float = param(5.0, "um", 0.0, 1e4, help="amplitude", common=True)
    offset_um: float = param(5.0, "um", -1e4, 1e4, help="mean displacement", common=True)
    frequencies_hz: tuple[float, ...] = param(
        (1.0, 10.0, 50.0, 100.0, 150.0), "Hz", 1e-6, 1e5, help="frequencies in their order"
    )
    periods: tuple[float, ...] = param(
        (2.0, 5.0, 10.0, 20.0, 30.0), "", 1.0, 1e9, help="whole periods of each, or of all"
    )

    def __post_init__(self) -> None:
        some("frequencies_hz", self.frequencies_hz)
        one_each("periods", self.periods, len(self.frequencies_hz))
        for i, n in enumerate(self.periods):
            if n != math.floor(n):
                raise ParameterError(f"periods[{i}] = {n:g}: must be a whole number of periods")


class Coefficients(NamedTuple):
    """Amplitude and offset (m), omega (n) (rad/s), start (n + 1) of each sine (s), period (s)."""

    amplitude: float
    offset: float
    omega: np.ndarray
    start: np.ndarray
    T_s: float


def starts(params: Params) -> np.ndarray:
    """Start (n + 1) of each sine and end of the last (s)."""
    f = params.frequencies_hz
    lengths = [n / f_i for n, f_i in zip(one_each("periods", params.periods, len(f)), f)]
    return np.concatenate([[0.0], np.cumsum(lengths)])


def design(params: Params, T_s: float) -> Coefficients:
    """Convert to SI and lay the sines in a row.

    Raises
    ------
    ParameterError
        A frequency is not below half the sample rate.
    """
    f = params.frequencies_hz
    for i, f_i in enumerate(f):
        below_nyquist(f"frequencies_hz[{i}]", f_i, T_s)
    return Coefficients(
        params.amplitude_um * 1e-6,
        params.offset_um * 1e-6,
        2.0 * math.pi * np.array(f),
        starts(params),
        T_s,
    )


def segments(params: Params) -> tuple[tuple[float, float, float], ...]:
    """Start, end and period (s) of each sine of the first round."""
    t = starts(params).tolist()
    return tuple((a, b, 1.0 / f_i) for a, b, f_i in zip(t, t[1:], params.frequencies_hz))


def output(c: Coefficients, k: int) -> Reference:
    """Reference at sample k."""
    last = c.omega.size - 1
    t = (k * c.T_s) % float(c.start[last + 1])
    i = 0
    while i < last and t >= c.start[i + 1]:
        i += 1
    omega = float(c.omega[i])
    angle = omega * (t - float(c.start[i]))
    cosine = c.amplitude * math.cos(angle)
    return Reference(
        c.offset - cosine,
        c.amplitude * omega * math.sin(angle),
        omega * omega * cosine,
    )
