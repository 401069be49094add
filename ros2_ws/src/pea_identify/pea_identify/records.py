"""Records: one measured voltage and displacement, the kind of its motion, and checks of the data.

The kind decides what a record can determine: ``periodic`` (whole periods of a fast excitation: V,
its delay, noise), ``general`` (any other fast excitation: V), ``slow`` (hysteresis), ``step``
(creep), ``rest`` (noise).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pea_core.params import ParameterError, nearest

KINDS = ("periodic", "general", "slow", "step", "rest")

SHORTEST = 64
"""Least number of samples of a record."""

SLOW_HZ = 60.0
"""A motion with 99.9 % of its power below this is slow, for a stage that resonates above 300 Hz."""

MOVES = 1e-6
"""A change of the voltage below this share of its largest value is rounding."""


class Periods(NamedTuple):
    """Whole periods of a periodic excitation in steady state.

    Attributes
    ----------
    u : (N, n_u, R, P) array
        Voltage (V): N samples in a period, R realisations, P periods.
    y : (N, n_y, R, P) array
        Displacement (m).
    T_s : float
        Sample period (s).
    name : str
        Source of the data, for messages.
    lines : tuple of int
        Excited multiples of 1/(N T_s); empty: found from u.
    """

    u: np.ndarray
    y: np.ndarray
    T_s: float
    name: str
    lines: tuple[int, ...] = ()

    @property
    def rms(self) -> float:
        """Rms of the alternating voltage (V)."""
        return float(np.sqrt(np.mean((self.u - self.u.mean(axis=0)) ** 2)))


@dataclass(frozen=True)
class Record:
    """A checked record; make it with `record`.

    Attributes
    ----------
    u : (N, n_u) array
        Voltage (V), held from each sample to the next.
    y : (N, n_y) array
        Displacement (m) at the samples.
    T_s : float
        Sample period (s).
    name : str
        Name in messages.
    kind : str
        One of `KINDS`.
    period : int
        Samples in a period of a periodic record, else 0.
    blocks : tuple of (int, int)
        For each realisation, first sample and number of the whole periods in steady state, if the
        source contains them; empty: found from u. In closed loop u has noise and hardly repeats.
    lines : tuple of int
        Excited lines, as multiples of one over the period, if the source contains them.
    """

    u: np.ndarray
    y: np.ndarray
    T_s: float
    name: str
    kind: str
    period: int = 0
    blocks: tuple[tuple[int, int], ...] = ()
    lines: tuple[int, ...] = ()

    @property
    def duration(self) -> float:
        """Length (s)."""
        return len(self.u) * self.T_s


def record(
    u: np.ndarray,
    y: np.ndarray,
    T_s: float,
    name: str = "record",
    kind: str = "",
    period: int = 0,
) -> Record:
    """Check a record, and find its kind and period if they are not given.

    Parameters
    ----------
    u : (N,) or (N, n_u) array
        Voltage (V).
    y : (N,) or (N, n_y) array
        Displacement (m).
    T_s : float
        Sample period (s).
    name : str
        Name in messages.
    kind : str
        One of `KINDS`; empty: found from u.
    period : int
        Samples in a period; 0: found from u.

    Raises
    ------
    ParameterError
        The data are too short, of unequal lengths, not finite, clipped, or not of the given kind.
    """
    u, y = column(u, f"{name}: u"), column(y, f"{name}: y")
    if not (math.isfinite(T_s) and T_s > 0.0):
        raise ParameterError(f"{name}: sample period {T_s:g} s: must be positive")
    if len(u) != len(y):
        raise ParameterError(
            f"{name}: u has {len(u)} samples and y {len(y)}: both need a value at each sample"
        )
    if len(u) < SHORTEST:
        raise ParameterError(f"{name}: {len(u)} samples are too short: record at least {SHORTEST}")
    if kind and kind not in KINDS:
        raise ParameterError(f"{name}: unknown kind {kind!r}: {nearest(kind, KINDS)}")
    if period and not 2 <= period <= len(u) // 2:
        raise ParameterError(
            f"{name}: period of {period} samples in a record of {len(u)}: "
            "a periodic record needs two whole periods"
        )
    found = kind or kind_of(u, T_s)
    if found != "rest":
        for j in range(y.shape[1]):
            refuse_unmoved(y[:, j], name)
            refuse_clipped(u, y[:, j], name)
    if found == "periodic" or period:
        period = period or period_of(u)
        if not period:
            raise ParameterError(
                f"{name}: the voltage does not repeat: give whole periods, or kind general"
            )
        if not stretches(u, period):
            raise ParameterError(
                f"{name}: the voltage does not repeat after {period} samples: give the right "
                "period, or kind general"
            )
        found = "periodic"
    return Record(u, y, T_s, name, found, period)


def column(values: np.ndarray, name: str) -> np.ndarray:
    """`values` as an (N, n) array of finite numbers."""
    try:
        values = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise ParameterError(f"{name} is no array of numbers: give one number a sample") from None
    if values.ndim == 1:
        values = values[:, None]
    if values.ndim != 2 or not values.shape[1]:
        raise ParameterError(f"{name} has shape {values.shape}: give (samples, channels)")
    wrong = ~np.isfinite(values).all(axis=1)
    if wrong.any():
        k = int(np.flatnonzero(wrong)[0])
        bad = values[k][~np.isfinite(values[k])][0]
        raise ParameterError(
            f"{name} has {int(wrong.sum())} samples that are not finite, the first ({bad:g}) at "
            f"sample {k}: cut them out first"
        )
    return values


def refuse_unmoved(y: np.ndarray, name: str) -> None:
    """Refuse a displacement that is the same at every sample."""
    if np.ptp(y) == 0.0:
        raise ParameterError(
            f"{name}: the displacement is {y[0]:g} m at every sample: is the sensor connected?"
        )


def refuse_clipped(u: np.ndarray, y: np.ndarray, name: str) -> None:
    """Refuse a displacement (N,) that stays at its largest or smallest value while u moves."""
    span = np.ptp(u, axis=0)
    for end, value in (("largest", y.max()), ("smallest", y.min())):
        at = np.flatnonzero(y == value)
        runs = [r for r in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1) if len(r) >= 3]
        runs = [r for r in runs if r[0] > 0]
        moved = sum(float((np.ptp(u[r], axis=0) / np.maximum(span, 1e-300)).max()) for r in runs)
        if moved > 0.03:
            count = sum(len(r) for r in runs)
            raise ParameterError(
                f"{name}: the displacement is clipped: {count} samples stay at its {end} value "
                f"{value:.6g} m while the voltage moves; lower the amplitude"
            )


def kind_of(u: np.ndarray, T_s: float) -> str:
    """Kind of a voltage (N, n_u)."""
    scale = max(float(np.abs(u).max()), 1e-300)
    span = float(np.ptp(u, axis=0).max())
    if span <= MOVES * scale:
        return "rest"
    changes = np.flatnonzero((np.abs(np.diff(u, axis=0)) > 1e-3 * span).any(axis=1))
    # one step or short ramp from level to level, and a long hold
    if len(changes) and changes[-1] - changes[0] < 0.02 * len(u):
        before, after = u[: changes[0] + 1], u[changes[-1] + 1 :]
        if max(np.ptp(before, axis=0).max(), np.ptp(after, axis=0).max()) < 0.01 * span:
            return "step"
    if len(changes) and len(changes) <= 1:
        return "step"
    if highest(u, T_s) < min(SLOW_HZ, 0.1 / T_s):
        return "slow"
    return "periodic" if period_of(u) else "general"


def highest(u: np.ndarray, T_s: float) -> float:
    """Frequency (Hz) below which 99.9 % of the power of u around its mean lies."""
    moved = u - u.mean(axis=0)
    window = np.hanning(len(u))[:, None]
    power = (np.abs(np.fft.rfft(moved * window, axis=0)) ** 2).sum(axis=1)
    share = np.cumsum(power) / max(float(power.sum()), 1e-300)
    return float(np.searchsorted(share, 0.999) / (len(u) * T_s))


def tolerance(u: np.ndarray) -> float:
    """Largest difference (V) of two samples that count as the same voltage."""
    return 2e-3 * float(np.ptp(u, axis=0).max())


def period_of(u: np.ndarray) -> int:
    """Samples after which u (N, n_u) repeats for at least two periods; 0 if it does not."""
    N = len(u)
    moved = u - u.mean(axis=0)
    size = 2 ** math.ceil(math.log2(2 * N))
    power = (np.abs(np.fft.rfft(moved, size, axis=0)) ** 2).sum(axis=1)
    r = np.fft.irfft(power, size)[: N // 2 + 1] / np.arange(N, N - N // 2 - 1, -1)
    if r[0] <= 0.0:
        return 0
    inner = np.arange(8, len(r) - 1)
    if not len(inner):
        return 0
    peaks = inner[(r[inner] >= r[inner - 1]) & (r[inner] >= r[inner + 1])]
    peaks = np.append(peaks, len(r) - 1)
    peaks = peaks[r[peaks] > 0.3 * r[0]]
    best = peaks[np.argsort(-r[peaks], kind="stable")[:40]]
    for L in sorted(int(p) for p in best):
        if stretches(u, L):
            return L
    return 0


def stretches(u: np.ndarray, L: int) -> list[tuple[int, int]]:
    """First sample and number of whole periods (2 or more) of each stretch that repeats after L."""
    same = (np.abs(u[L:] - u[:-L]) <= tolerance(u)).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(int)))
    found = []
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        whole = int(end - start + L) // L
        moving = np.ptp(u[start : start + L], axis=0).max() > 0.02 * np.ptp(u, axis=0).max()
        if whole >= 2 and moving:
            found.append((int(start), whole))
    return found


Part = tuple[np.ndarray, np.ndarray, str]
"""Voltage and displacement of whole periods, (P, N, n), and the name of their record."""


def parts_of(r: Record, drive: np.ndarray | None = None) -> list[Part]:
    """Whole periods of a periodic record in steady state, one item for each stretch.

    The first period of each stretch is omitted, because it contains the transient. Of a stretch of
    two periods, both are kept if they agree. `drive` (N, n_u), if given, replaces the voltage.
    """
    L = r.period
    source = r.u if drive is None else drive
    parts = []
    for first, count in r.blocks:
        u, y = (x[first : first + count * L].reshape(count, L, -1) for x in (source, r.y))
        parts.append((u, y, r.name))
    if parts:
        return parts
    for start, whole in stretches(r.u, L):
        first = start + (whole >= 3) * L
        count = whole - (whole >= 3)
        y = r.y[first : first + count * L].reshape(count, L, -1)
        u = source[first : first + count * L].reshape(count, L, -1)
        if whole == 2 and np.sqrt(np.mean((y[0] - y[1]) ** 2)) > 0.02 * y[1].std():
            y, u = y[1:], u[1:]
        parts.append((u, y, r.name))
    return parts


def grouped(parts: Sequence[Part], T_s: float, by: Sequence[Part] | None = None) -> list[Periods]:
    """One `Periods` for all realisations of the same length and the same rms (within 5 %).

    `by` holds the parts whose voltages are compared, in the same order; default: `parts`.
    """
    groups: list[tuple[tuple[int, ...], float, list[Part]]] = []
    for part, deciding in zip(parts, by or parts, strict=True):
        u = deciding[0]
        size = float(np.sqrt(np.mean((u - u.mean(axis=1, keepdims=True)) ** 2)))
        for shape, other, members in groups:
            if shape == u.shape[1:] and abs(size / other - 1.0) < 0.05:
                members.append(part)
                break
        else:
            groups.append((u.shape[1:], size, [part]))
    made = []
    for _, _, members in groups:
        P = min(len(u) for u, _, _ in members)
        u = np.stack([u[-P:].transpose(1, 2, 0) for u, _, _ in members], axis=2)
        y = np.stack([y[-P:].transpose(1, 2, 0) for _, y, _ in members], axis=2)
        made.append(Periods(u, y, T_s, members[0][2]))
    return made
