r"""Prandtl-Ishlinskii hysteresis: a weighted sum of play operators.

.. math:: z_i \leftarrow \max(u - r_i, \min(u + r_i, z_i)), \quad v = \sum_i w_i z_i

Rate independent, with wiping-out and congruency; loops are symmetric.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pea_core.params import ParameterError, param
from pea_plant.model.hysteresis.scaling import scale


@dataclass(frozen=True)
class Params:
    """Play operators; the defaults give 12 um at 89.09 V with K = 0.142 um/V."""

    thresholds: tuple[float, ...] = param(
        (0.0, 1.5, 3.0, 5.0, 8.0, 12.0, 17.0, 23.0, 30.0, 40.0),
        "V",
        0.0,
        1000.0,
        help="play thresholds r_i, rising",
        fixed=True,
    )
    weights: tuple[float, ...] = param(
        (0.5, 0.07, 0.065, 0.06, 0.06, 0.06, 0.05, 0.05, 0.045, 0.04),
        "",
        0.0,
        100.0,
        help="relative weights w_i, scaled by u_max and v_max",
    )
    u_max: float = param(89.09, "V", 1e-3, 1e4, help="voltage of the scaling point", common=True)
    v_max: float = param(
        84.51, "V", 1e-3, 1e4, help="v there, on the first rise from rest", common=True
    )

    def __post_init__(self) -> None:
        if not self.thresholds or len(self.thresholds) != len(self.weights):
            raise ParameterError(
                f"weights has {len(self.weights)} values and thresholds "
                f"{len(self.thresholds)}: give one weight for each threshold"
            )
        if any(b <= a for a, b in zip(self.thresholds, self.thresholds[1:], strict=False)):
            raise ParameterError(f"thresholds = {list(self.thresholds)}: must rise")
        if first_rise(self.thresholds, self.weights, self.u_max) <= 0.0:
            raise ParameterError(f"u_max = {self.u_max:g}: no weighted play operator moves there")
        scaled(self)


def first_rise(r: tuple[float, ...], w: tuple[float, ...], u: float) -> float:
    """v (V) of the unscaled operators on the first rise from rest to u (V)."""
    return sum(w_i * max(u - r_i, 0.0) for r_i, w_i in zip(r, w, strict=True))


def scaled(params: Params) -> float:
    """Factor of all weights."""
    rise = first_rise(params.thresholds, params.weights, params.u_max)
    return scale(rise, sum(params.weights), params.v_max)


class Coefficients(NamedTuple):
    """Thresholds r (n) in V and scaled weights w (n)."""

    r: np.ndarray
    w: np.ndarray


class State(NamedTuple):
    """Play positions z (n) in V and their weighted sum v (V)."""

    z: np.ndarray
    v: float


def design(params: Params, T_s: float) -> Coefficients:
    """Scale the weights so that the first rise to u_max gives v_max."""
    return Coefficients(np.array(params.thresholds), np.array(params.weights) * scaled(params))


def start(c: Coefficients) -> State:
    """At rest, every play in the middle."""
    return State(np.zeros(c.r.size), 0.0)


def output(c: Coefficients, s: State) -> float:
    """Effective voltage v (V)."""
    return s.v


def update(c: Coefficients, s: State, u: float) -> State:
    """Move every play operator to the voltage u (V)."""
    v = 0.0
    for i in range(c.r.size):
        z = max(u - c.r[i], min(u + c.r[i], s.z[i]))
        s.z[i] = z
        v += c.w[i] * z
    return State(s.z, float(v))
