r"""Play operators of Prandtl and Ishlinskii, and a fit of their thresholds and weights together.

.. math:: y = y_0 + \sum_i w_i\,L\{P_{r_i}(u)\}, \quad w_i \ge 0

The programme of `pea_identify.hysteresis` gives weights at many thresholds. From there on both
move; then two neighbours are made one, and fitted again, as long as Schwarz's criterion falls. So
a stage that is a few plays is found as these few.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple, Protocol

import numpy as np

EVALUATIONS = 40
"""Steps in which thresholds and weights are fitted together at most."""

TRIED = 2
"""Pairs of neighbours that are made one in turn, before none is."""

LEAST = 0.02
"""Least weight of the play of threshold 0, in the slope of the whole motion."""


class Moving(Protocol):
    """Slow motion (`pea_identify.slow.Data`)."""

    @property
    def u(self) -> np.ndarray:
        """Voltage (N,) in V."""

    @property
    def y(self) -> np.ndarray:
        """Displacement (N,) in m."""

    @property
    def fitted(self) -> np.ndarray:
        """Samples (N,) that count."""

    def through(self, v: np.ndarray) -> np.ndarray:
        """Columns v (N, n) through what acts behind H."""


def turns(u: np.ndarray) -> np.ndarray:
    """Samples at which u (N,) turns, with the first and the last."""
    step = np.diff(u)
    at = np.flatnonzero(step)
    if not len(at):
        return np.array([0, len(u) - 1])
    turn = at[1:][np.diff(np.sign(step[at])) != 0]
    return np.unique(np.concatenate([[0], turn, [len(u) - 1]]))


def plays(u: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Play operators (N, n) of thresholds r (n) in V along u (N), from the middle at u = 0.

    Between two turns of u an operator either waits or follows, so a whole branch is one step.
    """
    out = np.empty((len(u), len(r)))
    z = np.clip(np.zeros(len(r)), u[0] - r, u[0] + r)
    out[0] = z
    at = turns(u)
    for start, end in pairwise(at):
        branch = u[start + 1 : end + 1, None]
        if u[end] >= u[start]:
            out[start + 1 : end + 1] = np.maximum(z, branch - r)
        else:
            out[start + 1 : end + 1] = np.minimum(z, branch + r)
        z = out[end]
    return out


def thresholds(u: np.ndarray, count: int) -> np.ndarray:
    """Thresholds (count,) in V from 0 on, closer where they are small."""
    return float(np.ptp(u)) / 2.0 * (np.arange(count) / count) ** 1.5


def least_weight(data: Moving) -> float:
    """Least weight (m/V) of the play of threshold 0.

    A stage moves at once after a turn, and a law can invert H only if its model does.
    """
    return LEAST * float(np.ptp(data.y)) / max(float(np.ptp(data.u)), 1e-300)


class FittedPlays(NamedTuple):
    """Thresholds r (V), rising from 0, weights w (m/V), y_0 (m), and the sum of squares (m²)."""

    r: np.ndarray
    w: np.ndarray
    offset: float
    squares: float


class PlaysProblem:
    """The fit of `count` plays to slow motion; unknowns are log r, weights and y_0, scaled."""

    def __init__(self, data: Moving, count: int, K: float) -> None:
        self.data, self.n, self.K = data, count, K
        self.size = float(np.ptp(data.y))
        self.one = np.full((len(data.u), 1), self.size)

    def parts(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Thresholds, weights and y_0 of the unknowns."""
        r = np.concatenate([[0.0], np.exp(p[: self.n - 1])])
        return r, self.K * p[self.n - 1 : -1], self.size * float(p[-1])

    def error(self, p: np.ndarray) -> np.ndarray:
        """What the unknowns leave of y (m), at every sample."""
        r, w, offset = self.parts(p)
        return self.data.through(plays(self.data.u, r)) @ w + offset - self.data.y

    def columns(self, p: np.ndarray) -> np.ndarray:
        """Derivatives of `error`: a play depends on its own threshold alone."""
        r, w, _ = self.parts(p)
        u, step = self.data.u, 1e-5
        P = plays(u, r)
        by_r = (plays(u, r[1:] * (1.0 + step)) - P[:, 1:]) / step
        both = self.data.through(np.hstack([P, by_r]))
        return np.hstack([both[:, self.n :] * w[1:], both[:, : self.n] * self.K, self.one])

    def solve(self, r: np.ndarray, w: np.ndarray, offset: float) -> FittedPlays:
        """The minimum near r, w and y_0."""
        from scipy.optimize import least_squares

        n, use, span = self.n, self.data.fitted, float(np.ptp(self.data.u))
        low = np.concatenate([np.full(n - 1, math.log(0.2 * r[1])), np.zeros(n), [-np.inf]])
        low[n - 1] = least_weight(self.data) / self.K
        high = np.concatenate([np.full(n - 1, math.log(0.5 * span)), np.full(n + 1, np.inf)])
        first = np.concatenate([np.log(r[1:]), w / self.K, [offset / self.size]])
        found = least_squares(
            lambda p: self.error(p)[use] / self.size,
            np.clip(first, low + 1e-9, high - 1e-9),
            lambda p: self.columns(p)[use] / self.size,
            bounds=(low, high),
            x_scale="jac",
            max_nfev=EVALUATIONS,
        )
        r, w, offset = self.parts(found.x)
        order = np.argsort(r)
        return FittedPlays(r[order], w[order], offset, 2.0 * float(found.cost) * self.size**2)


def moved(data: Moving, r: np.ndarray, w: np.ndarray, offset: float) -> FittedPlays:
    """Thresholds and weights fitted together, and as few of them as the data tell apart.

    Parameters
    ----------
    data : Data
    r, w : (n,) arrays
        Thresholds (V), the first of them 0, and weights (m/V) to begin with; two or more.
    offset : float
        y_0 (m) likewise.
    """
    K = float(w.sum())
    best = PlaysProblem(data, len(r), K).solve(r, w, offset)
    while len(best.r) > 2:
        problem = PlaysProblem(data, len(best.r) - 1, K)
        for joined in neighbours(data, best)[:TRIED]:
            found = problem.solve(*joined[:3])
            if schwarz(data, found) < schwarz(data, best):
                best = found
                break
        else:
            break
    return best


def schwarz(data: Moving, fit: FittedPlays) -> float:
    """Schwarz's criterion of a fit; lower is better."""
    count = int(data.fitted.sum())
    free = 2 * len(fit.r)
    return count * math.log(max(fit.squares, 1e-300) / count) + free * math.log(count)


def neighbours(data: Moving, fit: FittedPlays) -> list[FittedPlays]:
    """The plays with two neighbours made one, those first whose loss costs least."""
    use = data.fitted
    tried = []
    for i in range(len(fit.r) - 1):
        both = fit.w[i] + fit.w[i + 1]
        middle = (fit.w[i] * fit.r[i] + fit.w[i + 1] * fit.r[i + 1]) / both if both else fit.r[i]
        r, w = np.delete(fit.r, i + 1), np.delete(fit.w, i + 1)
        r[i], w[i] = middle if i else 0.0, both
        A = np.column_stack([data.through(plays(data.u, r)), np.ones(len(data.u))])[use]
        x = np.linalg.lstsq(A, data.y[use], rcond=None)[0]
        squares = float(np.sum((A @ x - data.y[use]) ** 2))
        tried.append(FittedPlays(r, w, fit.offset, squares))
    return sorted(tried, key=lambda each: each.squares)
