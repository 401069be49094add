r"""Step from offset to offset + amplitude, raw or shaped so that its second derivative exists.

With a = amplitude and t counted from the sample nearest to `time`:

raw
    a at t >= 0. Its derivatives are given as zero, though none exist at the jump, so the
    feedforward of Eq 7 sees the level alone.
minimum_jerk
    .. math:: a\,(10 s^3 - 15 s^4 + 6 s^5), \quad s = t / t_r \in [0, 1]

    t_r, the rise time, is the whole move. Of all moves from rest to rest in t_r it has the least
    integral of squared jerk.
filtered
    .. math:: a\,\bigl(1 - (1 + x + x^2/2)\,e^{-x}\bigr), \quad x = t / \tau

    The raw step behind 1/(tau s + 1)^3; the rise time is that from 10 % to 90 %, 4.2202 tau.

With a shaper a raw step is its S-curve, and each of its impulses sends the whole shape
(`shaper`).

Outputs
    `Reference` (m, m/s, m/s^2), exact derivatives of the shaped steps, continuous.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from pea_core.params import param
from pea_core.signals import Reference
from pea_reference.model.shaper import NO_MOVE, Curve, Shapeable, curve, done, impulses

SHAPES = ("raw", "minimum_jerk", "filtered")
RAW, MINIMUM_JERK, FILTERED = range(3)


@dataclass(frozen=True)
class Params(Shapeable):
    """One step."""

    amplitude_um: float = param(5.0, "um", -1e4, 1e4, help="height of the step", common=True)
    offset_um: float = param(0.0, "um", -1e4, 1e4, help="displacement before the step", common=True)
    time: float = param(0.0, "s", 0.0, 1e6, help="when the step comes")
    shape: str = param("raw", help="how w gets from one level to the other", choices=SHAPES)
    rise_time: float = param(
        0.01, "s", 1e-6, 1e4, help="whole move of minimum_jerk, 10 % to 90 % of filtered"
    )


class Coefficients(NamedTuple):
    """Levels before and after, height (m), first sample, shape's number, its time (s), period.

    move: S-curve of a raw step with a shaper, and the impulses of any.  shaped: whether there are.
    """

    before: float
    after: float
    height: float
    k_step: int
    shape: int
    tau: float
    T_s: float
    move: Curve
    shaped: bool


def design(params: Params, T_s: float) -> Coefficients:
    """Convert to SI and to samples."""
    from scipy.special import gammaincinv  # slow to import

    shaper = params.shaper
    before, height = params.offset_um * 1e-6, params.amplitude_um * 1e-6
    shape = SHAPES.index(params.shape)
    per_tau = gammaincinv(3.0, 0.9) - gammaincinv(3.0, 0.1) if shape == FILTERED else 1.0
    return Coefficients(
        before,
        before + height,
        height,
        round(params.time / T_s),
        shape,
        params.rise_time / float(per_tau),
        T_s,
        curve(shaper, height, impulses(shaper)) if shaper.on else NO_MOVE,
        shaper.on,
    )


def move(params: Params) -> tuple[float, float]:
    """When (s) the move to the last level begins, and that level (m)."""
    return params.time, (params.offset_um + params.amplitude_um) * 1e-6


def risen(c: Coefficients, t: float) -> tuple[float, float, float]:
    """Share of a shaped step at the time t (s) after it comes, and its two derivatives."""
    x = t / c.tau
    if t < 0.0:
        return 0.0, 0.0, 0.0
    if c.shape == MINIMUM_JERK and x < 1.0:
        return (
            x * x * x * (10.0 + x * (-15.0 + x * 6.0)),
            x * x * (30.0 + x * (-60.0 + x * 30.0)) / c.tau,
            x * (60.0 + x * (-180.0 + x * 120.0)) / (c.tau * c.tau),
        )
    if c.shape == FILTERED:
        fading = math.exp(-x)
        return (
            1.0 - (1.0 + x * (1.0 + x * 0.5)) * fading,
            0.5 * x * x * fading / c.tau,
            x * (1.0 - 0.5 * x) * fading / (c.tau * c.tau),
        )
    return 1.0, 0.0, 0.0


def moved(c: Coefficients, t: float) -> Reference:
    """Reference at the time t (s) after a step with a shaper comes."""
    if c.shape == RAW:
        f, f_1, f_2 = done(c.move, t)
    else:
        f, f_1, f_2 = 0.0, 0.0, 0.0
        for i in range(c.move.t.size):
            r_0, r_1, r_2 = risen(c, t - c.move.t[i])
            f += c.move.A[i] * r_0
            f_1 += c.move.A[i] * r_1
            f_2 += c.move.A[i] * r_2
    if f == 1.0:
        return Reference(c.after, float(c.height * f_1), float(c.height * f_2))
    return Reference(float(c.before + c.height * f), float(c.height * f_1), float(c.height * f_2))


def output(c: Coefficients, k: int) -> Reference:
    """Reference at sample k."""
    if k < c.k_step:
        return Reference(c.before, 0.0, 0.0)
    if c.shaped:
        return moved(c, (k - c.k_step) * c.T_s)
    x = (k - c.k_step) * c.T_s / c.tau
    if c.shape == MINIMUM_JERK and x < 1.0:
        return Reference(
            c.before + c.height * (x * x * x * (10.0 + x * (-15.0 + x * 6.0))),
            c.height / c.tau * (x * x * (30.0 + x * (-60.0 + x * 30.0))),
            c.height / (c.tau * c.tau) * (x * (60.0 + x * (-180.0 + x * 120.0))),
        )
    if c.shape == FILTERED:
        fading = math.exp(-x)
        return Reference(
            c.after - c.height * ((1.0 + x * (1.0 + x * 0.5)) * fading),
            c.height / c.tau * (0.5 * x * x * fading),
            c.height / (c.tau * c.tau) * (x * (1.0 - 0.5 * x) * fading),
        )
    return Reference(c.after, 0.0, 0.0)
