r"""Noise of a stage that stands still: density, cumulative rms, Allan deviation, resolution.

With S(f) the one-sided power spectral density by Welch's method (Hann window, half overlapping):
the cumulative rms up to f, and the rms behind a first-order filter of bandwidth B,

.. math:: \sigma_B^2 = \int_0^\infty \frac{S(f)}{1 + (f/B)^2} df,

which times 6.6 is the peak-to-peak resolution for that bandwidth: 99.9 % of normal noise lie
within. The overlapping Allan deviation of y over the averaging time tau = m T_s, y_m the means,

.. math:: \sigma_A^2(\tau) = \tfrac12 \langle (\bar y_{k+m} - \bar y_k)^2 \rangle.

Source: IEEE Std 1139 (definition of the Allan deviation).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pea_core.params import ParameterError

PEAK_TO_PEAK = 6.6
"""Peak to peak of normal noise over its rms, 99.9 % within."""

LEAST = 256
"""Samples that a noise measurement must have."""


class NoiseFigures(NamedTuple):
    """f (Hz), density (m/sqrt(Hz)), cumulative (m); tau (s), allan (m); rms, drift (m, m/s)."""

    f: np.ndarray
    density: np.ndarray
    cumulative: np.ndarray
    tau: np.ndarray
    allan: np.ndarray
    rms: float
    drift: float


def allan(y: np.ndarray, T_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Averaging times (s), four an octave, and the overlapping Allan deviation of y."""
    n = len(y)
    longest = max(n // 3, 1)
    m = np.unique(np.round(2.0 ** (np.arange(4 * int(math.log2(longest)) + 1) / 4.0)).astype(int))
    total = np.concatenate([[0.0], np.cumsum(y - y.mean())])
    deviations = []
    for each in m.tolist():
        means = (total[each:] - total[:-each]) / each
        deviations.append(math.sqrt(0.5 * np.mean((means[each:] - means[:-each]) ** 2)))
    return m * T_s, np.array(deviations)


def noise(y: np.ndarray, T_s: float) -> NoiseFigures:
    """Noise of y (n,) in m, sampled every T_s (s).

    Raises
    ------
    ParameterError
        Too short.
    """
    from scipy.signal import welch

    if len(y) < LEAST:
        raise ParameterError(f"{len(y)} samples are too few for noise: record {LEAST} at least")
    t = np.arange(len(y)) * T_s
    slope, level = np.polyfit(t, y, 1)
    segment = max(len(y) // 8, 128)
    f, S = welch(y - level, 1.0 / T_s, nperseg=segment, detrend="linear")
    df = f[1] - f[0]
    cumulative = np.sqrt(np.concatenate([[0.0], np.cumsum(0.5 * (S[1:] + S[:-1]) * df)]))
    tau, deviation = allan(y, T_s)
    left = y - level - slope * t
    return NoiseFigures(
        f[1:],
        np.sqrt(S[1:]),
        cumulative[1:],
        tau,
        deviation,
        float(np.sqrt(np.mean(left * left))),
        float(slope),
    )


def rms_within(found: NoiseFigures, bandwidth_hz: float) -> float:
    """Rms (m) behind a first-order filter of a bandwidth."""
    power = found.density**2 / (1.0 + (found.f / bandwidth_hz) ** 2)
    lowest = power[0] * found.f[0]
    area = np.sum(0.5 * (power[1:] + power[:-1]) * np.diff(found.f))
    return math.sqrt(float(lowest + area))


def resolution(found: NoiseFigures, bandwidth_hz: float) -> float:
    """Peak-to-peak resolution (m) predicted for a bandwidth."""
    return PEAK_TO_PEAK * rms_within(found, bandwidth_hz)
