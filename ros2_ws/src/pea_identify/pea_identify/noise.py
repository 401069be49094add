"""Sensor noise and quantisation, from a stage at rest or from what differs between periods."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pea_identify.intervals import Z_95


class NoiseFit(NamedTuple):
    """Identified noise of one channel.

    Attributes
    ----------
    rms, rms_95 : float
        Standard deviation (m) of a sample, and the half width of its 95 % interval.
    quantisation : float
        Step of the values (m); 0: none seen.
    samples : int
        Independent samples that it rests on.
    """

    rms: float
    rms_95: float
    quantisation: float
    samples: int


def at_rest(y: np.ndarray) -> NoiseFit:
    """Noise of a displacement (N,) at rest; a straight line, drift or creep, is taken out."""
    k = np.arange(len(y)) - (len(y) - 1) / 2.0
    left = y - y.mean()
    left = left - k * float(k @ left) / max(float(k @ k), 1e-300)
    return of(left, y, len(y) - 2)


def between_periods(y: np.ndarray) -> NoiseFit:
    """Noise of a displacement (N, R, P) from what differs between its periods."""
    P = y.shape[-1]
    left = (y - y.mean(axis=-1, keepdims=True)) * math.sqrt(P / (P - 1.0))
    return of(left.ravel(), y.ravel(), y.size * (P - 1) // P)


def of(left: np.ndarray, y: np.ndarray, samples: int) -> NoiseFit:
    """Noise of what is left, without the part that rounding has."""
    step = quantisation(y)
    total = float(np.sqrt(np.mean(left**2)))
    rms = math.sqrt(max(total**2 - step**2 / 12.0, 0.0))
    half = Z_95 * total / math.sqrt(2.0 * max(samples, 1))
    return NoiseFit(rms, half * (total / rms if rms > 0.5 * total else 1.0), step, samples)


def quantisation(y: np.ndarray) -> float:
    """Step (m) of which all values (N,) are multiples, beside an offset; 0 where there is none."""
    values = np.unique(y)
    if len(values) < 3 or len(values) > 0.5 * len(y):
        return 0.0
    gaps = np.diff(values)
    scale = 1e-9 * float(np.abs(values).max())
    gaps = gaps[gaps > scale]
    if not len(gaps):
        return 0.0
    step = float(gaps.min())
    whole = (values - values[0]) / step
    if np.abs(whole - np.round(whole)).max() > 0.02:
        return 0.0
    return float((values[-1] - values[0]) / np.round(whole[-1]))
