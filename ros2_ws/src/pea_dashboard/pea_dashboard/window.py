"""What a browser shows of a trace: some samples of a window, and the spectrum of its error.

A frame is bytes: the length of a JSON head (uint32, little endian), the head, and behind it, from
a multiple of four on, the arrays that the head names, float32.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from scipy import signal

from pea_core.signals import COARSE, FINE, UNITS
from pea_core.units import NM_PER_M, NS
from pea_dashboard.foreign import number
from pea_report.decimation import extremes

BINS = 400
"""Parts of a window of which the extremes are shown."""

DENSE = 2400
"""Samples in a window up to which all are shown."""

RMS_OVER = 0.1
"""Seconds of the running rms, rounded up to whole periods of the reference."""

LONGEST = 2**20
"""Samples of a window, at most."""

SPECTRUM = 2**15
"""Samples of which the spectrum is taken, at most."""

PATH_BINS = 800
"""Parts of a window of which the extremes of a path are shown: a line between them is straight."""

SIDES = 3
"""Axes of a path that are shown: across, up, and one beside as a bar."""

POINTS = 300
"""Points of a spectrum."""

SPECTRA = ("amplitude", "density", "response")
"""What is shown over frequency."""

PARTS = 4
"""Parts, each half over the next, of which a density or a response is the mean."""

EXCITED = 1e-6
"""Share of the reference's greatest density from which on a frequency counts as excited."""

COHERENT = 0.9
"""Least coherence of y and w at which a response is shown."""

SCALE = {
    **{name: COARSE[UNITS[name]][1] for name in ("w", "y")},
    "e": FINE["m"][1],
    "rms": 1.0,
    **{name: COARSE[UNITS[name]][1] for name in ("u", "u_applied", "eps_hat", "eps")},
}
"""Signals of a frame, and factors to what is shown (um, nm, V)."""


class SampleSource(Protocol):
    """Where samples come from: a running loop or a recording."""

    T_ns: int

    @property
    def first(self) -> int:
        """First sample that is there."""

    @property
    def end(self) -> int:
        """One after the last."""

    def samples(self, start: int, end: int, *names: str) -> dict[str, np.ndarray]:
        """Signals of samples, `k` with them."""


class PathSource(Protocol):
    """What all axes shall do and do: ``AXIS.w`` and ``AXIS.y``."""

    def samples(self, start: int, end: int, *names: str) -> dict[str, np.ndarray]:
        """Signals of samples, `k` with them."""


class View(NamedTuple):
    """What a browser asks for.

    Attributes
    ----------
    span : float
        Width of the window (s).
    end : float or None
        Loop time (s) at its right edge; None: the newest sample.
    source : str
        Empty: the running loop; else the name of a recording.
    axis : str
        Of a recording of several axes, the one that is shown; empty: the first.
    path : tuple of str
        Axes of the path, at most `SIDES`; those of no such name are left out.
    spectrum : str
        One of `SPECTRA`.
    """

    span: float = 1.0
    end: float | None = None
    source: str = ""
    axis: str = ""
    path: tuple[str, ...] = ()
    spectrum: str = SPECTRA[0]


def running_rms(e: np.ndarray, n: int) -> np.ndarray:
    """Rms over the last n samples of an error; NaN where they are not all there: (n,) array."""
    found = np.full(len(e), np.nan)
    if len(e) >= n:
        squares = np.concatenate([[0.0], np.cumsum(np.square(np.nan_to_num(e)))])
        unknown = np.concatenate([[0], np.cumsum(np.isnan(e))])
        means = np.maximum(squares[n:] - squares[:-n], 0.0) / n
        found[n - 1 :] = np.where(unknown[n:] > unknown[:-n], np.nan, np.sqrt(means))
    return found


