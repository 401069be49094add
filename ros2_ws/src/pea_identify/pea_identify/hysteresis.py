r"""H from slow motion: four models fitted to the same data, chosen on data not fitted.

Where the motion is slow, or the linear dynamics are known, displacement follows from voltage as

.. math:: y = y_0 + K\,L\{H(u)\}

with L the unit-gain dynamics (V with its delay, F_c), or 1. Prandtl-Ishlinskii is linear in its
weights,

.. math:: y = y_0 + \sum_i w_i\,L\{P_{r_i}(u)\}, \quad w_i \ge 0

and so a quadratic programme with bounds. Its modified form bends the output by a memoryless
curve S; with S^{-1} piecewise linear, of slope s_j > 0 between knots, one of them 1, the same
programme gives weights and slopes at once (error stated in S^{-1}(y), which is y up to the bend):

.. math:: y_{(c)} = y_0 + \sum_i w_i P_{r_i}(u) - \sum_{j \ne c} s_j\,y_{(j)}

with y_(j) the part of y between knots j and j + 1. Preisach and Bouc-Wen have few parameters
and are fitted by nonlinear least squares.

Source: K. Kuhnen, European Journal of Control 9(4), 2003 (both programmes).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pea_core.block import Block
from pea_plant.model.hysteresis import MODELS

COUNTS = (4, 8, 12, 16, 24)
"""Numbers of play operators tried."""

KNOTS = (3, 5, 7)
"""Numbers of pieces of S tried: odd, so that one is in the middle."""

POINTS = 4000
"""Samples that a nonlinear fit uses at most; the motion is slow."""

STEEPEST, FLATTEST = 20.0, 0.05
"""Slopes of S^{-1} between which the programme looks, beside 1 in the middle."""

Dynamics = Callable[[np.ndarray], np.ndarray]
"""What L makes of samples (N, n), column by column."""


def still(v: np.ndarray) -> np.ndarray:
    """L = 1: the motion is slow."""
    return v


@dataclass(frozen=True)
class Fit:
    """A fitted model of H.

    Attributes
    ----------
    type : str
        Model of `pea_plant.model.hysteresis`, or ``modified_prandtl_ishlinskii``.
    K : float
        Gain (m/V): H then has about unity gain.
    offset : float
        y_0 (m).
    values : dict
        Parameters of the model, as the plant's parameter file names them.
    fitted, held_out : float
        Rms error (m) on the data fitted, and on those not fitted (NaN where there are none).
    stroke : float
        Peak to peak of y (m).
    intervals : dict of str to float
        Half width of the 95 % interval of each free parameter that has one.
    knots, slopes : (m + 1,), (m,) arrays
        Of S^{-1}, in m; empty where S is a straight line.
    """

    type: str
    K: float
    offset: float
    values: dict[str, Any]
    fitted: float
    held_out: float
    stroke: float
    intervals: dict[str, float]
    knots: np.ndarray
    slopes: np.ndarray

    @property
    def parameters(self) -> int:
        """Count of free parameters."""
        lists = sum(len(v) for v in self.values.values() if isinstance(v, tuple))
        return 2 + (lists // 2 if lists else len(self.intervals)) + max(len(self.slopes) - 1, 0)


def plays(u: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Play operators (N, n) of thresholds r (n) in V along u (N), from the middle at u = 0."""
    z, out = np.zeros(len(r)), np.empty((len(u), len(r)))
    for k, u_k in enumerate(u.tolist()):
        z = np.clip(z, u_k - r, u_k + r)
        out[k] = z
    return out


def thresholds(u: np.ndarray, count: int) -> np.ndarray:
    """Thresholds (count,) in V from 0 on, closer where they are small."""
    return float(np.ptp(u)) / 2.0 * (np.arange(count) / count) ** 1.5


