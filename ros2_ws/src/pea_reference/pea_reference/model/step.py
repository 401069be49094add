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

Outputs
    `Reference` (m, m/s, m/s^2), exact derivatives of the shaped steps, continuous.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from pea_core.params import param
from pea_core.signals import Reference

SHAPES = ("raw", "minimum_jerk", "filtered")
RAW, MINIMUM_JERK, FILTERED = range(3)


@dataclass(frozen=True)
class Params:
    """One step."""

    amplitude_um: float = param(5.0, "um", -1e4, 1e4, help="height of the step", common=True)
    offset_um: float = param(0.0, "um", -1e4, 1e4, help="displacement before the step", common=True)
    time: float = param(0.0, "s", 0.0, 1e6, help="when the step comes")
    shape: str = param("raw", help="how w gets from one level to the other", choices=SHAPES)
    rise_time: float = param(
        0.01, "s", 1e-6, 1e4, help="whole move of minimum_jerk, 10 % to 90 % of filtered"
    )


class Coefficients(NamedTuple):
    """Levels before and after, height (m), first sample, shape's number, its time (s), period."""

    before: float
    after: float
    height: float
    k_step: int
    shape: int
    tau: float
    T_s: float


def design(params: Params, T_s: float) -> Coefficients:
    """Convert to SI and to samples."""
    from scipy.special import gammaincinv  # slow to import

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
    )


def move(params: Params) -> tuple[float, float]:
    """When (s) the move to the last level begins, and that level (m)."""
    return params.time, (params.offset_um + params.amplitude_um) * 1e-6


def output(c: Coefficients, k: int) -> Reference:
    """Reference at sample k."""
    if k < c.k_step:
        return Reference(c.before, 0.0, 0.0)
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