def spectrum(e: np.ndarray, T_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Amplitudes of an error's sines, seen through a Hann window.

    Parameters
    ----------
    e : (n,) array
    T_s : float
        Sample period (s).

    Returns
    -------
    (m,) arrays
        Frequencies (Hz), and the largest amplitude round each of them, in the unit of e.
    """
    n = len(e)
    if n < 64 or not np.isfinite(e).all():
        return np.empty(0), np.empty(0)
    window = np.hanning(n)
    amplitudes = 2.0 * np.abs(np.fft.rfft((e - e.mean()) * window)) / window.sum()
    frequencies = np.fft.rfftfreq(n, T_s)
    starts = _starts(len(amplitudes))
    return frequencies[starts], np.maximum.reduceat(amplitudes, starts)


def _starts(n: int) -> np.ndarray:
    """Where each of `POINTS` parts of n frequencies but 0 begins."""
    return np.unique(np.geomspace(1, n, POINTS).astype(int))[:-1]


def density(e: np.ndarray, T_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Amplitude density of an error: frequencies (Hz), and e's unit per sqrt(Hz)."""
    if len(e) < 64 or not np.isfinite(e).all():
        return np.empty(0), np.empty(0)
    frequencies, power = signal.welch(e, 1.0 / T_s, nperseg=len(e) // PARTS)
    starts = _starts(len(power))
    sums = np.add.reduceat(power, starts)  # means tell of noise, maxima of how many there are
    return frequencies[starts], np.sqrt(sums / np.diff([*starts, len(power)]))


def response(w: np.ndarray, y: np.ndarray, T_s: float) -> tuple[np.ndarray, ...]:
    """Response of a running loop where its reference excites it, and y follows nothing else.

    Returns
    -------
    (m,) arrays
        Frequencies (Hz), |y/w| and |(w - y)/w|.
    """
    both = np.array([w, y])
    if both.shape[1] < 64 or not np.isfinite(both).all():
        return np.empty(0), np.empty(0), np.empty(0)
    asked: Any = {"fs": 1.0 / T_s, "nperseg": both.shape[1] // PARTS}
    frequencies, of_both = signal.welch(both, **asked)
    across = signal.csd(w, y, **asked)[1]
    of_w, of_y = of_both
    with np.errstate(divide="ignore", invalid="ignore"):
        coherence = np.abs(across) ** 2 / (of_w * of_y)
        transfer = across / of_w
    shown = (of_w > EXCITED * of_w.max()) & (coherence >= COHERENT) & (frequencies > 0.0)
    transfer = transfer[shown]
    return frequencies[shown], np.abs(transfer), np.abs(1.0 - transfer)


def look(source: SampleSource, view: View, period: float = 0.0) -> dict[str, Any]:
    """Arrays and numbers of a view.

    Parameters
    ----------
    source : SampleSource
    view : View
    period : float
        Period of the reference (s); 0: it has none.

    Returns
    -------
    dict
        `t0`, `span`, `first`, `last`, `rms_over` (s), `rms_nm`, and `arrays` by name: `t` from t0
        on (s) and those of `SCALE`.
    """
    T_s = source.T_ns * NS
    first, end = source.first, source.end
    arrays: dict[str, np.ndarray] = {}
    found: dict[str, Any] = {"arrays": arrays, "span": view.span}
    if not T_s or end <= first:
        return found
    size, right = _edges(source, view)
    n = max(round(RMS_OVER / T_s), 1)
    if period > 0.0:
        n = max(round(np.ceil(RMS_OVER / period) * period / T_s), 1)
    left = max(right - size, first)
    table = source.samples(max(left - n, first), right)
    k = table["k"]
    if not len(k):
        return found
    inside = int(np.searchsorted(k, left))
    table["e"] = table["y"] - table["w"]
    table["rms"] = rms = running_rms(table["e"] * NM_PER_M, n)
    signals = {name: table[name][inside:] for name in SCALE}
    k = k[inside:]
    shown = np.arange(len(k))
    if len(k) > DENSE:
        by = tuple(signals[name] for name in ("y", "e", "u", "eps_hat"))
        shown = extremes(by, -(-size // BINS), int(k[0]))
    t0 = max(right - size, first) * T_s  # what is younger than the window fills it from the left
    arrays["t"] = k[shown] * T_s - t0
    for name, scale in SCALE.items():
        arrays[name] = signals[name][shown] * scale
    found |= {
        "t0": t0,
        "span": min(view.span, LONGEST * T_s),
        "first": first * T_s,
        "last": end * T_s,
        "rms_nm": number(float(rms[-1])),
        "rms_over": n * T_s,
    }
    return found


def _edges(source: SampleSource, view: View) -> tuple[int, int]:
    """Samples of a window, and one after its last."""
    T_s, first, end = source.T_ns * NS, source.first, source.end
    right = end if view.end is None else min(max(round(view.end / T_s), first + 1), end)
    return min(max(round(view.span / T_s), 2), LONGEST), right


def chosen(axes: Sequence[str], view: View) -> tuple[str, ...]:
    """Axes of the path that is shown: those asked for, else the first; none where there is one."""
    if len(axes) < 2:
        return ()
    asked = tuple(dict.fromkeys(axis for axis in view.path if axis in axes))[:SIDES]
    return asked if len(asked) > 1 else tuple(axes[:SIDES])


def along(
    source: SampleSource, path: PathSource, view: View, axes: Sequence[str]
) -> dict[str, np.ndarray]:
    """A path in the window of a view (um): `w0`, `y0` of the first of some axes, and so on.

    Samples are left out as in `look`: none at which y or the error of an axis is smallest or
    largest in its part of the window.
    """
    if not source.T_ns or source.end <= source.first:
        return {}
    size, right = _edges(source, view)
    names = [f"{axis}.{name}" for axis in axes for name in ("w", "y")]
    table = path.samples(right - size, right, *names)
    k = table.pop("k")
    if not len(k):
        return {}
    errors = [table[f"{axis}.y"] - table[f"{axis}.w"] for axis in axes]
    by = [*errors, *(table[f"{axis}.y"] for axis in axes)]
    shown = extremes(by, -(-size // PATH_BINS), int(k[0]))
    shown = np.union1d(shown, [len(k) - 1])  # where it is now
    return {
        f"{name}{i}": table[f"{axis}.{name}"][shown] * SCALE[name]
        for i, axis in enumerate(axes)
        for name in ("w", "y")
    }


def over_frequency(source: SampleSource, view: View) -> dict[str, np.ndarray]:
    """Of the last `SPECTRUM` samples of a view: `f` (Hz), and what the view asks for.

    `amplitude` (nm) and `density` (nm/sqrt(Hz)) are the error's, `T` and `S` the response's.
    """
    T_s = source.T_ns * NS
    names = ("f", "T", "S") if view.spectrum == "response" else ("f", view.spectrum)
    if not T_s or source.end <= source.first:
        return {name: np.empty(0) for name in names}
    right = source.end if view.end is None else min(round(view.end / T_s), source.end)
    table = source.samples(right - SPECTRUM, right, "y", "w")
    if view.spectrum == "response":
        return dict(zip(names, response(table["w"], table["y"], T_s)))
    make = density if view.spectrum == "density" else spectrum
    return dict(zip(names, make((table["y"] - table["w"]) * NM_PER_M, T_s)))


def pack(head: Mapping[str, object], arrays: Mapping[str, np.ndarray]) -> bytes:
    """A frame: see the head of this module."""
    sizes = {name: len(values) for name, values in arrays.items()}
    text = json.dumps({**head, "arrays": sizes}, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    data = [np.ascontiguousarray(values, "<f4").tobytes() for values in arrays.values()]
    return b"".join((struct.pack("<I", len(text)), text, *data))


Limits = Callable[[], tuple[float, float] | None]
