r"""Repetitive learning: the residual of one period of the reference corrects the next period.

It is for a law that estimates a residual unknown input \hat\varepsilon_r and adds a correction c to
its command. On a reference with a period of N samples

.. math:: c_k = r_{k-N}, \quad
          r_j = \sum_i Q_i\,(c_{j+i} - \gamma\,\hat\varepsilon_{r,j+i+l})

where Q is a symmetric filter with unit gain at frequency 0. It has no lag, because all its inputs
are one period old. l is the lead: the number of samples from a command to the estimate that shows
its effect. If N is not whole, r is interpolated by a cubic. With \hat\varepsilon_r = G(z)(d + c)
and a periodic d, each period multiplies the residual by Q (1 - gamma G z^l). This factor is below
one where Q passes and the phase of G z^l is within 90 degrees; at low frequencies a share
(1 - gamma)^K remains after K periods.

The period is given, or found from the reference as the time between two minima of the same depth.
In both cases the correction acts only after w has repeated itself for a whole period, within
`TOLERANCE` of its span. It stops at the first sample that does not repeat, so a reference without a
period is not changed. It fades in over its first period, because a step would be learned, too.
Learning is given up, until w changes, if it makes the residual worse: if the power of the
residual's changes from sample to sample, over one period, becomes `WORSE` times that before.

Inputs
    `Reference` W (m, m/s, m/s^2), residual unknown input (V).
Outputs
    correction c (V).
State
    one period of w (m) and of r (V), the unfiltered r (V), the estimated period, and whether
    learning helps.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pea_core.params import ParameterError
from pea_core.signals import Reference, between

TOLERANCE = 1e-4
"""Largest change of w from one period to the next, as a share of its span."""

WORSE = 2.0
"""Learning is given up when the power of the residual's changes has grown by this factor."""

MOST = 1e6
"""Largest period, and largest filter (samples)."""


class Coefficients(NamedTuple):
    """on : whether anything is learned.  rate: gamma.  lead: l (samples).

    Q (n): filter, n odd.  given: N (samples), 0: to be found.  shortest, longest: bounds of N.
    size: samples that the memory holds.  T_s (s).
    """

    on: bool
    rate: float
    lead: int
    Q: np.ndarray
    given: float
    shortest: float
    longest: float
    size: int
    T_s: float


class Period(NamedTuple):
    """N: period (samples), 0: not known.  repeated: samples for which w has repeated itself.

    at, depth: time (samples) and value (m) of the minimum from which the period is counted;
    at < 0: none yet.  low, high: span of w (m).
    """

    N: float
    repeated: int
    at: float
    depth: float
    low: float
    high: float


class Use(NamedTuple):
    """Whether learning helps.

    eps: residual of the last sample (V).  power: sum of its squared changes (V^2) over the
    `counted` samples of this period.  before: that of the last period without correction.
    """

    eps: float
    power: float
    counted: int
    before: float
    given_up: bool


class State(NamedTuple):
    """k: sample number.  last: last `Reference`.  w (m), raw, r (V) (size): rings over k."""

    k: int
    period: Period
    use: Use
    last: Reference
    w: np.ndarray
    raw: np.ndarray
    r: np.ndarray


def design(
    on: bool,
    rate: float,
    bandwidth_hz: float,
    frequency_hz: float,
    period_max: float,
    lead: int,
    T_s: float,
) -> Coefficients:
    """Design the filter Q, a raised cosine with half gain at `bandwidth_hz`, and the memory.

    Parameters
    ----------
    on : bool
        False learns nothing and remembers nothing.
    rate : float
        gamma, 0 to 1.
    bandwidth_hz : float
        Frequency at which Q has half its gain (Hz).
    frequency_hz : float
        Frequency of the reference (Hz); 0: find it.
    period_max : float
        Longest period (s).
    lead : int
        Samples from a command to the estimate that shows its effect.
    T_s : float
        Sample period (s).

    Raises
    ------
    ParameterError
        The period is too short for the filter or too long for the memory, or the memory is too
        large.
    """
    # a raised cosine over +-a samples has half its gain at 1 / (2 a T_s)
    a = max(math.ceil(0.5 / (bandwidth_hz * T_s)), 1) if on else 1
    if on and (most := max(2 * a, period_max / T_s)) > MOST:
        raise ParameterError(
            f"T_s = {T_s:g} s: learning would keep {most:.3g} samples, at most {MOST:g}; shorten "
            "learning_period_max, or raise learning_bandwidth_hz"
        )
    Q = np.array([1.0 + math.cos(math.pi * i / a) for i in range(1 - a, a)])
    shortest = float(a + lead + 3)
    longest = max(period_max / T_s, shortest)
    given = 1.0 / (frequency_hz * T_s) if frequency_hz > 0.0 else 0.0
    if on and given > 0.0 and not shortest <= given <= longest:
        raise ParameterError(
            f"learning_frequency_hz = {frequency_hz:g}: must be within "
            f"{1.0 / (longest * T_s):.4g} to {1.0 / (shortest * T_s):.4g} Hz, from "
            "learning_period_max and learning_bandwidth_hz"
        )
    size = math.ceil(longest) + a + lead + 8 if on else 0
    return Coefficients(on, rate, lead, Q / Q.sum(), given, shortest, longest, size, T_s)


