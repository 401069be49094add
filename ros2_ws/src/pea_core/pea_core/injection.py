r"""A test signal d that is added to a running loop: at the reference, or at the voltage.

A block of the signal is one period of N samples, repeated. R blocks follow each other:

multisine
    Sines of one amplitude at lines of 1/(N T_s), random phases, drawn anew for each block, then
    turned so that the crest factor falls (E. Van der Ouderaa, J. Schoukens and J. Renneboog, IEEE
    Trans. Instrum. Meas. 37(1), 1988).
chirp
    One sweep a period, repeated; every block is the same.
stepped_sine
    A block for each line: a sine alone.

Each block lasts one period to settle and `periods` periods to measure. Within the first half of
the settling period one block is faded into the next by a raised cosine, from nothing at the
start; half a period after the last block the signal has faded to nothing. All blocks are scaled
alike, so that the largest value of all is the amplitude.

.. math:: u = \mathrm{law}(w, \hat x) + d \quad \text{or} \quad u = \mathrm{law}(w + d, \hat x)

The law is told its own command, without d: d stands for an unknown voltage between the law and the
actuator, as where theory cuts the loop. d is cut where u would leave the actuator's range.

The signal is a function of the parameters and of the samples since it was switched on, so a
recording that holds the parameters holds the signal.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from pea_core.params import ParameterError, param
from pea_core.signals import Reference, between

WHERE = ("off", "reference", "voltage")
OFF, REFERENCE, VOLTAGE = range(3)

KINDS = ("multisine", "chirp", "stepped_sine")

LONGEST = 2**22
"""Samples that a whole injection may have."""

ROUNDS = 40
"""Rounds in which the crest factor of a multisine is lowered."""


@dataclass(frozen=True)
class InjectParams:
    """A test signal added to the loop; it fades in and out, and ends by itself."""

    where: str = param(
        "off", choices=WHERE, help="where a test signal is added to the loop", common=True
    )
    kind: str = param("multisine", choices=KINDS, help="form of the test signal", common=True)
    amplitude_um: float = param(
        0.02, "um", 0.0, 1e4, help="its largest value at the reference", common=True
    )
    amplitude_V: float = param(
        0.3, "V", 0.0, 1e4, help="its largest value at the voltage", common=True
    )
    from_hz: float = param(10.0, "Hz", 1e-6, 1e6, help="lowest frequency", common=True)
    to_hz: float = param(2000.0, "Hz", 1e-6, 1e6, help="highest frequency", common=True)
    lines: int = param(
        0,
        "",
        0,
        100_000,
        help="frequencies, evenly in log; 0: every line of the period",
        common=True,
    )
    period: float = param(
        0.1, "s", 1e-6, 1e4, help="period; its inverse parts the lines", common=True
    )
    periods: int = param(4, "", 1, 10_000, help="periods measured of each block", common=True)
    realisations: int = param(
        4, "", 1, 1000, help="multisines of other phases, one after the other", common=True
    )
    wait: float = param(
        0.0, "s", 0.0, 1e5, help="from switching on to the first sample", common=True
    )
    seed: int = param(0, "", 0, 2**31 - 1, help="draws the phases", common=True)

    def __post_init__(self) -> None:
        if self.where != "off" and self.from_hz > self.to_hz:
            raise ParameterError(
                f"from_hz = {self.from_hz:g}: must not be above to_hz ({self.to_hz:g} Hz)"
            )


class Plan(NamedTuple):
    """When what is injected.

    Attributes
    ----------
    N : int
        Samples a period.
    lines : (B, n) array of int
        Lines of each block, multiples of 1/(N T_s); the same number in each.
    wait, periods : int
        Samples before the first block; periods measured of each.
    """

    N: int
    lines: np.ndarray
    wait: int
    periods: int

    @property
    def blocks(self) -> int:
        """Blocks one after the other."""
        return len(self.lines)

    @property
    def samples(self) -> int:
        """From switching on until the signal has faded to nothing."""
        return self.wait + self.blocks * (1 + self.periods) * self.N + self.N // 2 + 1

    def measured(self, values: np.ndarray, start: int = 0) -> np.ndarray:
        """The measured periods of a record as (N, 1, blocks, periods).

        Parameters
        ----------
        values : (n,) array
            One value a sample.
        start : int
            Sample at which the injection was switched on.

        Raises
        ------
        ParameterError
            The record is too short.
        """
        whole = 1 + self.periods
        first = start + self.wait
        end = first + self.blocks * whole * self.N
        if len(values) < end:
            raise ParameterError(
                f"{len(values)} samples: the injection needs {end}; record for longer"
            )
        parts = values[first:end].reshape(self.blocks, whole, self.N)[:, 1:]
        return parts.transpose(2, 0, 1)[:, None]


class Coefficients(NamedTuple):
    """where: `OFF`, `REFERENCE` or `VOLTAGE`.  wave (n, 3): d, d', d'' (SI) of each sample.

    wait: samples before the first.  ahead, theta: preview, whole and rest (samples).  T_s (s).
    low, high: range of u (V).
    """

    where: int
    wave: np.ndarray
    wait: int
    ahead: int
    theta: float
    T_s: float
    low: float
    high: float


@lru_cache(maxsize=64)
def off(T_s: float) -> Coefficients:
    """Nothing is injected."""
    return Coefficients(OFF, np.zeros((1, 3)), 0, 0, 0.0, T_s, 0.0, 0.0)


def spread(low: int, high: int, count: int) -> np.ndarray:
    """Whole numbers from low to high, all or about `count` evenly in log."""
    if not count or count > high - low:
        return np.arange(low, high + 1)
    return np.unique(np.round(np.geomspace(low, high, count)).astype(int))


def plan(params: InjectParams, T_s: float) -> Plan:
    """When what is injected.

    Raises
    ------
    ParameterError
        No line in the band, a band beyond half the sample rate, or too long.
    """
    N = round(params.period / T_s)
    nyquist = 0.5 / T_s
    if params.to_hz >= nyquist:
        raise ParameterError(
            f"to_hz = {params.to_hz:g}: must be below half the sample rate, {nyquist:g} Hz"
        )
    low = max(1, math.ceil(params.from_hz * N * T_s - 1e-6)) if N else 1
    high = math.floor(params.to_hz * N * T_s + 1e-6)
    if N < 8 or high < low:
        raise ParameterError(
            f"period = {params.period:g} s: holds no line between {params.from_hz:g} and "
            f"{params.to_hz:g} Hz; lengthen it or widen the band"
        )
    lines = spread(low, min(high, (N - 1) // 2), params.lines)
    if params.kind == "stepped_sine":
        lines = lines[:, None]
    else:
        blocks = params.realisations if params.kind == "multisine" else 1
        lines = np.tile(lines, (blocks, 1))
    found = Plan(N, lines, round(params.wait / T_s), params.periods)
    if found.samples - found.wait > LONGEST:
        raise ParameterError(
            f"the injection would take {found.samples * T_s:.4g} s: at most {LONGEST * T_s:.4g} s; "
            "shorten period, or take fewer lines, periods or realisations"
        )
    return found


def crest(x: np.ndarray) -> float:
    """Largest magnitude over rms."""
    return float(np.abs(x).max() / np.sqrt(np.mean(x * x)))


def phases(N: int, lines: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Phases (n,) of cosines of one amplitude: random, then of a lower crest factor."""
    phase = 2.0 * math.pi * rng.random(len(lines))
    best, lowest = phase, math.inf
    spectrum = np.zeros(N // 2 + 1, complex)
    for i in range(ROUNDS if len(lines) > 2 else 1):
        spectrum[lines] = np.exp(1j * phase)
        x = np.fft.irfft(spectrum, N)
        if (now := crest(x)) < lowest:
            best, lowest = phase, now
        level = np.abs(x).max() * (0.75 + 0.24 * i / ROUNDS)
        phase = np.angle(np.fft.rfft(np.clip(x, -level, level))[lines])
    return best


def spectra(params: InjectParams, found: Plan) -> np.ndarray:
    """Lines (B, N // 2 + 1) of each block; the amplitude is free."""
    N = found.N
    rows = np.zeros((found.blocks, N // 2 + 1), complex)
    rng = np.random.default_rng(params.seed)
    if params.kind == "chirp":
        first, last = found.lines[0][0] / N, found.lines[0][-1] / N
        k = np.arange(N)
        swept = np.sin(2.0 * math.pi * (first * k + 0.5 * (last - first) * k * k / N))
        rows[0, found.lines[0]] = np.fft.rfft(swept)[found.lines[0]]
    for row, lines in zip(rows, found.lines, strict=True):
        if params.kind == "multisine":
            row[lines] = np.exp(1j * phases(N, lines, rng))
        elif params.kind == "stepped_sine":
            row[lines] = -1j
    return rows


def share(N: int) -> np.ndarray:
    """How much of a new block acts (N, 3): 0 to 1 in half a period; its derivatives by samples."""
    half = N // 2
    angle = math.pi * np.arange(half) / half
    a = np.ones((N, 3))
    a[:, 1:] = 0.0
    a[:half, 0] = 0.5 - 0.5 * np.cos(angle)
    a[:half, 1] = 0.5 * np.sin(angle) * math.pi / half
    a[:half, 2] = 0.5 * np.cos(angle) * (math.pi / half) ** 2
    return a


@lru_cache(maxsize=8)
def wave(params: InjectParams, T_s: float) -> np.ndarray:
    """The whole signal (n, 3) with its derivatives, of largest value 1, without the wait.

    Raises
    ------
    ParameterError
        As `plan`.
    """
    found = plan(params, T_s)
    N, B = found.N, found.blocks
    rows = spectra(params, found)
    omega = 2.0 * math.pi * np.arange(N // 2 + 1) / (N * T_s)
    periods = np.stack([np.fft.irfft(rows * (1j * omega) ** i, N, axis=1) for i in range(3)], 2)
    periods /= np.abs(periods[:, :, 0]).max()
    a = share(N) * np.array([1.0, 1.0 / T_s, 1.0 / T_s**2])
    none = np.zeros((N, 3))
    blocks = [none, *periods, none]
    parts = []
    for before, after in itertools.pairwise(blocks):
        gap = after - before
        faded = before.copy()
        faded[:, 0] += a[:, 0] * gap[:, 0]
        faded[:, 1] += a[:, 0] * gap[:, 1] + a[:, 1] * gap[:, 0]
        faded[:, 2] += a[:, 0] * gap[:, 2] + 2.0 * a[:, 1] * gap[:, 1] + a[:, 2] * gap[:, 0]
        parts += [faded, np.tile(after, (found.periods, 1))]
    whole = np.concatenate(parts[: 2 * B + 1])[: found.samples - found.wait]
    whole.flags.writeable = False
    return whole


@lru_cache(maxsize=8)
def design(
    params: InjectParams,
    voltage_min: float,
    voltage_max: float,
    slew_rate: float,
    K: float,
    preview: float,
    T_s: float,
) -> Coefficients:
    """Compute the signal.

    Parameters
    ----------
    params : InjectParams
    voltage_min, voltage_max, slew_rate : float
        Limits of the actuator (V, V/s); a slew rate of 0 is none.
    K : float
        Its gain (um/V).
    preview : float
        How far ahead the law looks (samples).
    T_s : float
        Sample period (s).

    Raises
    ------
    ParameterError
        As `plan`; an amplitude or a slope that the actuator does not have.
    """
    if params.where == "off":
        return off(T_s)
    span = 0.5 * (voltage_max - voltage_min)
    at_voltage = params.where == "voltage"
    name, size, unit, most = (
        ("amplitude_V", params.amplitude_V, "V", span)
        if at_voltage
        else ("amplitude_um", params.amplitude_um, "um", span * abs(K))
    )
    if size > most:
        raise ParameterError(
            f"{name} = {size:g}: must be at most {most:.4g} {unit}, half of what the actuator has"
        )
    d = wave(params, T_s) * (size if at_voltage else size * 1e-6)
    fastest = float(np.abs(np.diff(d[:, 0])).max()) / T_s * (1.0 if at_voltage else 1e6 / abs(K))
    if 0.0 < slew_rate < fastest:
        raise ParameterError(
            f"{name} = {size:g}: would change the voltage by {fastest:.4g} V/s, the actuator "
            f"allows {slew_rate:g} V/s; take at most {size * slew_rate / fastest:.3g} {unit}, or "
            "a lower to_hz"
        )
    ahead = int(preview)
    return Coefficients(
        WHERE.index(params.where),
        np.ascontiguousarray(d),
        round(params.wait / T_s),
        ahead,
        preview - ahead,
        T_s,
        voltage_min,
        voltage_max,
    )


def point(c: Coefficients, k: int) -> Reference:
    """D, d' and d'' (SI) k samples after switching on."""
    i = k - c.wait
    if i < 0 or i >= c.wave.shape[0]:
        return Reference(0.0, 0.0, 0.0)
    return Reference(float(c.wave[i, 0]), float(c.wave[i, 1]), float(c.wave[i, 2]))


def moved(W: Reference, d: Reference) -> Reference:
    """The reference with d added."""
    return Reference(W.w + d.w, W.w_dot + d.w_dot, W.w_ddot + d.w_ddot)


def at_reference(c: Coefficients, k: int, W: Reference) -> Reference:
    """The reference of a sample as the law gets it."""
    if c.where == REFERENCE:
        W = moved(W, point(c, k))
    return W


def ahead_of(c: Coefficients, k: int, W_ff: Reference) -> Reference:
    """The reference previewed, as the law gets it."""
    if c.where == REFERENCE:
        d = point(c, k + c.ahead)
        if c.theta != 0.0:
            d = between(d, point(c, k + c.ahead + 1), c.theta, c.T_s)
        W_ff = moved(W_ff, d)
    return W_ff


def at_voltage(c: Coefficients, k: int, u: float) -> float:
    """What is added to the command u (V): d, cut where the sum would leave the range."""
    if c.where != VOLTAGE:
        return 0.0
    d = point(c, k).w
    if d > 0.0:
        return min(d, max(c.high - u, 0.0))
    return max(d, min(c.low - u, 0.0))


def of_law(params: Any, T_s: float) -> Coefficients:
    """What is injected into a law with `params`; errors as `design`, named ``inject.``."""
    inject = getattr(params, "inject", None)
    if inject is None or inject.where == "off":
        return off(T_s)
    limits = params.voltage_min, params.voltage_max, params.slew_rate
    try:
        return design(inject, *limits, params.K, params.preview, T_s)
    except ParameterError as error:
        raise ParameterError(f"inject.{error}") from None


def signal(params: Any, T_s: float) -> tuple[Plan, np.ndarray]:
    """Plan of an injection into a law with `params`, and d (n,) in SI from switching on."""
    c = of_law(params, T_s)
    return plan(params.inject, T_s), np.concatenate([np.zeros(c.wait), c.wave[:, 0]])
