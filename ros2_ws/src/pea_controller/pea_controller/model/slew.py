r"""A law under a slew limit: it acts on the state that the actuator would have without the limit.

The applied voltage is the command u, limited by range and slew rate S,

.. math:: |u_{a,k} - u_{a,k-1}| \le S\,T_s, \quad u_{a,k} \in [u_{min}, u_{max}].

The nominal model, driven by the missing voltage, gives the distance d of the actuator's state from
the state that u would have reached,

.. math:: d_{k+1} = \Phi d_k + \Gamma (u_{a,k} - u_k),

and the law gets \hat x - d. This state obeys Eq 2 with the unlimited u, whatever was applied. So
the loop of law and nominal model stays linear, its integral does not wind up, and the lag of a
slewing voltage causes no limit cycle. When u_a has reached u, d decays like the actuator. This is
anti-windup by model recovery. It is valid for a stable actuator, such as a piezo. eps acts on both
states equally, so it has no effect here; the plant sends u_a to the observer.

A command counts up to one range beyond the range, so that d and the law stay bounded if the
actuator differs from Eq 2; beyond that, the law's own anti-windup acts (`counted`). Without a slew
limit d is 0, and the law itself handles the range.

Inputs
    `Estimate` (m, m/s, V), command u (V).
Outputs
    `Estimate` for the law.
State
    d when the last command acts, d at this sample and, for a delay of several samples, d between
    them (m, m/s); the last applied voltage (V).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pea_core.nominal import NominalModel, hold, state_space
from pea_core.signals import Estimate


class Coefficients(NamedTuple):
    """Phi (2, 2) and Gamma (2) entry by entry; range (V), largest change in a sample (V).

    low, high: range in which a command counts (V).  share: 1.0 with a slew limit, else 0.0.
    delay: of a command (samples).
    """

    f11: float
    f12: float
    f21: float
    f22: float
    g1: float
    g2: float
    voltage_min: float
    voltage_max: float
    change: float
    low: float
    high: float
    share: float
    delay: int


class State(NamedTuple):
    """d1 (m), d2 (m/s) when the last command acts; the same at this sample; applied voltage u (V).

    between (2 delay - 2): d1 and d2 at the samples between, the next one first.
    """

    d1: float
    d2: float
    now1: float
    now2: float
    u: float
    between: np.ndarray


def counted(voltage_min: float, voltage_max: float, slew_rate: float) -> tuple[float, float]:
    """Range (V) in which a command counts as not limited for the law."""
    beyond = voltage_max - voltage_min if slew_rate > 0.0 else 0.0
    return voltage_min - beyond, voltage_max + beyond


def design(
    model: NominalModel,
    voltage_min: float,
    voltage_max: float,
    slew_rate: float,
    delay: int,
    T_s: float,
) -> Coefficients:
    """Discretise Eq 2; a slew rate (V/s) of 0 is no limit."""
    A, B, _ = state_space(model)
    F, G = hold(A, B, T_s)
    low, high = counted(voltage_min, voltage_max, slew_rate)
    f11, f12, f21, f22 = F.ravel().tolist()
    g1, g2 = G[:, 0].tolist()
    limited = slew_rate > 0.0
    return Coefficients(
        *(f11, f12, f21, f22, g1, g2),
        voltage_min,
        voltage_max,
        slew_rate * T_s if limited else math.inf,
        low,
        high,
        float(limited),
        delay,
    )


def at_rest(c: Coefficients) -> State:
    """The state at rest."""
    return State(0.0, 0.0, 0.0, 0.0, 0.0, np.zeros(2 * max(c.delay - 1, 0)))


def applied(c: Coefficients, s: State, u: float) -> float:
    """The command (V), limited by range and slew rate."""
    v = min(max(u, c.voltage_min), c.voltage_max)
    return min(max(v, s.u - c.change), s.u + c.change)


def acting(c: Coefficients, s: State, u: float) -> float:
    """The voltage (V) that acts on the state that the law gets."""
    return min(max(u, c.low), c.high) if c.share > 0.0 else applied(c, s, u)


def freed(s: State, x: Estimate) -> Estimate:
    """The estimate for a state to which all commands had been applied."""
    return Estimate(x.x1 - s.now1, x.x2 - s.now2, x.eps)


def kept_back(c: Coefficients, s: State, u: float) -> State:
    """Add the missing part of the command u (V) to d."""
    v = applied(c, s, u)
    gap = c.share * (v - min(max(u, c.low), c.high))
    d1 = c.f11 * s.d1 + c.f12 * s.d2 + c.g1 * gap
    d2 = c.f21 * s.d1 + c.f22 * s.d2 + c.g2 * gap
    now1, now2 = (s.d1, s.d2) if c.delay > 0 else (d1, d2)
    if c.delay > 1:
        now1, now2 = float(s.between[0]), float(s.between[1])
        last = 2 * (c.delay - 2)
        for i in range(last):
            s.between[i] = s.between[i + 2]
        s.between[last], s.between[last + 1] = s.d1, s.d2
    return State(d1, d2, now1, now2, v, s.between)
