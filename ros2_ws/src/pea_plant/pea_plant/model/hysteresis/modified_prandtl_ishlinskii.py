r"""Modified Prandtl-Ishlinskii hysteresis: play operators behind a memoryless curve S.

.. math:: z_i \leftarrow \max(u - r_i, \min(u + r_i, z_i)), \quad
          p = \sum_i w_i z_i, \quad v = S(p)

S^{-1} is piecewise linear through the origin, of slope s_j > 0 between two of its knots, as in
the inverse that a controller feeds forward. Loops need not be symmetric.

Source: K. Kuhnen, European Journal of Control 9(4), 2003.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pea_core.params import ParameterError, param


@dataclass(frozen=True)
class Params:
    """Play operators and the curve; the defaults give 84.5 V at 89.09 V."""

    thresholds: tuple[float, ...] = param(
        (0.0, 2.0, 6.0, 14.0, 26.0, 40.0),
        "V",
        0.0,
        1000.0,
        help="play thresholds r_i, rising",
        fixed=True,
    )
    weights: tuple[float, ...] = param(
        (0.55, 0.12, 0.11, 0.09, 0.07, 0.06), "", 0.0, 100.0, help="weights w_i"
    )
    knots: tuple[float, ...] = param(
        (20.0, 60.0), "V", -1e4, 1e4, help="knots of its curve S^-1 in v, rising", fixed=True
    )
    slopes: tuple[float, ...] = param(
        (1.1, 0.98, 0.92), "", 1e-3, 1e3, help="slopes of S^-1, below, between and above its knots"
    )

    def __post_init__(self) -> None:
        if not self.thresholds or len(self.thresholds) != len(self.weights):
            raise ParameterError(
                f"weights has {len(self.weights)} values and thresholds "
                f"{len(self.thresholds)}: give one weight for each threshold"
            )
        for name in ("thresholds", "knots"):
            if any(b <= a for a, b in pairwise(getattr(self, name))):
                raise ParameterError(f"{name} = {list(getattr(self, name))}: must rise")
        if len(self.slopes) != len(self.knots) + 1:
            raise ParameterError(
                f"slopes has {len(self.slopes)} values and knots {len(self.knots)}: give one "
                "slope more than knots"
            )


class Coefficients(NamedTuple):
    """Thresholds r (n) in V, weights w (n); S: p (m) at the knots, v (m) there, slopes (m + 1)."""

    r: np.ndarray
    w: np.ndarray
    p: np.ndarray
    v: np.ndarray
    slopes: np.ndarray


class State(NamedTuple):
    """Play positions z (n) in V and the output v (V)."""

    z: np.ndarray
    v: float


def design(params: Params, T_s: float) -> Coefficients:
    """Turn S^-1 round: where its knots lie in p."""
    knots, slopes = np.array(params.knots), np.array(params.slopes)
    p = slopes[0] * knots
    for i in range(knots.size):
        over = np.maximum(knots, knots[i]) - max(0.0, knots[i])
        p = p + (slopes[i + 1] - slopes[i]) * over
    return Coefficients(np.array(params.thresholds), np.array(params.weights), p, knots, slopes)


def start(c: Coefficients) -> State:
    """At rest, every play in the middle; S passes through the origin."""
    return State(np.zeros(c.r.size), 0.0)


def output(c: Coefficients, s: State) -> float:
    """Effective voltage v (V)."""
    return s.v


def curve(c: Coefficients, p: float) -> float:
    """v = S(p) (V)."""
    n = c.p.size
    if n == 0:
        return float(p / c.slopes[0])
    if p <= c.p[0]:
        return float(c.v[0] + (p - c.p[0]) / c.slopes[0])
    for i in range(1, n):
        if p <= c.p[i]:
            return float(c.v[i - 1] + (p - c.p[i - 1]) / c.slopes[i])
    return float(c.v[n - 1] + (p - c.p[n - 1]) / c.slopes[n])


def update(c: Coefficients, s: State, u: float) -> State:
    """Move every play operator to the voltage u (V)."""
    p = 0.0
    for i in range(c.r.size):
        z = max(u - c.r[i], min(u + c.r[i], s.z[i]))
        s.z[i] = z
        p += c.w[i] * z
    return State(s.z, curve(c, float(p)))