def pieces(y: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Parts (N, m) of y between each two of the knots (m + 1); beyond the ends they go on."""
    low, high = knots[:-1].copy(), knots[1:].copy()
    first = low[0]
    low[0], high[-1] = -np.inf, np.inf
    parts = np.clip(y[:, None], low, high)
    parts -= np.concatenate([[first], knots[1:-1]])
    return parts


def curve(v: np.ndarray, knots: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """S (N,) of v: the inverse of the piecewise linear S^{-1}."""
    at = np.concatenate([[0.0], np.cumsum(slopes * np.diff(knots))])
    inner = np.searchsorted(at[1:-1], v)
    return knots[inner] + (v - at[inner]) / slopes[inner]


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def bounded(A: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Least squares of A x = b between bounds, columns scaled to one size."""
    from scipy.optimize import lsq_linear

    scale = np.maximum(np.abs(A).max(axis=0), 1e-300)
    found = lsq_linear(
        A / scale, b, (low * scale, high * scale), method="bvls" if A.shape[1] < 60 else "trf"
    )
    return np.asarray(found.x / scale)


@dataclass(frozen=True)
class Data:
    """Slow motion, with what counts for fitting and what for choosing.

    Attributes
    ----------
    u, y : (N,) arrays
        Voltage (V) and displacement (m), from rest at 0 V or after a full cycle.
    fitted, held_out : (N,) arrays of bool
    through : callable
        L.
    """

    u: np.ndarray
    y: np.ndarray
    fitted: np.ndarray
    held_out: np.ndarray
    through: Dynamics = still


def scaled(data: Data, raw: np.ndarray, r: np.ndarray) -> tuple[float, dict[str, Any]]:
    """K (m/V), and the plant's parameters of weights `raw` (m/V) whose H has about unity gain."""
    kept = raw > 1e-9 * raw.max()
    r, raw = r[kept], raw[kept]
    u_max = float(np.abs(data.u).max())
    y_max = float(raw @ np.maximum(u_max - r, 0.0))
    K = y_max / u_max
    values = {
        "thresholds": tuple(r.tolist()),
        "weights": tuple((raw / K).tolist()),
        "u_max": u_max,
        "v_max": u_max,
    }
    return K, values


def prandtl_ishlinskii(data: Data, count: int, bends: int = 0) -> Fit:
    """Weights of `count` play operators, and a curve of `bends` pieces where it is given."""
    r = thresholds(data.u, count)
    P = data.through(plays(data.u, r))
    one = np.ones((len(P), 1))
    stroke = float(np.ptp(data.y))
    y, knots, slopes = data.y, np.empty(0), np.empty(0)
    use = data.fitted
    if bends:
        knots = np.linspace(data.y[use].min(), data.y[use].max(), bends + 1)
        parts, middle = pieces(data.y, knots), bends // 2
        others = np.delete(parts, middle, axis=1)
        A, b = np.hstack([P, one, -others])[use], parts[use, middle]
        low = np.concatenate([np.zeros(count), [-np.inf], np.full(bends - 1, FLATTEST)])
        high = np.concatenate([np.full(count + 1, np.inf), np.full(bends - 1, STEEPEST)])
        x = bounded(A, b, low, high)
        slopes = np.insert(x[count + 1 :], middle, 1.0)
        offset = float(x[count])
        said = curve(P @ x[:count] + offset, knots, slopes)
    else:
        A = np.hstack([P, one])
        low = np.concatenate([np.zeros(count), [-np.inf]])
        x = bounded(A[use], y[use], low, np.full(count + 1, np.inf))
        said, offset = A @ x, float(x[count])
    K, values = scaled(data, x[:count], r)
    error = said - data.y
    return Fit(
        type="modified_prandtl_ishlinskii" if bends else "prandtl_ishlinskii",
        K=K,
        offset=offset,
        values=values,
        fitted=rms(error[use]),
        held_out=rms(error[data.held_out]) if data.held_out.any() else float("nan"),
        stroke=stroke,
        intervals={},
        knots=knots,
        slopes=slopes,
    )


def driven(type: str, values: dict[str, Any], u: np.ndarray) -> np.ndarray:
    """Output (N,) of a plant's model of H along u (N), from rest."""
    from pea_plant.model.hysteresis import CHOICE

    params = CHOICE.kinds[type](**values)
    block = Block(MODELS[type], params, 1.0)
    model, c, s = MODELS[type], block.c, block.s
    out = np.empty(len(u))
    for k, u_k in enumerate(u.tolist()):
        s = model.update(c, s, u_k)
        out[k] = model.output(c, s)
    return out
