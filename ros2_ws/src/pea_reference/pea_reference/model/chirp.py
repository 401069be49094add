r"""Chirp: a sine whose frequency goes from f_0 to f_1 in a time T, linearly or logarithmically.

.. math:: w = w_0 - a \cos\theta, \quad \dot\theta = 2 \pi f

linear
    f = f_0 + (f_1 - f_0) t/T, theta = 2 pi t (f_0 + (f_1 - f_0) t/(2 T))
logarithmic
    f = f_0 r^{t/T}, r = f_1/f_0, theta = 2 pi f_0 T (r^{t/T} - 1)/ln r

It starts at its lowest point, at rest. After T it goes on as a sine of f_1: w and w' are
continuous there, and w'' too but for the rate of f that ends.

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
    """One sweep of frequency."""

    amplitude_um: float = param(5.0, "um", 0.0, 1e4, help="amplitude", common=True)
    offset_um: float = param(5.0, "um", -1e4, 1e4, help="mean displacement", common=True)
    frequency_start_hz: float = param(1.0, "Hz", 1e-6, 1e5, help="frequency at t = 0")
    frequency_end_hz: float = param(200.0, "Hz", 1e-6, 1e5, help="frequency from t = sweep_time")
    sweep_time: float = param(1.0, "s", 1e-6, 1e6, help="how long the frequency moves")
    sweep: str = param("linear", help="how the frequency moves", choices=("linear", "logarithmic"))


class Coefficients(NamedTuple):
    """Amplitude, offset (m); omega_0, omega_1 (rad/s); T (s); ln(r), 0 where linear; period (s)."""

    amplitude: float
    offset: float
    omega_0: float
    omega_1: float
    T: float
    log_r: float
    T_s: float


def design(params: Params, T_s: float) -> Coefficients:
    """Convert to SI. Where both frequencies are the same, either sweep is a sine.

    Raises
    ------
    ParameterError
        A frequency is not below half the sample rate.
    """
    below_nyquist("frequency_start_hz", params.frequency_start_hz, T_s)
    below_nyquist("frequency_end_hz", params.frequency_end_hz, T_s)
    ratio = params.frequency_end_hz / params.frequency_start_hz
    return Coefficients(
        params.amplitude_um * 1e-6,
        params.offset_um * 1e-6,
        2.0 * math.pi * params.frequency_start_hz,
        2.0 * math.pi * params.frequency_end_hz,
        params.sweep_time,
        math.log(ratio) if params.sweep == "logarithmic" else 0.0,
        T_s,
    )


def output(c: Coefficients, k: int) -> Reference:
    """Reference at sample k."""
    t = k * c.T_s
    within = min(t, c.T)
    if c.log_r != 0.0:
        growth = math.expm1(c.log_r * (within / c.T))
        theta = c.omega_0 * c.T * growth / c.log_r
        theta_dot = c.omega_0 * (1.0 + growth)
        theta_ddot = theta_dot * c.log_r / c.T
    else:
        rate = (c.omega_1 - c.omega_0) / c.T
        theta = within * (c.omega_0 + 0.5 * rate * within)
        theta_dot = c.omega_0 + rate * within
        theta_ddot = rate
    if t >= c.T:
        theta += c.omega_1 * (t - c.T)
        theta_dot = c.omega_1
        theta_ddot = 0.0
    cosine, sine = c.amplitude * math.cos(theta), c.amplitude * math.sin(theta)
    return Reference(
        c.offset - cosine,
        theta_dot * sine,
        theta_ddot * sine + theta_dot * theta_dot * cosine,
    )