def blank(c: Coefficients) -> State:
    """The state with nothing learned."""
    return State(
        k=0,
        period=Period(c.given, 0, -1.0, 0.0, 0.0, 0.0),
        use=Use(0.0, 0.0, 0, 0.0, False),
        last=Reference(0.0, 0.0, 0.0),
        w=np.zeros(c.size),
        raw=np.zeros(c.size),
        r=np.zeros(c.size),
    )


def acts(c: Coefficients, s: State) -> bool:
    """Whether the correction acts."""
    known = c.on and s.period.N > 0.0
    return known and s.period.repeated >= s.period.N and not s.use.given_up


def remembered(ring: np.ndarray, at: float) -> float:
    """Value of a ring at the sample `at`, by the cubic through four neighbours."""
    first = math.floor(at)
    t = at - first
    n = ring.size
    before, here = ring[(first - 1) % n], ring[first % n]
    after, beyond = ring[(first + 1) % n], ring[(first + 2) % n]
    return float(
        here * (1.0 - t * t) * (2.0 - t) / 2.0
        + after * t * (1.0 + t) * (2.0 - t) / 2.0
        - before * t * (1.0 - t) * (2.0 - t) / 6.0
        - beyond * t * (1.0 - t * t) / 6.0
    )


def correction(c: Coefficients, s: State) -> float:
    """Correction (V) of this sample's command."""
    if not acts(c, s):
        return 0.0
    N, repeated = s.period.N, s.period.repeated
    return min(repeated / N - 1.0, 1.0) * remembered(s.r, s.k - N)


def learned(c: Coefficients, s: State, W: Reference, eps: float) -> State:
    """Learn from the residual eps (V); check whether w repeats itself and learning helps."""
    if not c.on:
        return s
    s.w[s.k % c.size] = W.w
    s.raw[s.k % c.size] = correction(c, s)
    told = s.k - c.lead
    if told >= 0:
        s.raw[told % c.size] -= c.rate * eps
        half = c.Q.size // 2
        filtered = 0.0
        for i in range(c.Q.size):
            filtered += c.Q[i] * s.raw[(told - 2 * half + i) % c.size]
        s.r[(told - half) % c.size] = filtered
    period = compared(c, s, W)
    return State(s.k + 1, period, judged(s, period, eps), W, s.w, s.raw, s.r)


def compared(c: Coefficients, s: State, W: Reference) -> Period:
    """Compare w with one period before; if no period is known, search one."""
    N, repeated, at, depth, low, high = s.period
    low, high = (min(low, W.w), max(high, W.w)) if s.k > 0 else (W.w, W.w)
    allowed = TOLERANCE * (high - low)
    if N > 0.0 and s.k >= N + 1.0:
        if high > low and abs(W.w - remembered(s.w, s.k - N)) <= allowed:
            repeated += 1
        else:
            N, repeated, at = c.given, 0, -1.0
    if N == 0.0 and s.k > 0 and s.last.w_dot < 0.0 <= W.w_dot:
        since, w = turn(s.last, W, c.T_s)
        now = s.k - 1.0 + since
        gap = now - at
        if at >= 0.0 and abs(w - depth) <= allowed and c.shortest <= gap <= c.longest:
            N = gap
        if at < 0.0 or N > 0.0 or w < depth or gap > c.longest:
            at, depth = now, w
    return Period(N, repeated, at, depth, low, high)


def turn(a: Reference, b: Reference, T_s: float) -> tuple[float, float]:
    """Time of the minimum of w, as a fraction of the interval from a to b, and its value (m)."""
    theta = a.w_dot / (a.w_dot - b.w_dot)
    for _ in range(2):  # Newton's method, starting at the zero of the straight line
        W = between(a, b, theta, T_s)
        if W.w_ddot > 0.0:
            theta = min(max(theta - W.w_dot / (W.w_ddot * T_s), 0.0), 1.0)
    return theta, between(a, b, theta, T_s).w


def judged(s: State, period: Period, eps: float) -> Use:
    """Sum the residual's changes; at the end of a period, compare with the periods before."""
    _, power, counted, before, given_up = s.use
    if period.repeated == 0:
        return Use(eps, 0.0, 0, 0.0, False)
    power += (eps - s.use.eps) * (eps - s.use.eps)
    counted += 1
    if counted >= period.N:
        if period.repeated < 1.5 * period.N:
            before = power
        elif power > WORSE * before:
            given_up = True
        power, counted = 0.0, 0
    return Use(eps, power, counted, before, given_up)
