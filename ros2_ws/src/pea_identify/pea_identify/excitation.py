r"""Voltages that show what a stage is: multisines, stepped sines, chirps, triangles, steps.

Each is an array of volts, one a sample, around an operating point; `check` refuses what would
leave the range or the slew limit before anything moves.

A multisine is a sum of cosines at chosen lines k/(N T_s) of one period N,

.. math:: u(n) = \sum_k a_k \cos\Bigl(\frac{2 \pi k n}{N} + \varphi_k\Bigr)

with random phases, or phases that lower the crest factor (peak over rms). Source: E. Van der
Ouderaa, J. Schoukens and J. Renneboog, IEEE Trans. Instrum. Meas. 37(1), 1988: clip the
signal, keep the phases of what comes out.
"""

from __future__ import annotations

import math

import numpy as np

from pea_core.params import ParameterError


def lines_between(f_low: float, f_high: float, N: int, T_s: float, count: int = 0) -> np.ndarray:
    """Lines (int) of a period of N samples between two frequencies (Hz).

    All of them, or about `count`, spread over the logarithm, where it is given.

    Raises
    ------
    ParameterError
        No line lies there.
    """
    low = max(1, math.ceil(f_low * N * T_s - 1e-9))
    high = min(math.floor(f_high * N * T_s + 1e-9), (N - 1) // 2)
    if high < low:
        raise ParameterError(
            f"no line between {f_low:g} and {f_high:g} Hz in a period of {N * T_s:g} s: "
            "lengthen the period or widen the band"
        )
    if not count or count >= high - low + 1:
        return np.arange(low, high + 1)
    return np.unique(np.round(np.geomspace(low, high, count)).astype(int))


def crest(u: np.ndarray) -> float:
    """Crest factor: largest magnitude over rms."""
    return float(np.abs(u).max() / np.sqrt(np.mean(u**2)))


def multisine(
    N: int, lines: np.ndarray, rms: float, rng: np.random.Generator, lowered: int = 0
) -> np.ndarray:
    """One period (N,) of a random-phase multisine in V, all lines of one amplitude.

    Parameters
    ----------
    N : int
        Samples a period.
    lines : (F,) array of int
        Excited lines, 1 to (N - 1)/2.
    rms : float
        V.
    rng : numpy.random.Generator
        Draws the phases.
    lowered : int
        Rounds that lower the crest factor; 0 keeps the phases as drawn.
    """
    spectrum = np.zeros(N // 2 + 1, dtype=complex)
    amplitude = rms * N / math.sqrt(2.0 * len(lines))
    spectrum[lines] = amplitude * np.exp(2j * math.pi * rng.random(len(lines)))
    u = np.fft.irfft(spectrum, N)
    best, lowest = u, crest(u)
    for i in range(lowered):
        level = np.abs(u).max() * (0.75 + 0.24 * i / lowered)
        phase = np.angle(np.fft.rfft(np.clip(u, -level, level))[lines])
        spectrum[lines] = amplitude * np.exp(1j * phase)
        u = np.fft.irfft(spectrum, N)
        if (now := crest(u)) < lowest:
            best, lowest = u, now
    return best


def orthogonal(
    N: int, lines: np.ndarray, rms: float, inputs: int, rng: np.random.Generator
) -> np.ndarray:
    """Periods (N, inputs, inputs) of multisines whose experiments are orthogonal.

    Each input has random phases; between experiments they turn by the unitary Fourier matrix, so
    U U^H is diagonal at each line. Source: T. P. Dobrowiecki, J. Schoukens and P. Guillaume,
    IEEE Trans. Instrum. Meas. 55(5), 2006.
    """
    turn = np.exp(2j * math.pi * np.outer(np.arange(inputs), np.arange(inputs)) / inputs)
    u = np.empty((N, inputs, inputs))
    for i in range(inputs):
        spectrum = np.fft.rfft(multisine(N, lines, rms, rng))
        for e in range(inputs):
            turned = np.zeros_like(spectrum)
            turned[lines] = spectrum[lines] * turn[i, e]
            u[:, i, e] = np.fft.irfft(turned, N)
    return u


def soft(u: np.ndarray, ramp: int) -> np.ndarray:
    """u (N,) with its first and last `ramp` samples faded in and out by a raised cosine."""
    window = np.ones(len(u))
    edge = 0.5 - 0.5 * np.cos(math.pi * (np.arange(ramp) + 0.5) / ramp) if ramp else np.ones(0)
    window[:ramp] = edge
    window[len(u) - ramp :] = edge[::-1]
    return u * window


def move(start: float, end: float, samples: int) -> np.ndarray:
    """A way (samples,) from one voltage (V) to another with a continuous slope."""
    share = (np.arange(samples) + 1.0) / samples
    return start + (end - start) * (share - np.sin(2.0 * math.pi * share) / (2.0 * math.pi))


def chirp(N: int, f_low: float, f_high: float, amplitude: float, T_s: float) -> np.ndarray:
    """A sweep (N,) in V between two frequencies (Hz), exponential in time, soft at its ends."""
    from scipy.signal import chirp as swept

    t = np.arange(N) * T_s
    u = swept(t, f_low, N * T_s, f_high, method="logarithmic", phi=-90.0)
    return amplitude * soft(u, N // 50)


def triangles(
    low: float, peaks: tuple[float, ...], period: int, start: float | None = None
) -> np.ndarray:
    """Slow triangles from `low` (V) to each peak (V) and back, `period` samples each.

    The first one rises from `start`, or from low; falling peaks give minor loops within the
    first.
    """
    half = period // 2
    parts = [] if start is None else [move(start, low, half)]
    for peak in peaks:
        way = np.arange(half) / half
        parts += [low + (peak - low) * way, peak + (low - peak) * way]
    return np.concatenate([*parts, [low]])


def check(
    u: np.ndarray, T_s: float, voltage_min: float, voltage_max: float, slew_rate: float = 0.0
) -> None:
    """Refuse an excitation that would leave the range (V) or the slew limit (V/s; 0: none).

    Raises
    ------
    ParameterError
        It would; the text names the sample, the value and the limit.
    """
    if not np.isfinite(u).all():
        k = int(np.flatnonzero(~np.isfinite(u))[0])
        raise ParameterError(f"excitation at sample {k} is {u.flat[k]}: must be finite")
    for k, wrong in (
        (int(u.argmin()), u.min() < voltage_min),
        (int(u.argmax()), u.max() > voltage_max),
    ):
        if wrong:
            raise ParameterError(
                f"excitation of {u[k]:.4g} V at {k * T_s:.4g} s: must lie within "
                f"{voltage_min:g} to {voltage_max:g} V; lower the amplitude or move the "
                "operating point"
            )
    if slew_rate and len(u) > 1:
        rate = np.abs(np.diff(u)) / T_s
        k = int(rate.argmax())
        if rate[k] > slew_rate * (1.0 + 1e-9):
            raise ParameterError(
                f"excitation changes by {rate[k]:.4g} V/s at {k * T_s:.4g} s: at most "
                f"{slew_rate:g} V/s; lower the amplitude or the highest frequency"
            )
