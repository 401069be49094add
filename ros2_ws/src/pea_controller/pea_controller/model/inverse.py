r"""Inverse of a fitted hysteresis, driven by the feedforward: what H takes is fed forward.

H is a modified Prandtl-Ishlinskii operator, plays behind a memoryless curve S,

.. math:: p = \sum_{i=0}^{n} w_i P_{r_i}(u), \quad v = S(p), \quad 0 = r_0 < r_1 < \dots

S^{-1} is piecewise linear through the origin, of slope s_j > 0 between two of its knots. The
inverse of the plays is again a sum of plays, with W_i = w_0 + ... + w_i,

.. math:: u = \sum_i w'_i P_{r'_i}(p), \quad r'_i = \sum_{j \le i} w_j (r_i - r_j), \quad
          w'_0 = \frac{1}{w_0}, \quad w'_i = \frac{1}{W_i} - \frac{1}{W_{i-1}}

It is exact, minor loops included, where every W_i is positive: the plays of p at r'_i turn when
those of u at r_i do. So the error of what is fed forward is that of the fit alone.

A fitted Bouc-Wen operator, x = u - h, may stand in front of the plays, or alone, as these are v = u
by default. Over a monotone change, with \sigma = sgn(dv) and z = \sigma h,

.. math:: \frac{dz}{d|u|} = \alpha - k z, \quad |\Delta x| = d - (z(d) - z(0)), \quad
          k = \beta + \gamma \;(z \ge 0), \quad k = \beta - \gamma \;(z < 0)

z is known in closed form, and |\Delta x| is a rising convex function of the way d = |\Delta u|
where 1 - \alpha + k z > 0, so Newton's method from d = |\Delta x| / (1 - \alpha + k z(0)) falls
onto its root without a miss, to rounding.

With v the voltage that the linear model needs (Eq 7), u - v is added to the command. v comes from
the reference alone: no noise enters the operator, and it is in no loop.

Source: K. Kuhnen, European Journal of Control 9(4), 2003.

Inputs
    v (V).
Outputs
    u - v (V).
State
    plays z (n) of p (V), u and h of Bouc-Wen (V).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np

from pea_core.params import ParameterError, param

PLAYS_MAX = 1000
"""Play operators, and knots, that an inverse may have."""

STEPS_MAX = 50
"""Newton steps at most; a handful are enough."""


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

    alpha: float = param(0.0, "", 0.0, 1.0, help="alpha of a fitted Bouc-Wen; 0: there is none")
    beta: float = param(0.0424, "1/V", 1e-9, 10.0, help="its beta")
    gamma: float = param(0.03394, "1/V", -10.0, 10.0, help="its gamma")

    @property
    def given(self) -> bool:
        """Whether H is another than v = u."""
        return self.weights != (1.0,) or self.alpha > 0.0 or any(s != 1.0 for s in self.slopes)

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
        if abs(self.gamma) > self.beta:
            raise ParameterError(f"gamma = {self.gamma:g}: must be within +-beta ({self.beta:g})")
        if self.alpha > 0.0 and self.alpha * 2.0 * self.beta >= self.beta + self.gamma:
            raise ParameterError(
                f"alpha = {self.alpha:g}: must be below (beta + gamma) / (2 beta) = "
                f"{(self.beta + self.gamma) / (2.0 * self.beta):g}, or H cannot be inverted"
            )


class Coefficients(NamedTuple):
    """r (n), w (n): thresholds (V) and weights of the inverse.

    knots (m), slopes (m + 1): of S^-1.  alpha (1), k_up, k_down (1/V): Bouc-Wen, k where z >= 0
    and where z < 0.  on: whether there is an inverse.
    """

    r: np.ndarray
    w: np.ndarray
    knots: np.ndarray
    slopes: np.ndarray
    alpha: float
    k_up: float
    k_down: float
    on: bool


class State(NamedTuple):
    """Plays z (n) of p (V).  x, u, h: last input and output of Bouc-Wen, inverted, and h (V)."""

    z: np.ndarray
    x: float
    u: float
    h: float


def inverted(r: Sequence[float], w: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Thresholds (V) and weights of the inverse of a sum of plays of thresholds r and weights w."""
    r_i, w_i = np.asarray(r, float), np.asarray(w, float)
    W = np.cumsum(w_i)
    return np.cumsum(np.append(0.0, W[:-1] * np.diff(r_i))), np.diff(1.0 / W, prepend=0.0)


