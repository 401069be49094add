r"""Classical Preisach hysteresis with uniform density, in Everett form over the extrema.

For a uniform density on low <= beta <= alpha <= high, scaled so that the irreversible part p
runs from low to high with u, the Everett function over one monotone change is a square,

.. math:: p(u) = p_n \pm \frac{(u - e_n)^2}{high - low},

with + on a rise from the last extremum e_n, where p was p_n, and - on a fall. The memory is
the list of alternating extrema; an extremum that u passes is wiped out together with its
partner, and p goes on along the branch it had left. With the irreversible share s,

.. math:: v = \frac{v_{max}}{r(u_{max})} r(u), \quad r = (1 - s)\,u + s\,(p - p_{rest}),

so that rest at 0 V, on the rise from negative saturation, gives 0, and the first rise to
u_max gives v_max. Outside low to high p is saturated and only the reversible part moves.

Rate independent, with wiping-out and congruency. Exact and continuous: no grid of relays.
The memory holds `CAPACITY` extrema. When a history needs more, the pair that bounds the
smallest rectangle in the Preisach plane is dropped: nothing moves then, and v jumps a little
when a later change wipes out that place: on a spiral of ever smaller swings by less than
10 s (high - low) / CAPACITY^2, scaled, 2 mV by default. Noise needs some ten extrema.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pea_core.params import param
from pea_plant.model.hysteresis.scaling import scale

CAPACITY = 512
"""Extrema that the memory holds, an even number."""


@dataclass(frozen=True)
class Params:
    """Preisach parameters; the defaults give 12 um at 89.09 V with K = 0.142 um/V."""

    range_min: float = param(-20.0, "V", -1e4, 0.0, help="negative saturation", fixed=True)
    range_max: float = param(110.0, "V", 1e-3, 1e4, help="positive saturation", fixed=True)
    share: float = param(0.36, "", 0.0, 1.0, help="irreversible share")
    u_max: float = param(89.09, "V", 1e-3, 1e4, help="voltage of the scaling point", common=True)
    v_max: float = param(
        84.51, "V", 1e-3, 1e4, help="v there, on the first rise from rest", common=True
    )

    def __post_init__(self) -> None:
        scaled(self)


def first_rise(params: Params) -> float:
    """Unscaled v (V) on the first rise from rest to u_max."""
    low, high = params.range_min, params.range_max
    u = min(params.u_max, high)
    risen = ((u - low) ** 2 - low**2) / (high - low)
    return (1.0 - params.share) * params.u_max + params.share * risen


def scaled(params: Params) -> float:
    """Factor of both parts."""
    return scale(first_rise(params), 1.0 + params.share, params.v_max)


class Coefficients(NamedTuple):
    """Saturation (V), 1 / (high - low) (1/V), scaled shares of the parts."""

    low: float
    high: float
    density: float
    reversible: float
    irreversible: float


class State(NamedTuple):
    """Memory and output.

    e (CAPACITY) in V: extrema, minima at even places, the first is negative saturation.
    p (CAPACITY) in V: irreversible part there, less its value at rest.  n: how many count;
    odd on a rise, even on a fall.  u (V): last voltage within saturation.  v (V): output.
    """

    e: np.ndarray
    p: np.ndarray
    n: int
    u: float
    v: float


def design(params: Params, T_s: float) -> Coefficients:
    """Scale both parts so that the first rise to u_max gives v_max."""
    gain = scaled(params)
    return Coefficients(
        low=params.range_min,
        high=params.range_max,
        density=1.0 / (params.range_max - params.range_min),
        reversible=gain * (1.0 - params.share),
        irreversible=gain * params.share,
    )


def start(c: Coefficients) -> State:
    """At rest at 0 V on the rise from negative saturation."""
    e, p = np.zeros(CAPACITY), np.zeros(CAPACITY)
    e[0] = c.low
    p[0] = -(c.low * c.low * c.density)
    return State(e, p, 1, 0.0, 0.0)


def output(c: Coefficients, s: State) -> float:
    """Effective voltage v (V)."""
    return s.v


def _branch(c: Coefficients, s: State, n: int, u: float) -> float:
    """Irreversible part (V) at u on the branch that left extremum n - 1."""
    change = u - s.e[n - 1]
    square = change * change * c.density
    return s.p[n - 1] + square if n % 2 == 1 else s.p[n - 1] - square


def _drop_least(s: State, n: int) -> int:
    """Drop the pair of extrema that bounds the smallest rectangle of the Preisach plane."""
    least, at = math.inf, 1
    for i in range(1, n - 2):
        middle = abs(s.e[i] - s.e[i + 1])
        before = abs(s.e[i] - s.e[i - 1]) - middle
        after = middle - abs(s.e[i + 2] - s.e[i + 1])
        if before * after < least:
            least, at = before * after, i
    for i in range(at, n - 2):
        s.e[i] = s.e[i + 2]
        s.p[i] = s.p[i + 2]
    return n - 2


def update(c: Coefficients, s: State, u: float) -> State:
    """Remember a turn, forget what u passes, follow the branch to u (V)."""
    inside = min(max(u, c.low), c.high)
    n = s.n
    if inside != s.u:
        rising = inside > s.u
        if rising != (n % 2 == 1):
            if n == s.e.size:
                n = _drop_least(s, n)
            p_turn = _branch(c, s, n, s.u)
            s.e[n] = s.u
            s.p[n] = p_turn
            n += 1
        if rising:
            while n > 2 and inside >= s.e[n - 2]:
                n -= 2
        else:
            while n > 2 and inside <= s.e[n - 2]:
                n -= 2
            if inside <= c.low:
                n = 1
    p = _branch(c, s, n, inside)
    return State(s.e, s.p, n, inside, c.reversible * u + c.irreversible * p)
