r"""PID controller with a filtered derivative, the yardstick of the paper's Figs 3 and 4.

.. math:: u = H^{-1}(u_{ff}) + K_p e + K_i \int e\,dt + K_d \frac{s}{T_f s + 1} e - \hat\varepsilon,
          \quad e = w - x_1

The integral is a backward rectangle kept in volts; the derivative is a backward difference
behind a first-order filter. The filtered derivative is kept in volts too, so a new K_d acts
on the changes that follow. Anti-windup as in `pidsmc`.

H is the identity unless an inverse is given (`inverse`).

Inputs
    `Reference` W (m, m/s, m/s^2), the same previewed for the feedforward, `Estimate` (m, m/s, V).
Outputs
    command u (V).
State
    integral (V), filtered derivative (V), last error (m), patience left while the command is
    limited (samples), what a slew limit has kept back, the plays of the inverse hysteresis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from pea_controller.model import inverse, slew
from pea_controller.model.common import (
    PATIENCE,
    CommonParams,
    counted_once,
    feedforward,
    patient,
    waits,
)
from pea_controller.model.inverse import centred, fed, moved
from pea_controller.model.slew import at_rest, freed, kept_back
from pea_core.params import group, param
from pea_core.signals import Estimate, Reference

COMPARED = True


@dataclass(frozen=True)
class Params(CommonParams):
    """PID gains in the paper's units."""

    PRESET: ClassVar[str] = "pid"

    K_p: float = param(1.0, "V/um", 0.0, 1e4, help="proportional gain")
    K_i: float = param(5000.0, "V/(um s)", 0.0, 1e8, help="integral gain")
    K_d: float = param(0.0, "V s/um", 0.0, 10.0, help="derivative gain")
    T_f: float = param(1e-4, "s", 0.0, 10.0, help="time constant of the derivative's filter")
    inverse: inverse.Params = group(inverse.Params)

    def __post_init__(self) -> None:
        super().__post_init__()
        counted_once(self.inverse, self.eps_compensation)


class Coefficients(NamedTuple):
    """Gains in SI; the derivative d follows d = a d + b (e - e_last)."""

    A21: float
    A22: float
    B2: float
    K_p: float
    K_i_T: float
    a: float
    b: float
    use_ff: float
    use_eps: float
    patience: int
    actuator: slew.Coefficients
    inverse: inverse.Coefficients


class State(NamedTuple):
    """Integral v_I (V), filtered derivative v_D (V), last error e (m), patience left (samples).

    actuator: see `slew`.  inverse: see `inverse`.
    """

    v_I: float
    v_D: float
    e: float
    spare: int
    actuator: slew.State
    inverse: inverse.State


def design(params: Params, T_s: float) -> Coefficients:
    """Convert to SI and discretise the filter."""
    return Coefficients(
        A21=params.A21,
        A22=params.A22,
        B2=params.B2,
        K_p=params.K_p * 1e6,
        K_i_T=params.K_i * 1e6 * T_s,
        a=params.T_f / (params.T_f + T_s),
        b=params.K_d * 1e6 / (params.T_f + T_s),
        use_ff=float(params.feedforward),
        use_eps=float(params.eps_compensation),
        patience=math.ceil(PATIENCE / T_s),
        actuator=params.actuator(T_s),
        inverse=inverse.design(params.inverse),
    )


def start(c: Coefficients) -> State:
    """At rest, no error before sample 0."""
    return State(0.0, 0.0, 0.0, c.patience, at_rest(c.actuator), centred(c.inverse))


def output(c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate) -> float:
    """PID of e = w - x1 and feedforward."""
    x = freed(s.actuator, x)
    e = W.w - x.x1
    v_I = s.v_I + c.K_i_T * e
    v_D = c.a * s.v_D + c.b * (e - s.e)
    u_ff = fed(c.inverse, s.inverse, c.use_ff * feedforward(c.A21, c.A22, c.B2, W_ff))
    return u_ff + c.K_p * e + v_I + v_D - c.use_eps * x.eps


def update(
    c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate, u: float
) -> State:
    """Filter the derivative; integrate, unless the actuator cannot apply u."""
    x = freed(s.actuator, x)
    actuator = kept_back(c.actuator, s.actuator, u)
    e = W.w - x.x1
    v_D = c.a * s.v_D + c.b * (e - s.e)
    v = c.use_ff * feedforward(c.A21, c.A22, c.B2, W_ff)
    inverse = moved(c.inverse, s.inverse, v)
    spare = patient(u, c.actuator.low, c.actuator.high, s.spare, c.patience)
    if waits(u, e, c.actuator.low, c.actuator.high, s.spare):
        return State(s.v_I, v_D, e, spare, actuator, inverse)
    return State(s.v_I + c.K_i_T * e, v_D, e, spare, actuator, inverse)


def absorb(c: Coefficients, s: State, gap: float) -> State:
    """Integral with which u is higher by `gap` (V); none where nothing leads it back."""
    return s._replace(v_I=s.v_I + gap) if c.K_i_T > 0.0 else s
