r"""Learning on the harmonics of a periodic reference, with a filter from the identified model.

A law with a model of several modes adds to its command

.. math:: c_k = \sum_{n=1}^{M} \mathrm{Re}(a_n e^{i n \varphi_k}), \quad
          \varphi_k = 2\pi \frac{k - k_0}{N}

where N is the period of w in samples and k_0 the time of its last minimum; both may be fractions.
The measured deviation e from the model's trajectory responds to c by H(z), the closed loop, which
follows from model and gains. `repetitive` corrects a_n at every sample,

.. math:: a_n \leftarrow a_n - \frac{2 \gamma}{N}\,F(n \omega)\,e_k\,e^{-i n \varphi_k}, \quad
          F = \frac{\sum_j \bar H_j}{\max_j |H_j|\,\sum_j |H_j|} ,

`iterative` sums the same changes over one whole period, fades the sum in over the next period, and
measures again after that. H_j are the responses of a set of stages: all frequencies off by up to
the stated spread, the gain likewise, and the lower gain of a hysteresis for small signals. In a
period an error at a harmonic is multiplied by about |1 - gamma F H_j|, which is below one if F H_j
has a positive real part. A harmonic is not learned if this part differs too much over the set
(`AGREED`), for example near a resonance of uncertain frequency.

N, k_0 and F are updated at every minimum of the reference, so N may drift. Learning begins when w
has repeated itself for a period within `TOLERANCE` of its span, and the power of e in a period has
stopped falling, so that no transient of a lightly damped mode is learned. It ends at the first
sample that does not repeat. It is given up, until w changes, if the power has become `WORSE` times
that of the period before learning began.

Inputs
    `Reference` W (m, m/s, m/s^2), deviation e (m).
Outputs
    correction c (V).
State
    one period of w (m), the estimated period, a_n, and whether learning helps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pea_controller.model.repetitive import remembered, turn
from pea_core.params import ParameterError, param
from pea_core.signals import Reference

TOLERANCE = 0.02
"""Largest change of w from one period to the next, as a share of its span; a drift of 0.5 % of the
period makes 0.016."""

DRIFT = 0.02
"""Largest change of the period from one to the next, as a share of it."""

SETTLED = 0.8
"""e has settled when its power exceeds this share of the remembered power."""

FORGOTTEN = 0.7
"""Factor by which the remembered power falls in a period."""

WORSE = 4.0
"""Learning is given up when the power of the deviation has grown by this factor."""

AGREED = 0.2
"""Least real part of F H_j over the set, as a share of the largest, to learn a harmonic."""

HARMONICS_MAX = 100
"""Largest number of harmonics that are learned."""

GRID = 2000
"""Frequencies at which F is computed; between them it is interpolated."""

SLOPE = 0.55
"""Least local slope of a hysteresis that learning must tolerate."""

SIZE_MAX = 1e6
"""Largest memory (samples)."""


@dataclass(frozen=True)
class Params:
    """Parameters of the learning."""

    method: str = param(
        "none",
        choices=("none", "repetitive", "iterative"),
        help="learn on periodic references: at every sample, or once in two periods",
        fixed=True,
    )
    rate: float = param(0.3, "", 0.0, 1.0, help="gamma: share learned each period")
    bandwidth_hz: float = param(1500.0, "Hz", 1.0, 1e6, help="highest harmonic learned", fixed=True)
    frequency_hz: float = param(
        0.0, "Hz", 0.0, 1e6, help="frequency of the reference; 0: found from it", fixed=True
    )
    period_max: float = param(1.0, "s", 1e-6, 10.0, help="longest period to be learned", fixed=True)
    spread_frequency: float = param(
        0.03, "", 0.0, 0.5, help="share by which a mode's frequency may be off", fixed=True
    )
    spread_gain: float = param(
        0.1, "", 0.0, 0.9, help="share by which the gain may be off", fixed=True
    )


class Coefficients(NamedTuple):
    """on : whether anything is learned.  batch : whether once in two periods (`iterative`).

    rate : gamma.  F (G, 2) : filter (V/m) at multiples of `step` (periods in a sample).
    most : largest number of harmonics.  given : N (samples), 0: to be found.  shortest, longest :
    bounds of N.  size : samples of the memory.  T_s (s).
    """

    on: bool
    batch: bool
    rate: float
    F: np.ndarray
    step: float
    most: int
    given: float
    shortest: float
    longest: float
    size: int
    T_s: float


class Period(NamedTuple):
    """N : period (samples), 0: not known.  repeated : samples for which w has repeated itself.

    at, depth : time (samples) and value (m) of the minimum from which the period is counted;
    at < 0: none yet.  low, high : span of w (m).  begun : whether a period began with this sample.
    """

    N: float
    repeated: int
    at: float
    depth: float
    low: float
    high: float
    begun: bool


class Use(NamedTuple):
    """Whether learning helps.

    power : sum of e^2 (m^2) over this period.  before : that of the last period before learning
    began.  whole : whether this period is a whole one.  begun : whether e has settled.  summing :
    whether this period is summed (`iterative`).
    """

    power: float
    before: float
    whole: bool
    begun: bool
    given_up: bool
    summing: bool


class State(NamedTuple):
    """k : sample number.  last : `Reference` of the last sample.  w (size) : ring over k (m).

    f (M, 2) : F at the harmonics.  a (M, 2) : a_n (V).  b (M, 2) : sum of the changes (V) that
    `iterative` then fades in.
    """

    k: int
    period: Period
    use: Use
    last: Reference
    w: np.ndarray
    f: np.ndarray
    a: np.ndarray
    b: np.ndarray


def spread(frequency: float, gain: float) -> list[tuple[float, float]]:
    """The set of stages: for each, the factors of all frequencies and of the gain."""
    shifts = (-1.0, -0.5, 0.0, 0.5, 1.0) if frequency > 0.0 else (0.0,)
    gains = (SLOPE * (1.0 - gain), 1.0 - gain, 1.0 + gain)
    return [(1.0 + frequency * shift, share) for shift in shifts for share in gains]


def filter_of(H: np.ndarray) -> np.ndarray:
    """F (G) of the responses H (stages, G); 0 where the stages disagree in phase."""
    size = np.abs(H)
    F = H.conj().sum(axis=0) / np.maximum(size.max(axis=0) * size.sum(axis=0), 1e-300)
    in_phase = (F * H).real
    agreed = in_phase.min(axis=0) > AGREED * in_phase.max(axis=0)
    return np.asarray(np.where(agreed & np.isfinite(in_phase).all(axis=0), F, 0.0))


def design(
    params: Params, respond: Callable[[np.ndarray, Sequence[tuple[float, float]]], np.ndarray],
    T_s: float,
) -> Coefficients:  # fmt: skip
    """Compute the filter.

    Parameters
    ----------
    params : Params
    respond : callable
        H (stages, G) in m/V at frequencies (G) in Hz, for factors of frequency and gain.
    T_s : float
        Sample period (s).

    Raises
    ------
    ParameterError
        A period does not fit the memory, or the memory would be too large.
    """
    on = params.method != "none"
    if on and params.period_max / T_s > SIZE_MAX:
        raise ParameterError(
            f"learning.period_max = {params.period_max:g}: {params.period_max / T_s:.3g} samples "
            f"would be kept, at most {SIZE_MAX:g}; shorten it"
        )
    band = min(params.bandwidth_hz, 0.45 / T_s)
    shortest = max(8.0, 1.0 / (band * T_s))
    longest = max(params.period_max / T_s, shortest + 1.0)
    given = 0.0
    if on and params.frequency_hz > 0.0:
        lowest, highest = 1.0 / (longest * T_s), 1.0 / (shortest * T_s)
        if not lowest <= params.frequency_hz <= highest:
            raise ParameterError(
                f"learning.frequency_hz = {params.frequency_hz:g}: must be within "
                f"{lowest:.4g} to {highest:.4g} Hz, from learning.period_max and "
                "learning.bandwidth_hz"
            )
        given = 1.0 / (params.frequency_hz * T_s)
    F = np.zeros((GRID + 1 if on else 0, 2))
    if on:
        f = band * np.arange(1, GRID + 1) / GRID
        found = filter_of(respond(f, spread(params.spread_frequency, params.spread_gain)))
        F[1:, 0], F[1:, 1] = found.real, found.imag
    most = min(HARMONICS_MAX, math.floor(band * params.period_max)) if on else 0
    return Coefficients(
        on=on,
        batch=params.method == "iterative",
        rate=params.rate,
        F=F,
        step=band * T_s / GRID,
        most=max(most, 1) if on else 0,
        given=given,
        shortest=shortest,
        longest=longest,
        size=math.ceil(longest * (1.0 + DRIFT)) + 8 if on else 0,
        T_s=T_s,
    )


def blank(c: Coefficients) -> State:
    """The state with nothing learned."""
    return State(
        k=0,
        period=Period(0.0, 0, -1.0, 0.0, 0.0, 0.0, False),
        use=Use(0.0, 0.0, False, False, False, False),
        last=Reference(0.0, 0.0, 0.0),
        w=np.zeros(c.size),
        f=np.zeros((c.most, 2)),
        a=np.zeros((c.most, 2)),
        b=np.zeros((c.most, 2)),
    )


def acts(s: State) -> bool:
    """Whether the correction acts and is learned."""
    return s.use.begun and not s.use.given_up


def correction(c: Coefficients, s: State) -> float:
    """Correction (V) of this sample's command."""
    if not c.on or not acts(s):
        return 0.0
    turned = (s.k - s.period.at) / s.period.N
    faded = min(turned, 1.0) if c.batch and not s.use.summing else 0.0
    re, im = math.cos(2.0 * math.pi * turned), math.sin(2.0 * math.pi * turned)
    x, y, total = 1.0, 0.0, 0.0
    for n in range(c.most):
        x, y = x * re - y * im, x * im + y * re
        total += (s.a[n, 0] + faded * s.b[n, 0]) * x - (s.a[n, 1] + faded * s.b[n, 1]) * y
    return total


