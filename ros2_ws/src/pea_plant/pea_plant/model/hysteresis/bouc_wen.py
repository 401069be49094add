r"""Bouc-Wen hysteresis with n = 1, in closed form over each monotone voltage change.

.. math:: v = u - h, \quad
          dh = \alpha\,du - \beta\,|du|\,h - \gamma\,du\,|h|

With z = sgn(du) h the equation is linear in z on either side of z = 0,

.. math:: \frac{dz}{d|u|} = \alpha - k z, \quad
          k = \beta + \gamma \;(z \ge 0), \quad k = \beta - \gamma \;(z < 0),

so no integrator is needed and the result does not depend on how a change is divided.

Rate independent. It has neither wiping-out nor congruency: minor loops drift, and noise
on the voltage erases its memory. Use `prandtl_ishlinskii` in tests with noise.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from pea_core.params import ParameterError, param


@dataclass(frozen=True)
class Params:
    """Bouc-Wen parameters; the defaults give 12 um at 89.09 V."""

    alpha: float = param(0.35, "", 0.0, 1.0, help="initial slope of h over u")
    beta: float = param(0.0424, "1/V", 1e-9, 10.0, help="loop shape, with |du| h")
    gamma: float = param(0.03394, "1/V", -10.0, 10.0, help="loop shape, with du |h|")

    def __post_init__(self) -> None:
        if abs(self.gamma) > self.beta:
            raise ParameterError(f"gamma = {self.gamma:g}: must be within +-beta ({self.beta:g})")


class Coefficients(NamedTuple):
    """alpha (1), and k (1/V) where z >= 0 and where z < 0."""

    alpha: float
    k_up: float
    k_down: float


class State(NamedTuple):
    """Last voltage u (V) and hysteretic part h (V)."""

    u: float
    h: float


def design(params: Params, T_s: float) -> Coefficients:
    """Slopes of the two branches."""
    return Coefficients(params.alpha, params.beta + params.gamma, params.beta - params.gamma)


def start(c: Coefficients) -> State:
    """At rest: u = 0, h = 0."""
    return State(0.0, 0.0)


def output(c: Coefficients, s: State) -> float:
    """Effective voltage v = u - h (V)."""
    return s.u - s.h


def _branch(alpha: float, k: float, z: float, distance: float) -> float:
    """Solution of dz/d|u| = alpha - k z after `distance` (V)."""
    x = k * distance
    if x < 1e-12:
        return z + (alpha - k * z) * distance
    return z - (alpha / k - z) * math.expm1(-x)


def update(c: Coefficients, s: State, u: float) -> State:
    """Follow the loop from the last voltage to u (V)."""
    if u == s.u:
        return s
    sign = 1.0 if u > s.u else -1.0
    distance = abs(u - s.u)
    z = sign * s.h
    if z < 0.0 and c.alpha > 0.0:
        if c.k_down > 0.0:
            to_zero = math.log1p(-z * c.k_down / c.alpha) / c.k_down
        else:
            to_zero = -z / c.alpha
        if to_zero >= distance:
            return State(u, sign * _branch(c.alpha, c.k_down, z, distance))
        z = 0.0
        distance -= to_zero
    elif z < 0.0:
        return State(u, sign * _branch(c.alpha, c.k_down, z, distance))
    return State(u, sign * _branch(c.alpha, c.k_up, z, distance))
