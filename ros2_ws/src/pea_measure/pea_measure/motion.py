"""Figures of moves: rise, overshoot and settling of steps; loops of hysteresis; creep."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from pea_core.params import ParameterError
from pea_core.units import NM_PER_M

BAND = 0.02
"""Share of a step within which it counts as settled, where no band is given."""

END = 0.2
"""Share of a hold at its end whose mean is the final level."""


class StepFigures(NamedTuple):
    """Of one step: height reached (m), rise 10 to 90 % (s), settling (s), overshoot, error (m).

    overshoot is a share of the height; NaN where a time is not within the hold.
    """

    height: float
    rise: float
    settling: float
    overshoot: float
    error: float


def step(
    y: np.ndarray, before: float, w: float, T_s: float, band: float | None = None
) -> StepFigures:
    """Figures of one step.

    Parameters
    ----------
    y : (n,) array
        Displacement (m) from the first sample of the step on.
    before : float
        Level before it (m).
    w : float
        Level that was asked for (m).
    T_s : float
        Sample period (s).
    band : float, optional
        Settled within +- so much (m) of the final level; else `BAND` of the height.
    """
    final = float(y[-max(int(END * len(y)), 1) :].mean())
    height = final - before
    share = (y - before) / height if height else np.full(len(y), math.nan)

    def first(level: float) -> float:
        above = np.flatnonzero(share >= level)
        if not above.size:
            return math.nan
        i = int(above[0])
        if i == 0:
            return 0.0
        return (i - 1 + (level - share[i - 1]) / (share[i] - share[i - 1])) * T_s

    allowed = BAND * abs(height) if band is None else band
    outside = np.flatnonzero(np.abs(y - final) > allowed)
    settling = (int(outside[-1]) + 1) * T_s if outside.size else 0.0
    if outside.size and outside[-1] >= len(y) - 2:
        settling = math.nan
    over = float(np.nanmax(share)) - 1.0 if height else math.nan
    return StepFigures(height, first(0.9) - first(0.1), settling, max(over, 0.0), final - w)


def statistics(values: list[float]) -> dict[str, float | int | None]:
    """Mean, standard deviation, least and largest of repeats; None where none is known."""
    x = np.array([v for v in values if math.isfinite(v)])
    if not x.size:
        return {"mean": None, "std": None, "min": None, "max": None, "count": 0}
    std = float(x.std(ddof=1)) if x.size > 1 else None
    return {
        "mean": float(x.mean()),
        "std": std,
        "min": float(x.min()),
        "max": float(x.max()),
        "count": int(x.size),
    }


def loop_width(u: np.ndarray, y: np.ndarray, turn: int) -> tuple[float, float]:
    """Largest distance (m) of a falling branch above the rising one, and the stroke (m).

    Parameters
    ----------
    u, y : (n,) arrays
        Voltage (V) and displacement (m) of one loop: up to the sample `turn`, then down.
    turn : int
    """
    up, down = np.argsort(u[:turn], kind="stable"), np.argsort(u[turn:], kind="stable")
    low = max(u[:turn].min(), u[turn:].min())
    high = min(u[:turn].max(), u[turn:].max())
    if not high > low:
        raise ParameterError("the voltage of a loop does not go up and down: nothing to compare")
    grid = np.linspace(low, high, 400)
    rising = np.interp(grid, u[:turn][up], y[:turn][up])
    falling = np.interp(grid, u[turn:][down], y[turn:][down])
    return float(np.abs(falling - rising).max()), float(np.ptp(y))


def linearity(u: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Slope of the best line (m/V), and the largest distance from it over the stroke."""
    slope, level = np.polyfit(u, y, 1)
    return float(slope), float(np.abs(y - slope * u - level).max() / np.ptp(y))


def creeping(y: np.ndarray, T_s: float, first: float = 0.1) -> dict[str, Any]:
    """Creep after a step: y(t) = y(first) (1 + g log10(t/first)), g by least squares.

    Parameters
    ----------
    y : (n,) array
        Displacement since the step, its level before it taken off (m).
    T_s : float
    first : float
        When (s) the vibration is over; at most a tenth of the record counts.

    Returns
    -------
    dict
        gamma : share of the level at `first`, per decade.  first_s; last_s; total, the share
        that was crept; left_nm, rms of what the logarithm does not explain.
    """
    first = min(first, 0.1 * len(y) * T_s)
    k = max(round(first / T_s), 1)
    if len(y) < 20 * k and len(y) < 100:
        raise ParameterError(f"{len(y)} samples are too few for creep: hold for longer")
    t = np.arange(k, len(y)) * T_s
    grid = np.unique(np.round(np.geomspace(k, len(y) - 1, 400)).astype(int))
    log = np.log10(grid * T_s / (k * T_s))
    gain, level = np.polyfit(log, y[grid], 1)
    left = y[k:] - level - gain * np.log10(t / (k * T_s))
    return {
        "gamma_per_decade": float(gain / level),
        "first_s": k * T_s,
        "last_s": float(len(y) * T_s),
        "crept_share": float((y[-max(k // 4, 1) :].mean() - level) / level),
        "left_nm": float(np.sqrt(np.mean(left * left)) * NM_PER_M),
    }