def learned(c: Coefficients, s: State, W: Reference, e: float) -> State:
    """Learn from the deviation e (m); check whether w repeats itself and learning helps."""
    if not c.on:
        return s
    if acts(s) and (not c.batch or s.use.summing):
        turned = (s.k - s.period.at) / s.period.N
        re, im = math.cos(2.0 * math.pi * turned), math.sin(2.0 * math.pi * turned)
        x, y, share = 1.0, 0.0, 2.0 * c.rate / s.period.N * e
        for n in range(c.most):
            x, y = x * re - y * im, x * im + y * re
            more_re = share * (s.f[n, 0] * x + s.f[n, 1] * y)
            more_im = share * (s.f[n, 1] * x - s.f[n, 0] * y)
            if c.batch:
                s.b[n, 0] -= more_re
                s.b[n, 1] -= more_im
            else:
                s.a[n, 0] -= more_re
                s.a[n, 1] -= more_im
    s.w[s.k % max(c.size, 1)] = W.w
    period = followed(c, s, W)
    use = judged(c, s, period, e)
    if period.begun:
        filtered(c, s, period.N)
    if period.repeated == 0 or use.given_up:
        for n in range(c.most):
            s.a[n, 0], s.a[n, 1], s.b[n, 0], s.b[n, 1] = 0.0, 0.0, 0.0, 0.0
    return State(s.k + 1, period, use, W, s.w, s.f, s.a, s.b)


