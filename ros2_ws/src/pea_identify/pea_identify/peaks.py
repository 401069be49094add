r"""Resonances that can be seen in a frequency response, as a place to begin a fit.

Near the resonance of a weakly damped mode

.. math:: |G|^{-2} \propto (f - f_n)^2 + (\zeta f_n)^2

so a parabola through three lines gives f_n and zeta, also where the peak is narrower than the
distance of the lines.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

PROMINENT = 1.5
"""Factor by which a peak stands above what is beside it."""

DAMPING = (0.001, 0.5)
"""Damping ratios that a peak is taken for."""


class Peak(NamedTuple):
    """Natural frequency (rad/s) and damping ratio."""

    omega_n: float
    zeta: float


def resonances(f: np.ndarray, G: np.ndarray) -> list[Peak]:
    """Peaks of a response, those of the largest gain (2 zeta times the height) first.

    Parameters
    ----------
    f : (F,) array
        Lines (Hz), rising.
    G : (F, m) array
        Response of each entry; they count alike.
    """
    from scipy.signal import find_peaks

    size = np.abs(G)
    power = ((size / size.max(axis=0)) ** 2).sum(axis=1)
    found = []
    for k in find_peaks(0.5 * np.log(power), prominence=math.log(PROMINENT))[0]:
        away = f[k - 1 : k + 2] - f[k]
        a, b, c = np.polyfit(away, power[k] / power[k - 1 : k + 2], 2)
        middle = -b / (2.0 * a) if a > 0.0 else 0.0
        width = math.sqrt(max(c - a * middle**2, 0.0) / a) if a > 0.0 else 0.0
        f_n = float(f[k] + np.clip(middle, away[0], away[2]))
        zeta = float(np.clip(width / f_n, *DAMPING))
        found.append((zeta * math.sqrt(power[k]), Peak(2.0 * math.pi * f_n, zeta)))
    return [peak for _, peak in sorted(found, reverse=True)]
