r"""Inverse of a fitted hysteresis, driven by the feedforward: what H takes is fed forward.

H is a modified Prandtl-Ishlinskii operator, plays behind a memoryless curve S,

.. math:: p = \sum_{i=0}^{n} w_i P_{r_i}(u), \quad v = S(p), \quad 0 = r_0 < r_1 < \dots

S^{-1} is piecewise linear through the origin, of slope s_j > 0 between two of its knots. The
inverse of the plays is again a sum of plays, with W_i = w_0 + ... + w_i,

.. math:: u = \sum_i w'_i P_{r'_i}(p), \quad r'_i = \sum_{j \le i} w_j (r_i - r_j), \quad
          w'_0 = \frac{1}{w_0}, \quad w'_i = \frac{1}{W_i} - \frac{1}{W_{i-1}}

It is exact, minor loops included, where every W_i is positive: the plays of p at r'_i turn when
those of u at r_i do. So the error of what is fed forward is that of the fit alone.

With v the voltage that the linear model needs (Eq 7), u - v is added to the command. v comes from
the reference alone: no noise enters the operator, and it is in no loop.

Source: K. Kuhnen, European Journal of Control 9(4), 2003.

Inputs
    v (V).
Outputs
    u - v (V).
State
    plays z (n) of p (V).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np

from pea_core.params import ParameterError, param

PLAYS_MAX = 1000
"""Play operators, and knots, that an inverse may have."""


@dataclass(frozen=True)
class Params:
    """A fitted H; by default v = u, and nothing is fed forward."""

    thresholds: tuple[float, ...] = param(
        (0.0,), "V", 0.0, 1e4, help="play thresholds r_i of the fitted H, rising from 0", fixed=True
    )
    weights: tuple[float, ...] = param(
        (1.0,), "", -1e3, 1e3, help="weight w_i of each of these plays"
    )
    knots: tuple[float, ...] = param(
        (0.0,), "V", -1e4, 1e4, help="knots of its curve S^-1 in v, rising", fixed=True
    )
    slopes: tuple[float, ...] = param(
        (1.0, 1.0), "", 1e-3, 1e3, help="slopes of S^-1, below, between and above its knots"
    )

    @property
    def given(self) -> bool:
        """Whether H is another than v = u."""
        return self.weights != (1.0,) or any(s != 1.0 for s in self.slopes)

    def __post_init__(self) -> None:
        if len(self.thresholds) != len(self.weights):
            raise ParameterError(
                f"weights has {len(self.weights)} values and thresholds "
                f"{len(self.thresholds)}: give one weight for each threshold"
            )
        for name in ("thresholds", "knots"):
            values = getattr(self, name)
            if len(values) > PLAYS_MAX:
                raise ParameterError(
                    f"{name} has {len(values)} values: at most {PLAYS_MAX} are used; give fewer"
                )
            if any(b <= a for a, b in pairwise(values)):
                raise ParameterError(f"{name} = {list(values)}: must rise")
        if not self.thresholds or self.thresholds[0] != 0.0:
            raise ParameterError(
                f"thresholds = {list(self.thresholds)}: must begin at 0, or H cannot be inverted"
            )
        if any(W <= 0.0 for W in accumulate(self.weights)):
            raise ParameterError(
                f"weights = {list(self.weights)}: their sum up to any threshold must be positive, "
                "or H cannot be inverted"
            )
        if len(self.slopes) != len(self.knots) + 1:
            raise ParameterError(
                f"slopes has {len(self.slopes)} values and knots {len(self.knots)}: give one "
                "slope more than knots"
            )


class Coefficients(NamedTuple):
    """r (n), w (n): thresholds (V) and weights of the inverse.

    knots (m), slopes (m + 1): of S^-1.  on: whether there is one.
    """

    r: np.ndarray
    w: np.ndarray
    knots: np.ndarray
    slopes: np.ndarray
    on: bool


class State(NamedTuple):
    """Plays z (n) of p (V)."""

    z: np.ndarray


def inverted(r: Sequence[float], w: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Thresholds (V) and weights of the inverse of a sum of plays of thresholds r and weights w."""
    r_i, w_i = np.asarray(r, float), np.asarray(w, float)
    W = np.cumsum(w_i)
    return np.cumsum(np.append(0.0, W[:-1] * np.diff(r_i))), np.diff(1.0 / W, prepend=0.0)


def design(params: Params) -> Coefficients:
    """Invert H."""
    r, w = inverted(params.thresholds, params.weights)
    return Coefficients(r, w, np.array(params.knots), np.array(params.slopes), params.given)


def centred(c: Coefficients) -> State:
    """At rest, every play in the middle."""
    return State(np.zeros(c.r.size))


def straight(c: Coefficients, v: float) -> float:
    """p = S^-1(v) (V)."""
    p = c.slopes[0] * v
    for i in range(c.knots.size):
        # what each piece adds beyond its knot, counted so that p(0) = 0
        knot = c.knots[i]
        p += (c.slopes[i + 1] - c.slopes[i]) * (max(v, knot) - max(0.0, knot))
    return float(p)


def added(c: Coefficients, s: State, v: float) -> float:
    """What H takes from v, and is fed forward besides it (V)."""
    if not c.on:
        return 0.0
    p, u = straight(c, v), 0.0
    for i in range(c.r.size):
        u += c.w[i] * max(p - c.r[i], min(p + c.r[i], s.z[i]))
    return float(u - v)


def fed(c: Coefficients, s: State, v: float) -> float:
    """v with what is fed forward besides it (V)."""
    return v + added(c, s, v) if c.on else v


def moved(c: Coefficients, s: State, v: float) -> State:
    """Move every play to v (V)."""
    if c.on:
        p = straight(c, v)
        for i in range(c.r.size):
            s.z[i] = max(p - c.r[i], min(p + c.r[i], s.z[i]))
    return s
