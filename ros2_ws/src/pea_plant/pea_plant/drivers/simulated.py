"""The simulated actuator, one step a sample."""

from __future__ import annotations

import numpy as np

from pea_core.block import Block
from pea_core.signals import Measurement
from pea_core.units import SECOND
from pea_plant import gate as safety_gate
from pea_plant.drivers.driver import Limits
from pea_plant.model import sensor
from pea_plant.model.actuator import Params, Truth, actuator, steady_state_gain


class Unconnected:
    """A driver of nothing that there is: what others do with a connection."""

    __slots__ = ()

    def connect(self) -> None:
        """Nothing to do."""

    def check(self) -> None:
        """Nothing can be wrong."""

    def last_resort(self, u: float) -> bytes:
        """Nothing needs a last resort."""
        return b""

    def fileno(self) -> int:
        """No connection."""
        return -1

    def close(self) -> None:
        """Nothing to do."""


class Simulated(Unconnected, Block):
    """Plant of the loop: `read` the sensor, then `write` the command.

    Parameters
    ----------
    params : Params
        The actuator, its load, amplifier and sensor.
    T_s : float
        Sample period (s).
    """

    __slots__ = ("identity", "noises")

    def __init__(self, params: Params, T_s: float) -> None:
        super().__init__(actuator(params), params, T_s)
        self.noises = sensor.Noise(params.seed)
        self.identity = "simulated actuator"

    @property
    def limits(self) -> Limits:
        """Of the amplifier (V), and what they reach at rest (m)."""
        low, high = self.params.voltage_min, self.params.voltage_max
        K = steady_state_gain(self.params) * 1e-6
        return Limits(low, high, K * low, K * high)

    def exchange(self, u: float) -> Measurement:
        """Measure, then apply the command u (V) and go on to the next sample."""
        measured = self.read()
        self.write(u)
        return measured

    def try_design(self, params: Params) -> None:
        """See whether the model can be designed with `params`, no limit of which is looser.

        Raises
        ------
        ParameterError
            It cannot, or one is.
        """
        safety_gate.refuse_looser(self.params, params)
        super().try_design(params)

    def read(self) -> Measurement:
        """Measure at this sample."""
        measured: Measurement = self.output(next(self.noises))
        return measured

    def write(self, u: float) -> None:
        """Apply the command u (V) and go on to the next sample.

        Raises
        ------
        UnsafeCommand
            u is not finite.
        """
        safety_gate.check(u, self.s.k)
        self.update(u)

    def ahead(self, samples: int) -> np.ndarray:
        """The sensor's noise of the next samples, which stay the next."""
        return self.noises.ahead(samples)

    def noise(self, samples: int) -> np.ndarray:
        """The sensor's noise of the next samples, for a loop that steps the model itself."""
        return self.noises.take(samples)

    @property
    def transition(self) -> safety_gate.Transition | None:
        """How the gate has tripped; None where it has not."""
        gate: safety_gate.State = self.s.gate
        if gate.state != safety_gate.FAULT:
            return None
        k = self.s.k - gate.since
        cause = f"{safety_gate.REASONS[gate.reason]} at sample {k}"
        return safety_gate.Transition(k * round(self.T_s * SECOND), "active", "fault", cause)

    @property
    def trip(self) -> str | None:
        """Why and at which sample the gate has tripped; None where it has not."""
        return self.transition and self.transition.cause

    @property
    def truth(self) -> Truth:
        """What no sensor tells: true states at this sample."""
        truth: Truth = self.model.truth(self.c, self.s)
        return truth
