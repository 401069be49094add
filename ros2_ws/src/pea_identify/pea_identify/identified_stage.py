"""A stage as it was identified: V, F_c, H and the sensor, and the displacement they give."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from pea_identify.creep import Creep
from pea_identify.frequency_response import FrequencyResponse
from pea_identify.hysteresis import HysteresisFit
from pea_identify.modes import Modes
from pea_identify.noise import NoiseFit
from pea_identify.records import Record


@dataclass(frozen=True)
class IdentifiedStage:
    """An identified stage with one axis.

    Attributes
    ----------
    records : tuple of Record
        What it was identified from.
    T_s : float
        Sample period (s) of the fast records, or of the first.
    response : FrequencyResponse or None
        At the smallest amplitude.
    modes : Modes or None
        V. From the voltage, or from the output of H where `through_H`.
    through_H : bool
    small : float
        Gain for small signals (m/V); NaN where no fast record was given.
    small_95 : float
        Half width of its 95 % interval.
    amplitudes : tuple of (float, Modes)
        Rms voltage (V) and V at each amplitude, rising.
    creep : Creep or None
    hysteresis : HysteresisFit or None
    tried : tuple of HysteresisFit
        Models of H that were compared.
    noise : NoiseFit or None
    sentences : tuple of str
        What the data do not determine, and why.
    """

    records: tuple[Record, ...]
    T_s: float
    response: FrequencyResponse | None
    modes: Modes | None
    through_H: bool
    small: float
    small_95: float
    amplitudes: tuple[tuple[float, Modes], ...]
    creep: Creep | None
    hysteresis: HysteresisFit | None
    tried: tuple[HysteresisFit, ...]
    noise: NoiseFit | None
    sentences: tuple[str, ...]

    @property
    def delay(self) -> float:
        """Delay (s) of a slow motion: transport, and what the modes add."""
        return slow_delay(self.modes) if self.modes is not None else 0.0

    @property
    def gain(self) -> float:
        """Gain (m/V) that V has in the model, where H has about unity gain."""
        if self.hysteresis is not None:
            return self.hysteresis.K
        if self.modes is not None:
            return float(self.modes.gain[0, 0])
        return math.nan

    def simulate(self, u: np.ndarray, T_s: float) -> np.ndarray:
        """Displacement (N,) in m along a voltage (N,) in V held a sample each.

        H begins at rest at 0 V; V and F_c begin settled at the first voltage.

        Raises
        ------
        ParameterError
            Another sample period than V was identified with, and V is more than a delay there.
        """
        u = np.asarray(u, dtype=float).ravel()
        v = self.hysteresis.voltage(u) if self.hysteresis is not None else u
        moved = v - v[0]
        if self.creep is not None:
            moved = self.creep(moved, T_s)
        if self.modes is not None:
            share = self.modes.K / self.modes.gain
            unit = replace(self.modes, K=share, T_s=T_s)
            moved = unit.simulate(moved[:, None])[:, 0]
        v = moved + v[0]
        if self.hysteresis is not None:
            return self.hysteresis.displacement(v)
        return self.gain * v


def slow_delay(modes: Modes) -> float:
    """Delay (s) that V gives a slow motion, half a sample for the hold included."""
    share = modes.K[:, 0, 0] / modes.gain[0, 0]
    return modes.delay + modes.lag + float(share @ (2.0 * modes.zeta / modes.omega_n))