def design(params: Params) -> Coefficients:
    """Invert H."""
    r, w = inverted(params.thresholds, params.weights)
    return Coefficients(
        r=r,
        w=w,
        knots=np.array(params.knots),
        slopes=np.array(params.slopes),
        alpha=params.alpha,
        k_up=params.beta + params.gamma,
        k_down=params.beta - params.gamma,
        on=params.given,
    )


def centred(c: Coefficients) -> State:
    """At rest, every play in the middle."""
    return State(np.zeros(c.r.size), 0.0, 0.0, 0.0)


def straight(c: Coefficients, v: float) -> float:
    """p = S^-1(v) (V)."""
    p = c.slopes[0] * v
    for i in range(c.knots.size):
        # what each piece adds beyond its knot, counted so that p(0) = 0
        knot = c.knots[i]
        p += (c.slopes[i + 1] - c.slopes[i]) * (max(v, knot) - max(0.0, knot))
    return float(p)


def branch(alpha: float, k: float, z: float, d: float) -> float:
    """Solution of dz/d|u| = alpha - k z after d (V)."""
    if k * d < 1e-12:
        return z + (alpha - k * z) * d
    return z - (alpha / k - z) * math.expm1(-k * d)


def along(c: Coefficients, z: float, d: float) -> tuple[float, float]:
    """z (V) after the way d (V) of u, and k there (1/V)."""
    if z >= 0.0:
        return branch(c.alpha, c.k_up, z, d), c.k_up
    low = c.k_down
    to_zero = math.log1p(-z * low / c.alpha) / low if -z * low > 1e-9 * c.alpha else -z / c.alpha
    if to_zero >= d:
        return branch(c.alpha, low, z, d), low
    return branch(c.alpha, c.k_up, 0.0, d - to_zero), c.k_up


def unbent(c: Coefficients, s: State, x: float) -> tuple[float, float]:
    """u and h (V) at which Bouc-Wen answers x (V)."""
    if c.alpha == 0.0:
        return x, 0.0
    if x == s.x:
        return s.u, s.h
    sign = 1.0 if x > s.x else -1.0
    way, z_0 = abs(x - s.x), sign * s.h
    d = way / (1.0 - c.alpha + (c.k_up if z_0 >= 0.0 else c.k_down) * z_0)
    z, k = along(c, z_0, d)
    for _ in range(STEPS_MAX):
        step = (d - (z - z_0) - way) / (1.0 - c.alpha + k * z)
        if not step > 0.0:
            break
        d -= step
        z, k = along(c, z_0, d)
    return s.u + sign * d, sign * z


def unplayed(c: Coefficients, s: State, p: float) -> float:
    """x (V) at which the plays answer p (V)."""
    x = 0.0
    for i in range(c.r.size):
        x += c.w[i] * max(p - c.r[i], min(p + c.r[i], s.z[i]))
    return float(x)


def added(c: Coefficients, s: State, v: float) -> float:
    """What H takes from v, and is fed forward besides it (V)."""
    if not c.on:
        return 0.0
    return unbent(c, s, unplayed(c, s, straight(c, v)))[0] - v


def fed(c: Coefficients, s: State, v: float) -> float:
    """v with what is fed forward besides it (V)."""
    return v + added(c, s, v) if c.on else v


def moved(c: Coefficients, s: State, v: float) -> State:
    """Move every operator to v (V)."""
    if not c.on:
        return s
    p, x, u, h = straight(c, v), s.x, s.u, s.h
    if c.alpha > 0.0:  # Bouc-Wen alone goes on from where it was
        x = unplayed(c, s, p)
        u, h = unbent(c, s, x)
    for i in range(c.r.size):
        s.z[i] = max(p - c.r[i], min(p + c.r[i], s.z[i]))
    return State(s.z, x, u, h)
