r"""T, S and L of a running loop, measured by a test signal, with noise and nonlinearity apart.

With d added to the command, u = law + d,

.. math:: S = \frac{U}{D}, \quad T = 1 - S, \quad L = \frac{1}{S} - 1

the loop cut at u. With d added to the reference, T_w = Y/D is how the stage follows w, feedforward
included, and E_w = 1 - T_w what is left. Either way the voltage to displacement response of the
stage is P = (Y/D) / (U/D).

What differs between periods is noise; between realisations, noise and nonlinearity. The 95 %
radius of a complex number of variance v is sqrt(3 v); variances are averaged over neighbouring
lines, since a variance from few experiments scatters by itself. Margins are taken from S smoothed
over as many lines as its variance allows, for the largest of many lines is biased by their errors.

Source: R. Pintelon and J. Schoukens, System Identification, 2nd edition, Chapters 2 and 4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from pea_core.injection import Plan
from pea_identify.frequency_response import from_periods

RADIUS = math.sqrt(-math.log(0.05))
"""95 % radius of a complex normal number over the square root of its variance."""

NEIGHBOURS = 10
"""Lines to either side over which a variance is averaged."""

LOW = 0.02
"""Share of the band from whose lines the gain for small signals is taken, `NEIGHBOURS` at least."""

WINDOWS = (5, 7, 9, 11, 15, 21)
"""Lines over which a response is smoothed, tried in this order."""

SURE = 5.0
"""Log of the odds that smoothing changes no line by more than its variance explains."""

DRAWS = 400
"""Draws of the measured response from which intervals of margins are taken."""


@dataclass(frozen=True)
class ResponseCurve:
    """A frequency response at the lines of the test signal.

    Attributes
    ----------
    f : (F,) array
        Hz.
    G : (F,) array of complex
    noise, total : (F,) arrays
        Variance from noise; from noise and nonlinearity. NaN where the data do not determine it.
    coherence : (F,) array
        0 to 1; NaN with one realisation.
    disc : (F,) array, optional
        Radius of the 95 % disc where the variance does not say it; inf: not determined.
    """

    f: np.ndarray
    G: np.ndarray
    noise: np.ndarray
    total: np.ndarray
    coherence: np.ndarray
    disc: np.ndarray | None = None

    @property
    def nonlinear(self) -> np.ndarray:
        """Variance from the nonlinearity alone."""
        return np.maximum(self.total - self.noise, 0.0)

    @property
    def variance(self) -> np.ndarray:
        """The larger of both variances, averaged over neighbouring lines."""
        larger = np.fmax(self.noise, self.total)
        n = min(NEIGHBOURS, (len(larger) - 1) // 4)
        if n < 1:
            return larger
        window = np.ones(2 * n + 1) / (2 * n + 1)
        return np.convolve(np.pad(larger, n, mode="reflect"), window, mode="valid")

    @property
    def radius(self) -> np.ndarray:
        """Radius of the 95 % disc about G."""
        if self.disc is not None:
            return self.disc
        return np.asarray(RADIUS * np.sqrt(self.variance))


def curves(
    plan: Plan, d: np.ndarray, outputs: np.ndarray, T_s: float, start: int
) -> list[ResponseCurve]:
    """Responses from d to each of `outputs`.

    Parameters
    ----------
    plan : Plan
        When what was injected.
    d : (n,) array
        The test signal from switching on.
    outputs : (m, N) array
        Recorded signals.
    T_s : float
        Sample period (s).
    start : int
        Sample at which the injection was switched on.

    Raises
    ------
    ParameterError
        The record is too short.
    """
    D = plan.measured(d)
    Y = np.concatenate([plan.measured(each, start) for each in outputs], axis=1)
    same = bool((plan.lines == plan.lines[0]).all())
    groups = [slice(None)] if same else [slice(b, b + 1) for b in range(plan.blocks)]
    found = [
        from_periods(D[:, :, g], Y[:, :, g], T_s, plan.lines[i])
        for i, g in zip(range(plan.blocks), groups)
    ]

    def joined(name: str, j: int) -> np.ndarray:
        rows = [getattr(each, name)[:, j] for each in found]
        return np.concatenate([row[:, 0] if row.ndim > 1 else row for row in rows])

    f = np.concatenate([each.f for each in found])
    names = ("G", "noise", "total", "coherence")
    return [ResponseCurve(f, *(joined(name, j) for name in names)) for j in range(len(outputs))]


def quotient(over: ResponseCurve, under: ResponseCurve) -> ResponseCurve:
    """One response by another; their errors count as independent."""
    G = over.G / under.G

    def relative(name: str) -> np.ndarray:
        a, b = (getattr(each, name) / np.abs(each.G) ** 2 for each in (over, under))
        return np.asarray(np.abs(G) ** 2 * (a + b))

    return ResponseCurve(over.f, G, relative("noise"), relative("total"), over.coherence)


def complement(curve: ResponseCurve) -> ResponseCurve:
    """1 - G."""
    return ResponseCurve(curve.f, 1.0 - curve.G, curve.noise, curve.total, curve.coherence)


def open_loop(S: ResponseCurve) -> ResponseCurve:
    """L = 1/S - 1.

    Its disc holds 1/S of all of the disc of S; where that holds 0, nothing bounds L.
    """
    size = np.abs(S.G)
    left = np.maximum(size - S.radius, 0.0)
    disc = np.divide(S.radius, size * left, out=np.full(len(S.f), math.inf), where=left > 0.0)
    scale = size**-4
    return ResponseCurve(S.f, 1.0 / S.G - 1.0, S.noise * scale, S.total * scale, S.coherence, disc)


def crossings(f: np.ndarray, x: np.ndarray) -> list[tuple[int, float]]:
    """Where x is 0: index of the line before, and the share of the way to the next, in log f."""
    places = np.flatnonzero(x[:-1] * x[1:] < 0.0)
    return [(int(i), float(x[i] / (x[i] - x[i + 1]))) for i in places]


def between(x: np.ndarray, place: tuple[int, float]) -> float:
    """x at a place."""
    i, share = place
    return float(x[i] + share * (x[i + 1] - x[i]))


def margins(f: np.ndarray, S: np.ndarray, T_s: float, near: float = math.nan) -> dict[str, float]:
    """Margins of the loop with the sensitivity S (F,), between lines in log |L|, phase, log f.

    Where `near` (Hz) is given, the bandwidth is the fall of T that is closest to it.

    Returns
    -------
    dict
        gain_lower, gain_upper : factors of the loop's gain between which it is stable, as far as
            the band shows; phase_deg; crossover_hz, where abs(L) is 1 last; delay_samples;
            modulus, the least distance of L to -1, 1/max abs(S); bandwidth_hz, where abs(T) first
            falls below -3 dB. NaN where the band does not show it.
    """
    L = 1.0 / S - 1.0
    size, phase = np.log(np.maximum(np.abs(L), 1e-300)), np.unwrap(np.angle(L))
    log_f = np.log(f)
    lower, upper = math.nan, math.nan
    for place in crossings(f, np.sin(phase)):
        if math.cos(between(phase, place)) > 0.0:
            continue
        factor = math.exp(-between(size, place))
        if factor > 1.0:
            upper = float(np.fmin(upper, factor))
        else:
            lower = float(np.fmax(lower, factor))
    phases, delays, crossover = [], [], math.nan
    for place in crossings(f, size):
        angle, at = between(phase, place), math.exp(between(log_f, place))
        ahead = (angle + math.pi) % (2.0 * math.pi)  # until -1, with more delay
        phases.append(math.degrees(min(ahead, 2.0 * math.pi - ahead)))
        delays.append(ahead / (2.0 * math.pi * at * T_s))
        crossover = at
    falls = [p for p in crossings(f, np.abs(1.0 - S) - math.sqrt(0.5)) if abs(1.0 - S[p[0]]) > 0.7]
    bandwidths = [math.exp(between(log_f, place)) for place in falls]
    if bandwidths and math.isfinite(near):
        bandwidths = [min(bandwidths, key=lambda each: abs(math.log(each / near)))]
    return {
        "gain_lower": lower,
        "gain_upper": upper,
        "phase_deg": min(phases, default=math.nan),
        "crossover_hz": crossover,
        "delay_samples": min(delays, default=math.nan),
        "modulus": float(1.0 / np.abs(S).max()),
        "bandwidth_hz": bandwidths[0] if bandwidths else math.nan,
    }


def smoothed(G: np.ndarray, window: int) -> np.ndarray:
    """G (F,) or (F, n) through a local parabola over `window` lines; 1: as it is."""
    from scipy.signal import savgol_filter

    if window < 2:
        return G
    parts = [savgol_filter(x, window, 2, axis=0, mode="interp") for x in (G.real, G.imag)]
    return np.asarray(parts[0] + 1j * parts[1])


def window_of(curve: ResponseCurve) -> int:
    """Lines over which a response may be smoothed: 1 where it may not.

    The widest of `WINDOWS` at which no line differs from any narrower one by more than the
    variance explains (O. V. Lepski, Theory of Probability and its Applications 35(3), 1991).
    """
    from scipy.signal import savgol_coeffs

    variance = curve.variance
    if not (np.isfinite(variance).all() and (variance > 0.0).all()):
        return 1
    most = math.log(len(curve.f)) + SURE
    tried = [(1, curve.G, np.ones(1))]
    for window in WINDOWS:
        if 3 * window > len(curve.f):
            break
        G, own = smoothed(curve.G, window), savgol_coeffs(window, 2)
        for other, before, weights in tried:
            apart = own.copy()
            apart[(window - other) // 2 : (window + other) // 2] -= weights
            if (np.abs(G - before) ** 2 / variance).max() > most * float(apart @ apart):
                return tried[-1][0]
        tried.append((window, G, own))
    return tried[-1][0]


def intervals(S: ResponseCurve, T_s: float, seed: int = 0) -> dict[str, tuple[float, float, float]]:
    """Each margin of a measured S with the ends of its 95 % interval; NaN where not shown.

    A margin is a least distance or a first crossing, which the errors of single lines move to one
    side; so S is smoothed first, see `smoothed`. Errors of the stated variance are drawn at every
    line, smoothed likewise and added.
    """
    window = window_of(S)
    G = smoothed(S.G, window)
    value = margins(S.f, G, T_s)
    rng = np.random.default_rng(seed)
    size = np.sqrt(S.variance / 2.0)
    normal = rng.standard_normal((2, DRAWS, len(S.f)))
    errors = smoothed((size * (normal[0] + 1j * normal[1])).T, window)
    # of a band in which errors let T fall for some lines, the same fall counts in every draw
    found = [margins(S.f, G + error, T_s, value["bandwidth_hz"]) for error in errors.T]
    told = {}
    for name, x in value.items():
        drawn = np.array([each[name] for each in found])
        if not math.isfinite(x) or np.isnan(drawn).mean() > 0.05:
            told[name] = (math.nan, math.nan, math.nan)
            continue
        low, high = np.nanpercentile(drawn, [2.5, 97.5])
        told[name] = (x, min(float(low), x), max(float(high), x))
    return told


def low_gain(curve: ResponseCurve) -> float:
    """Size at the lowest lines, each weighted by its variance: one line alone may be all noise."""
    size, weight = np.abs(curve.G), 1.0 / np.fmax(curve.noise, curve.total)
    few = min(NEIGHBOURS, len(curve.f)) - 1
    low = curve.f <= max(LOW * curve.f[-1], curve.f[few])
    known = low & np.isfinite(weight)
    return float(np.average(size[known], weights=weight[known]) if known.any() else size[0])


def bandwidth(curve: ResponseCurve) -> float:
    """First frequency (Hz) at which the size falls 3 dB below that of the lowest lines; or NaN."""
    size = np.log(np.abs(curve.G)) - math.log(low_gain(curve)) + 0.5 * math.log(2.0)
    places = [p for p in crossings(curve.f, size) if size[p[0]] > 0.0]
    return math.exp(between(np.log(curve.f), places[0])) if places else math.nan


def as_table(curve: ResponseCurve) -> dict[str, Any]:
    """The curve as lists, for JSON."""
    return {
        "f_hz": curve.f.tolist(),
        "real": curve.G.real.tolist(),
        "imag": curve.G.imag.tolist(),
        "radius_95": [x if math.isfinite(x) else None for x in curve.radius.tolist()],
        **{
            name: [None if math.isnan(x) else x for x in getattr(curve, column).tolist()]
            for name, column in (
                ("noise_variance", "noise"),
                ("nonlinear_variance", "nonlinear"),
                ("coherence", "coherence"),
            )
        },
    }