def filtered(c: Coefficients, s: State, N: float) -> None:
    """Write F at the harmonics of a period N into the state."""
    for n in range(c.most):
        at = (n + 1) / (N * c.step)
        first = math.floor(at)
        if first + 1 < c.F.shape[0]:
            t = at - first
            s.f[n, 0] = c.F[first, 0] + t * (c.F[first + 1, 0] - c.F[first, 0])
            s.f[n, 1] = c.F[first, 1] + t * (c.F[first + 1, 1] - c.F[first, 1])
        else:
            s.f[n, 0], s.f[n, 1] = 0.0, 0.0


def followed(c: Coefficients, s: State, W: Reference) -> Period:
    """Compare w with one period before; find the period, and update it at every minimum."""
    N, repeated, at, depth, low, high, _ = s.period
    low, high = (min(low, W.w), max(high, W.w)) if s.k > 0 else (W.w, W.w)
    allowed, begun = TOLERANCE * (high - low), False
    if N > 0.0 and s.k >= N + 1.0:
        same = abs(W.w - remembered(s.w, s.k - N)) <= allowed
        if high > low and same and s.k - at <= (1.0 + DRIFT) * N + 1.0:
            repeated += 1
        else:
            N, repeated, at = 0.0, 0, -1.0
    if s.k > 0 and s.last.w_dot < 0.0 <= W.w_dot:
        since, w = turn(s.last, W, c.T_s)
        now = s.k - 1.0 + since
        gap = now - at
        wanted = N if N > 0.0 else c.given
        fits = c.shortest <= gap <= c.longest
        if wanted > 0.0:
            fits = fits and abs(gap - wanted) <= DRIFT * wanted
        if at >= 0.0 and fits and abs(w - depth) <= allowed:
            N, begun = gap, True
        if at < 0.0 or begun or (N == 0.0 and (w < depth or gap > c.longest)):
            at, depth = now, w
    return Period(N, repeated, at, depth, low, high, begun)


def judged(c: Coefficients, s: State, period: Period, e: float) -> Use:
    """Sum the power of e; when a period ends, compare it with that of the period before."""
    power, before, whole, begun, given_up, summing = s.use
    if period.repeated == 0:
        return Use(0.0, 0.0, False, False, False, False)
    power += e * e
    if not period.begun:
        return Use(power, before, whole, begun, given_up, summing)
    if not begun:
        begun = whole and before > 0.0 and power > SETTLED * before
        # a beat of two modes falls and rises: the larger part counts
        before = max(power, FORGOTTEN * before) if whole else 0.0
        return Use(0.0, before, True, begun, False, begun)
    if power > WORSE * before:
        given_up = True
    if c.batch:
        if not summing:  # keep the change that was faded in
            for n in range(c.most):
                s.a[n, 0] += s.b[n, 0]
                s.a[n, 1] += s.b[n, 1]
                s.b[n, 0], s.b[n, 1] = 0.0, 0.0
        summing = not summing
    return Use(0.0, before, True, True, given_up, summing)
