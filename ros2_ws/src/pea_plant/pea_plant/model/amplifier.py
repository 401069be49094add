r"""The voltage amplifier: limits, DAC, slew rate, and a first-order bandwidth.

In the order of the signal: the command is limited to the voltage range and set on the DAC's
grid; it may wait one sample (`delay_samples`); then the slew rate bounds the change,

.. math:: |u_k - u_{k-1}| \le S\,T_s,

and what results is u_applied. A first-order lag turns it into the voltage u_a on the actuator,

.. math:: \tau \dot u_a = u_{applied} - u_a, \quad \tau = \frac{1}{2 \pi f_b}.

Accuracy. Limits and DAC are exact. The slewing voltage is a staircase at the sample instants:
it leads the true ramp by S T_s at most and S T_s/2 on average, and is exact once it has
arrived. The lag is exact at the sample instants, and between them as `actuator` says.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from pea_core.params import ParameterError, param
from pea_plant.gate import limit
from pea_plant.model.quantiser import quantise

LOWEST_HZ = 1e-3
"""Lowest bandwidth: below, a sample moves a lag by too few digits."""


def bandwidth(f: float) -> float:
    """Check a bandwidth (Hz) and return it.

    Raises
    ------
    ParameterError
        Neither zero nor at least `LOWEST_HZ`.
    """
    if 0.0 < f < LOWEST_HZ:
        raise ParameterError(
            f"bandwidth_hz = {f:g}: must be 0 (no limit) or at least {LOWEST_HZ:g} Hz"
        )
    return f


@dataclass(frozen=True)
class Params:
    """Amplifier; its limits are the plant's voltage_min and voltage_max."""

    bandwidth_hz: float = param(
        0.0, "Hz", 0.0, 1e6, help="first-order bandwidth; 0: none", fixed=True
    )
    slew_rate: float = param(0.0, "V/s", 0.0, 1e9, help="fastest change; 0: no limit")
    dac_bits: int = param(0, "", 0, 32, help="bits over the voltage range; 0: no grid")

    def __post_init__(self) -> None:
        bandwidth(self.bandwidth_hz)


class Coefficients(NamedTuple):
    """Range (V), DAC step (V, 0: none), largest change a sample (V, 0: none), exp(-T_s/tau)."""

    voltage_min: float
    voltage_max: float
    step: float
    change: float
    decay: float


def design(params: Params, voltage_min: float, voltage_max: float, T_s: float) -> Coefficients:
    """Coefficients for a range (V) and a sample period (s)."""
    levels = 2**params.dac_bits - 1
    return Coefficients(
        voltage_min,
        voltage_max,
        (voltage_max - voltage_min) / levels if levels else 0.0,
        params.slew_rate * T_s,
        math.exp(-2.0 * math.pi * params.bandwidth_hz * T_s) if params.bandwidth_hz else 0.0,
    )


def command(c: Coefficients, u: float) -> float:
    """Limit a command u (V) and set it on the DAC's grid."""
    u = limit(u, c.voltage_min, c.voltage_max)
    if c.step > 0.0:
        u = min(c.voltage_min + quantise(u - c.voltage_min, c.step), c.voltage_max)
    return u


def slew(c: Coefficients, before: float, u: float) -> float:
    """Go from the voltage `before` (V) towards u (V) as far as the slew rate allows."""
    if c.change > 0.0:
        return min(max(u, before - c.change), before + c.change)
    return u
