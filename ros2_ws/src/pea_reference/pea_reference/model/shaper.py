r"""Shaped moves: how w gets from one level to another without a jump and without shaking V.

A move by a is an S-curve of limited velocity, acceleration and jerk, sent once for each impulse of
an input shaper,

.. math:: w = w_0 + a \sum_i A_i\,g(t - t_i), \quad \sum_i A_i = 1, \quad A_i > 0

g, from 0 to 1, has piecewise constant jerk: +J for T_j, 0, -J for T_j, over T_a; then it moves
evenly for T_v; then the mirror image of the first part. All derivatives are exact. As the A_i are
positive and add up to 1, the sum keeps every limit that g keeps.

Limits of velocity v, acceleration a_m and jerk j give the shortest such curve:

.. math:: T_j = \min\bigl(\tfrac{a_m}{j}, \sqrt{\tfrac{v}{j}}, \sqrt[3]{\tfrac{a}{2 j}}\bigr),
          \quad T_a = \max\bigl(2 T_j, \cdot\bigr), \quad T_v = \frac{a}{v} - T_a

with T_a from a_m where it is met, and less where v is not met. The voltage that Eq 7 asks for
changes by (w''' + 2 zeta omega_n w'' + omega_n^2 w') / B_2; where that passes the slew rate, or
the current over the capacitance, the curve is made slower as a whole until it does not.

Impulses (K = e^{-\pi \zeta / \sqrt{1 - \zeta^2}}, T_d the damped period):

smooth
    one: the S-curve alone.
zv
    A = [1, K]/(1 + K) at 0, T_d/2: no vibration is left of the mode, where its frequency is right.
zvd
    A = [1, 2K, K^2]/(1 + K)^2 at 0, T_d/2, T_d: nor does it begin to grow with an error.
robust
    The shortest impulses, of those on a grid, that leave at most `tolerance` of the vibration of a
    raw step at every frequency within `spread`, by linear programmes.

Of several modes the shapers are convolved. A mode of damping 1 and more does not vibrate and is
left out.

Sources: N. C. Singer, W. P. Seering, ASME J. Dyn. Sys. Meas. Control 112, 1990 (zv, zvd);
W. Singhose, W. Seering, N. Singer, ASME J. Mech. Design 116, 1994 (spread and tolerance).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from pea_core.params import ParameterError, group, param

TYPES = ("none", "smooth", "zv", "zvd", "robust")

GRID = 48
"""Times at which the programme may place an impulse."""

LINES = 15
"""Frequencies at which it looks."""

SIDES = 16
"""Directions in which it bounds the size of a vibration."""

LONGEST = 6.0
"""Longest shaper that it tries, in damped periods."""

IMPULSES_MAX = 1000
"""Impulses of several modes together."""


LEAST = 1e-9
"""A way (um) that is none, a femtometre; and the least limit, in its own unit."""

LIMITS = ("velocity_max", "acceleration_max", "jerk_max", "slew_rate", "current_max")
"""Parameters that limit a move where they are not 0."""


@dataclass(frozen=True)
class ShaperParams:
    """Limits of a move, and the modes that it is not to shake."""

    type: str = param(
        "none",
        help="impulses of a shaped move; none: w jumps",
        choices=TYPES,
        fixed=True,
        common=True,
    )
    omega_n: tuple[float, ...] = param(
        (5450.0,), "rad/s", 1.0, 1e6, help="natural frequency of each mode", common=True
    )
    zeta: tuple[float, ...] = param(
        (0.82,), "", 0.0, 10.0, help="damping ratio of each mode", common=True
    )
    spread: float = param(
        0.1, "", 0.0, 0.5, help="error of frequency, either way, that robust stands", common=True
    )
    tolerance: float = param(
        0.02, "", 1e-3, 0.5, help="vibration that robust leaves, of that of a raw step", common=True
    )
    move_time: float = param(
        0.001, "s", 1e-6, 1e4, help="shortest time of a move, its impulses besides", common=True
    )
    velocity_max: float = param(
        0.0, "um/s", 0.0, 1e12, help="fastest velocity of a move; 0: no limit", common=True
    )
    acceleration_max: float = param(
        0.0, "um/s^2", 0.0, 1e15, help="largest acceleration; 0: no limit", common=True
    )
    jerk_max: float = param(0.0, "um/s^3", 0.0, 1e18, help="largest jerk; 0: no limit", common=True)
    slew_rate: float = param(
        0.0, "V/s", 0.0, 1e9, help="fastest change of the voltage of Eq 7; 0: no limit", common=True
    )
    current_max: float = param(
        0.0, "A", 0.0, 1e3, help="current of the amplifier; 0: no limit", common=True
    )
    capacitance: float = param(
        1e-6,
        "F",
        1e-12,
        1.0,
        help="of the actuator, whose current is C du/dt",
        common=True,
    )
    K: float = param(
        0.142, "um/V", 1e-6, 1e3, help="gain with which volts are counted", common=True
    )
    rest_um: float = param(
        0.0, "um", -1e4, 1e4, help="where w is before the first sample", common=True
    )

    def __post_init__(self) -> None:
        if not self.omega_n or len(self.omega_n) != len(self.zeta):
            raise ParameterError(
                f"shaper.zeta has {len(self.zeta)} values and omega_n {len(self.omega_n)}: give "
                "one of each for each mode"
            )
        for name in LIMITS:
            if 0.0 < (value := getattr(self, name)) < LEAST:
                raise ParameterError(
                    f"shaper.{name} = {value:g}: give 0 for no limit, or {LEAST:g} at least"
                )

    @property
    def on(self) -> bool:
        """Whether moves are shaped."""
        return self.type != "none"


@dataclass(frozen=True)
class Shapeable:
    """What every reference has besides its own parameters."""

    shaper: ShaperParams = group(ShaperParams)


class Curve(NamedTuple):
    """T_j, T_a, T_v (s) of g; times (m) in s and weights (m) of the impulses."""

    T_j: float
    T_a: float
    T_v: float
    t: np.ndarray
    A: np.ndarray

    @property
    def length(self) -> float:
        """How long a move takes (s)."""
        return 2.0 * self.T_a + self.T_v + float(self.t[-1])


NO_MOVE = Curve(0.0, 0.0, 0.0, np.zeros(1), np.ones(1))
"""A move that is over at once."""


def impulses(params: ShaperParams) -> tuple[np.ndarray, np.ndarray]:
    """Times (m) in s, rising, and weights (m) of the impulses for all modes.

    Raises
    ------
    ParameterError
        No shaper is short enough, or there would be too many impulses.
    """
    t, A = np.zeros(1), np.ones(1)
    for omega_n, zeta in zip(params.omega_n, params.zeta, strict=True):
        if zeta >= 1.0 or params.type == "smooth":
            continue
        root = math.sqrt(1.0 - zeta * zeta)
        half, K = math.pi / (omega_n * root), math.exp(-math.pi * zeta / root)
        if params.type == "zv":
            t_i, A_i = half * np.arange(2), np.array([1.0, K])
        elif params.type == "zvd":
            t_i, A_i = half * np.arange(3), np.array([1.0, 2.0 * K, K * K])
        else:
            t_i, A_i = robust(omega_n, zeta, params.spread, params.tolerance)
        t, A = np.add.outer(t, t_i).ravel(), np.outer(A, A_i / A_i.sum()).ravel()
        if t.size > IMPULSES_MAX:
            raise ParameterError(
                f"shaper.omega_n has {len(params.omega_n)} modes: their shapers make more than "
                f"{IMPULSES_MAX} impulses; give fewer modes"
            )
    order = np.argsort(t, kind="stable")
    return t[order], A[order]


def left(t: np.ndarray, A: np.ndarray, omega_n: float, zeta: float) -> float:
    """Vibration that impulses leave of a mode, as a share of that of a raw step."""
    root = math.sqrt(1.0 - zeta * zeta)
    turning = np.exp((zeta + 1j * root) * omega_n * (t - t[-1]))
    return float(abs(A @ turning))


@cache
def robust(
    omega_n: float, zeta: float, spread: float, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """The shortest impulses that leave `tolerance` within `spread`; see the head of this module.

    Raises
    ------
    ParameterError
        There are none within `LONGEST` damped periods.
    """
    period = 2.0 * math.pi / (omega_n * math.sqrt(1.0 - zeta * zeta))
    low, high = 0.25, LONGEST
    best = least(high * period, omega_n, zeta, spread)
    if best[0] > tolerance:
        raise ParameterError(
            f"shaper.tolerance = {tolerance:g}: no impulses within {LONGEST:g} periods leave that "
            f"within shaper.spread = {spread:g}; raise it, or lower the spread"
        )
    while high - low > 0.02:
        middle = 0.5 * (low + high)
        found = least(middle * period, omega_n, zeta, spread)
        if found[0] <= tolerance:
            high, best = middle, found
        else:
            low = middle
    return best[1], best[2]


def least(
    length: float, omega_n: float, zeta: float, spread: float
) -> tuple[float, np.ndarray, np.ndarray]:
    """Least vibration of impulses over `length` (s), by a linear programme; times and weights."""
    from scipy.optimize import linprog  # slow to import

    t = np.linspace(0.0, length, GRID)
    root = math.sqrt(1.0 - zeta * zeta)
    omega = omega_n * np.linspace(1.0 - spread, 1.0 + spread, LINES)
    turning = np.exp(np.outer(omega, t - length) * (zeta + 1j * root))
    sides = np.exp(-2j * math.pi * np.arange(SIDES) / SIDES)
    rows = np.real(np.multiply.outer(sides, turning)).reshape(-1, GRID)
    # a vibration within the polygon of these sides is at most 1 / cos(pi / SIDES) as large
    bound = np.full((len(rows), 1), -math.cos(math.pi / SIDES))
    answer = linprog(
        np.append(np.zeros(GRID), 1.0),
        A_ub=np.hstack([rows, bound]),
        b_ub=np.zeros(len(rows)),
        A_eq=np.append(np.ones(GRID), 0.0)[None, :],
        b_eq=[1.0],
        method="highs",
    )
    A = np.maximum(answer.x[:GRID], 0.0)
    kept = A > 1e-6
    return float(answer.x[GRID]), t[kept] - t[kept][0], A[kept] / A[kept].sum()


def curve(params: ShaperParams, way: float, shaper: tuple[np.ndarray, np.ndarray]) -> Curve:
    """The move of a way (m, either sign) with the impulses of a shaper."""
    a = abs(way) * 1e6
    v, a_m, j = (
        limit if limit > 0.0 else math.inf
        for limit in (params.velocity_max, params.acceleration_max, params.jerk_max)
    )
    T_j = T_a = T_v = 0.0
    if a > LEAST and math.isfinite(min(v, a_m, j)):
        T_j, T_a, T_v = shortest(a, v, a_m, j)
    T = 2.0 * T_a + T_v
    if params.move_time > T:
        if T == 0.0:  # a quarter of the time for each half of T_a, as if only jerk were limited
            T_j, T_a, T_v = 0.25, 0.5, 0.0
            T = 1.0
        stretch = params.move_time / T
        T_j, T_a, T_v = T_j * stretch, T_a * stretch, T_v * stretch
    if min_rate := rate_of(params):
        stretch = slower(params, a, T_j, T_a, T_v, min_rate)
        T_j, T_a, T_v = T_j * stretch, T_a * stretch, T_v * stretch
    return Curve(T_j, T_a, T_v, *shaper)


def rate_of(params: ShaperParams) -> float:
    """Fastest change of the voltage (V/s); 0: no limit."""
    rates = (params.slew_rate, params.current_max / params.capacitance)
    return min((rate for rate in rates if rate > 0.0), default=0.0)


def shortest(a: float, v: float, a_m: float, j: float) -> tuple[float, float, float]:
    """T_j, T_a, T_v (s) of the shortest S-curve of a way a > 0 within three limits."""
    # no limit of jerk: one so high that the corners take a hundredth of the curve
    if not math.isfinite(j):
        fastest = max(a / v, math.sqrt(a / a_m) if math.isfinite(a_m) else 0.0)
        j = 1e4 * a / fastest**3
    T_j = min(a_m / j, math.sqrt(v / j), math.cbrt(a / (2.0 * j)))
    peak = j * T_j
    T_a = 2.0 * T_j
    if peak >= a_m * (1.0 - 1e-12):  # the acceleration is met, and may be held
        held = -0.5 * T_j + math.sqrt(0.25 * T_j * T_j + a / peak)
        T_a = max(T_a, T_j + min(v / peak, held))
    reached = peak * (T_a - T_j)
    return T_j, T_a, max(a / reached - T_a, 0.0)


def slower(
    params: ShaperParams, a: float, T_j: float, T_a: float, T_v: float, rate: float
) -> float:
    """Factor of time with which the voltage of a way a (um) keeps within a rate (V/s)."""

    def fastest(stretch: float) -> float:
        return a * voltage_rate(params, T_j * stretch, T_a * stretch, T_v * stretch)

    low = high = 1.0
    if fastest(high) <= rate:
        return 1.0
    while fastest(high) > rate:
        low, high = high, 2.0 * high
    while high - low > 1e-6 * high:
        middle = 0.5 * (low + high)
        if fastest(middle) > rate:
            low = middle
        else:
            high = middle
    return high


def voltage_rate(params: ShaperParams, T_j: float, T_a: float, T_v: float) -> float:
    """Largest |du/dt| of Eq 7 for a way of 1 um (V/s), over the modes."""
    J = 1.0 / (T_j * (T_a - T_j) * (T_a + T_v))
    c = Curve(T_j, T_a, T_v, np.zeros(1), np.ones(1))
    largest = 0.0
    ends = (0.0, T_j, T_a - T_j, T_a)
    for omega, zeta in zip(params.omega_n, params.zeta, strict=True):
        for start, end, jerk in zip(ends, ends[1:], (J, 0.0, -J), strict=False):
            # w' is a parabola between two corners: its rate is largest at one of them or where
            # its own slope is none; the second half of the curve is the mirror image
            times = [start, end]
            if jerk != 0.0:
                _, _, at = g(c, start)
                peak = start - at / jerk - 2.0 * zeta / omega
                times += [peak] if start < peak < end else []
            for time in times:
                _, g_1, g_2 = g(c, time)
                for side in (1.0, -1.0):  # second half: w'' has the other sign
                    rate = jerk + side * 2.0 * zeta * omega * g_2 + omega * omega * g_1
                    largest = max(largest, abs(rate) / (params.K * omega * omega))
    return largest


def g(c: Curve, t: float) -> tuple[float, float, float]:
    """The S-curve from 0 to 1 at t (s) after its start, and its two derivatives (1/s, 1/s^2)."""
    total = 2.0 * c.T_a + c.T_v
    if t <= 0.0:
        return 0.0, 0.0, 0.0
    if t >= total:
        return 1.0, 0.0, 0.0
    late = t > 0.5 * total
    if late:
        t = total - t
    v = 1.0 / (c.T_a + c.T_v)
    a = v / (c.T_a - c.T_j)
    J = a / c.T_j
    if t < c.T_j:
        g_0, g_1, g_2 = J * t * t * t / 6.0, 0.5 * J * t * t, J * t
    elif t < c.T_a - c.T_j:
        g_0 = a * (0.5 * t * (t - c.T_j) + c.T_j * c.T_j / 6.0)
        g_1, g_2 = a * (t - 0.5 * c.T_j), a
    elif t < c.T_a:
        back = c.T_a - t
        g_0 = v * (t - 0.5 * c.T_a) + J * back * back * back / 6.0
        g_1, g_2 = v - 0.5 * J * back * back, J * back
    else:
        g_0, g_1, g_2 = v * (t - 0.5 * c.T_a), v, 0.0
    if late:
        return 1.0 - g_0, g_1, -g_2
    return g_0, g_1, g_2


def done(c: Curve, t: float) -> tuple[float, float, float]:
    """Share of a shaped move that is done t (s) after its start, and its two derivatives."""
    if c.T_a == 0.0:
        return 1.0, 0.0, 0.0
    f, f_1, f_2 = 0.0, 0.0, 0.0
    last = 2.0 * c.T_a + c.T_v + c.t[c.t.size - 1]
    if t >= last:
        return 1.0, 0.0, 0.0
    for i in range(c.t.size):
        g_0, g_1, g_2 = g(c, t - c.t[i])
        f += c.A[i] * g_0
        f_1 += c.A[i] * g_1
        f_2 += c.A[i] * g_2
    return float(f), float(f_1), float(f_2)
